# SPDX-License-Identifier: Apache-2.0
import pytest

from aeropend_control.nodes import reference
from aeropend_sim.errors import UserError


def test_a_reference_is_one_number():
    assert reference.value_of(["0.4"]) == 0.4
    assert reference.value_of(["-0.1"]) == -0.1
    for words in ([], ["0.4", "0.5"], ["much"], ["nan"], ["inf"]):
        with pytest.raises(UserError, match=r"reference 0\.4"):
            reference.value_of(words)
