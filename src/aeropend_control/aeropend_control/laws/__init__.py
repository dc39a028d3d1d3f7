# SPDX-License-Identifier: Apache-2.0
"""The control laws and what they are made of; nothing here knows ROS."""
