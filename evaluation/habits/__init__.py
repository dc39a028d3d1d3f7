# SPDX-License-Identifier: Apache-2.0
"""The check of `import` on tables in the habits of other people: `make habits`."""
