# SPDX-License-Identifier: Apache-2.0
"""The commands, thin: arguments in, results out."""
