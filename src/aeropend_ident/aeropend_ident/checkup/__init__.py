# SPDX-License-Identifier: Apache-2.0
"""What `doctor` checks: the installation, recordings, model files."""
