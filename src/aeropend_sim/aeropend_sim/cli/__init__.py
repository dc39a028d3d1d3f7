# SPDX-License-Identifier: Apache-2.0
"""What every command stands on: arguments, completion, progress."""
