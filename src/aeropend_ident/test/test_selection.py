# SPDX-License-Identifier: Apache-2.0
"""The ranking of rivals: what closes hardly more of the gap does not win by its number of parameters."""

from types import SimpleNamespace

import numpy as np
import pytest

from aeropend_ident.diagnosis.search import selection
from aeropend_ident.diagnosis.search.selection import FEWER


def fitted(mean_square):
    return SimpleNamespace(residuals={"theta": np.full(100, np.sqrt(mean_square))})


@pytest.mark.parametrize(("simple", "rich", "likelier"), [
    (3.5, 3.0, [100.0, 100.0 - FEWER]),  # as much is left of other imperfections
    (9.0, 3.0, [100.0, 140.0]),          # the further parameter closes most of the rest
    (1.1, 1.0, [100.0, 140.0]),          # all is explained: details count
])  # fmt: skip
def test_of_alike_hypotheses_that_with_fewer_parameters_is_the_likelier(simple, rich, likelier, monkeypatch):
    monkeypatch.setattr(selection, "squared_gap", lambda _, f, __: float(np.mean(f.residuals["theta"] ** 2)) - 1.0)
    tried = [(SimpleNamespace(own=("size",)), fitted(simple)), (SimpleNamespace(own=("size", "phase")), fitted(rich))]
    assert selection.frugal(None, "arm", tried, [100.0, 140.0]) == likelier
