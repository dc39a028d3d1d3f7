# SPDX-License-Identifier: Apache-2.0
"""Recordings of the aeropendulum, and what they say about the model."""
