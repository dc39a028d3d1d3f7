# SPDX-License-Identifier: Apache-2.0
"""The bridge to the real aeropendulum's board: the same topics, services and rates as the simulated plant."""
