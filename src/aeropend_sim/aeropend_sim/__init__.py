# SPDX-License-Identifier: Apache-2.0
"""The model of the aeropendulum, and the node of the simulated plant.

For scripts, this package offers the model, the simulated rig and the excitation signals:

    from aeropend_sim import Excitation, load, record

    model = load("bench").with_effects({"coulomb_friction": {"accel": 0.8}})
    read, true = record(model, Excitation(duration=10.0).series(), seed=1)

The names are imported when they are used, because numba takes long to import.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from aeropend_sim.model.excitation import Excitation
    from aeropend_sim.model.parameters import Model, load
    from aeropend_sim.model.rig import Rig, record

__all__ = ["Excitation", "Model", "Rig", "load", "record"]

_MODULES = {
    "Excitation": "aeropend_sim.model.excitation", "Model": "aeropend_sim.model.parameters",
    "Rig": "aeropend_sim.model.rig", "load": "aeropend_sim.model.parameters", "record": "aeropend_sim.model.rig",
}


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
