# SPDX-License-Identifier: Apache-2.0
"""What `diagnose` reaches on recordings of real rigs, beside a grey box that is fitted by hand."""
