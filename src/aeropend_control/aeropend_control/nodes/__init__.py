# SPDX-License-Identifier: Apache-2.0
"""The nodes: controllers, excitation, reference and step test."""
