# SPDX-License-Identifier: Apache-2.0
"""Tables of other people's programs: read, understood, dated. Pure: files in, arrays out."""
