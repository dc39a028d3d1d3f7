# SPDX-License-Identifier: Apache-2.0
"""What measures: verdicts on withheld effects, benchmarks, endurance, comparisons."""
