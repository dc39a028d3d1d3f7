# SPDX-License-Identifier: Apache-2.0
"""The parts that all commands share: arguments, completion, progress."""
