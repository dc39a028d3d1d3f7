# SPDX-License-Identifier: Apache-2.0
"""Simulated closed loops, stability margins and step responses."""
