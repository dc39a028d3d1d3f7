# SPDX-License-Identifier: Apache-2.0
"""The blind check: withheld effects, diagnosed before their labels are opened."""
