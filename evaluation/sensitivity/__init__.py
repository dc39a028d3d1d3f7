# SPDX-License-Identifier: Apache-2.0
"""How far verdicts depend on each decision threshold of the diagnosis."""
