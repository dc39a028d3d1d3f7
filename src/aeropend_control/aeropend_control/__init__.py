# SPDX-License-Identifier: Apache-2.0
"""Excitation signals and controllers for the aeropendulum."""
