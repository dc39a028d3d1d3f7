# SPDX-License-Identifier: Apache-2.0
"""A rig, its controller and its recorder for a long time under load, and then with faults: what do they promise?"""
