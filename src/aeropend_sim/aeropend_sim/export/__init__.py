# SPDX-License-Identifier: Apache-2.0
"""A model for other simulators: its own equations, translated, and descriptions of the rig."""
