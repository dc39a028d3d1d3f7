# SPDX-License-Identifier: Apache-2.0
"""What every node stands on: topics, parameters, diagnostics, threads and clocks."""
