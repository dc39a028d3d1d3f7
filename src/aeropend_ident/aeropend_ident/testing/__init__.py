# SPDX-License-Identifier: Apache-2.0
"""Recordings of simulated rigs, for tests and evaluation."""
