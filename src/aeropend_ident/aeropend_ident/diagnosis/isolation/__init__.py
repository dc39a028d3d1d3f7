# SPDX-License-Identifier: Apache-2.0
"""What a recording could show, said before it is made: which effects would be seen, and told apart."""
