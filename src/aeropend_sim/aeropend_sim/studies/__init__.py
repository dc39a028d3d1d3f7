# SPDX-License-Identifier: Apache-2.0
"""Studies that show the origin of parameters."""
