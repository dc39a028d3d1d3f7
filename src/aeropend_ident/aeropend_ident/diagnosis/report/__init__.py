# SPDX-License-Identifier: Apache-2.0
"""The diagnosis as a web page."""
