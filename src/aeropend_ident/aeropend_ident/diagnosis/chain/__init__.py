# SPDX-License-Identifier: Apache-2.0
"""The chain from duty to angle, cut where a signal is measured."""
