# SPDX-License-Identifier: Apache-2.0
"""Processes, boards and clocks for evaluation and tests."""
