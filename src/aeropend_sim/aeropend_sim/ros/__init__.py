# SPDX-License-Identifier: Apache-2.0
"""The parts that all nodes share: topics, parameters, diagnostics, threads, clocks."""
