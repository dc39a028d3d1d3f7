# SPDX-License-Identifier: Apache-2.0
"""The diagnosis of the sim-to-real gap; docs/method.md explains it step by step."""
