# SPDX-License-Identifier: Apache-2.0
"""Experiments by design: the duty signal that shows most of what is asked, within the limits of a rig."""
