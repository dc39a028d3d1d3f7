# SPDX-License-Identifier: Apache-2.0
"""The functions that the package offers to scripts: what the commands do, without files and printing."""

from __future__ import annotations

from collections.abc import Sequence

from aeropend_ident.bags.recording import Recording
from aeropend_ident.diagnosis import diagnosis
from aeropend_ident.diagnosis.diagnosis import Diagnosis
from aeropend_ident.diagnosis.policy import MATERIAL_SHARE
from aeropend_ident.identification import dataset
from aeropend_ident.identification import identify as identification
from aeropend_ident.identification.dataset import Dataset
from aeropend_ident.identification.discrepancy import nominal
from aeropend_ident.identification.identify import Identified
from aeropend_ident.signals.from_bag import as_signals
from aeropend_sim.model.parameters import Model, load


def diagnose(recordings: Recording | Sequence[Recording], model: Model | str = "bench", *, fit_nominal: bool = False,
             held_out: float = 0.3, jobs: int = 1, material: float = MATERIAL_SHARE,
             seconds: float | None = None) -> Diagnosis:
    """Find where a model and a rig differ, which effect causes it, and how far the gap closes.

    Args:
        recordings: one or more of one rig; see `read`.
        model: the nominal model; a preset or a model file by name.
        fit_nominal: whether the rig is uncalibrated.
        held_out: share at the end of each recording that nothing is fitted to.
        jobs: processes; the result does not depend on them.
        material: share of the gap from which an effect is claimed.
        seconds: [s] that the search may take; None: a budget of simulations bounds it where it may be long.

    Raises:
        RecordingError: no verdict is possible; one line that says why.
        ModelError: the model cannot be read.
    """
    model = load(model) if isinstance(model, str) else model
    several = [recordings] if isinstance(recordings, Recording) else list(recordings)
    signals = [as_signals(r, model, held_out, fit_nominal=fit_nominal) for r in several]
    return diagnosis.diagnose(model, signals, jobs, fit_nominal=fit_nominal, material=material,
                              seconds=seconds)


def identify(data: Recording | Dataset, method: str = "weak", *, model: Model | str = "bench",
             terms: Sequence[str] | None = None) -> Identified:
    """Find sparse equations of motion.

    Args:
        data: a recording of a rig (see `read`), or arrays (see `identification.dataset.from_arrays`).
        method: `weak`, `sindy`, `discrepancy-weak` or `discrepancy-sindy`.
        model: gives the measurement chain of a recording, and the equations to which the discrepancy methods add terms;
            a preset or a model file by name.
        terms: candidate terms; None: the library of the thesis.

    Raises:
        RecordingError: no model can be identified; one line that says why.
        TermError: a term cannot be read.
        ModelError: the model cannot be read.
    """
    model = load(model) if isinstance(model, str) else model
    known = nominal(model) if method.startswith("discrepancy") else None
    if isinstance(data, Recording):
        data = dataset.from_bag(data, model.sensing)
    return identification.identify(data, method, terms, known)
