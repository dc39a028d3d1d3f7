# SPDX-License-Identifier: Apache-2.0
"""How soon and how rightly `watch` tells that an effect has begun, and how seldom it does so in vain."""
