# SPDX-License-Identifier: Apache-2.0
"""The command `aeropend`, and the parts that all commands share: arguments, completion, progress."""
