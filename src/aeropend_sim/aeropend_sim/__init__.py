# SPDX-License-Identifier: Apache-2.0
"""The aeropendulum's model, and the plant node that runs it."""
