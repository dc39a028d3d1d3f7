# SPDX-License-Identifier: Apache-2.0
"""The model that all packages share: parameters, effects, equations of motion, measurement chain."""
