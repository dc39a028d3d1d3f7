# SPDX-License-Identifier: Apache-2.0
"""The nodes: controllers, excitation, reference, step test."""
