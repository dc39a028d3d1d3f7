# SPDX-License-Identifier: Apache-2.0
"""The model that everybody shares: parameters, effects, equations of motion, measurement chain."""
