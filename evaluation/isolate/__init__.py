# SPDX-License-Identifier: Apache-2.0
"""Whether what `isolate` says before a recording is what `diagnose` says after it."""
