# SPDX-License-Identifier: Apache-2.0
"""Tuning, stability margins and step responses."""
