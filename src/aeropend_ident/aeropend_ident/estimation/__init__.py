# SPDX-License-Identifier: Apache-2.0
"""Parameter estimation that does not know what is estimated."""
