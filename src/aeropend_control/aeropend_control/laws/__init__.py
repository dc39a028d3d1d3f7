# SPDX-License-Identifier: Apache-2.0
"""The control laws, their parts, and their tuning. Nothing here depends on ROS."""
