# SPDX-License-Identifier: Apache-2.0
"""Recordings with arbitrary values through every command that reads one: a result or one line, never a traceback."""
