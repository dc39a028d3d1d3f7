# SPDX-License-Identifier: Apache-2.0
"""Studies that explain where numbers come from."""
