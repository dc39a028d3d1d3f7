# SPDX-License-Identifier: Apache-2.0
"""Equations of motion out of data."""
