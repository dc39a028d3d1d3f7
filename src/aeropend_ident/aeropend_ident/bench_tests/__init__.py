# SPDX-License-Identifier: Apache-2.0
"""Motor and propeller parameters from bench tests."""
