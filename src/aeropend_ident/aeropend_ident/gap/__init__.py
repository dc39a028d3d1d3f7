# SPDX-License-Identifier: Apache-2.0
"""The gap between a model and a rig: how large, where, which effect, and how far it closes."""
