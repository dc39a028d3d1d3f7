# SPDX-License-Identifier: Apache-2.0
"""The model beside the running rig: what it says of each sample, and when, where and why the two part."""
