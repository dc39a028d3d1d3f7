# SPDX-License-Identifier: Apache-2.0
"""What `make bench` measures: each figure beside its peer, both in the same run."""
