# SPDX-License-Identifier: Apache-2.0
"""What the channels of a recording say by themselves; nothing here knows a model's equations."""
