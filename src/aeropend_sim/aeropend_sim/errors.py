# SPDX-License-Identifier: Apache-2.0
"""The error that a user can correct."""


class UserError(Exception):
    """An input that cannot be used. Its text is one line: the problem, its place, and how to correct it."""
