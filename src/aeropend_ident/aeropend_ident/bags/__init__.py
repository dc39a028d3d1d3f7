# SPDX-License-Identifier: Apache-2.0
"""Recordings on disk: bags read, checked and written."""
