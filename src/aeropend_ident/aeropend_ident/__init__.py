# SPDX-License-Identifier: Apache-2.0
"""Recordings of the aeropendulum: read them, diagnose the gap to a model, identify equations of motion.

For scripts:

    from aeropend_ident import diagnose, identify, read

    recording = read("my_bag")
    found = diagnose(recording, "bench")
    print(found.conclusions.which.verdict, found.augmented.effects)
    print(identify(recording).equations)

The names are imported when they are used, because numba and scipy take long to import.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from aeropend_ident.bags.recording import Recording, RecordingError, read
    from aeropend_ident.diagnosis.diagnosis import Diagnosis
    from aeropend_ident.identification.identify import Identified
    from aeropend_ident.public import diagnose, identify

__all__ = ["Diagnosis", "Identified", "Recording", "RecordingError", "diagnose", "identify", "read"]

_MODULES = {
    "Diagnosis": "aeropend_ident.diagnosis.diagnosis", "Identified": "aeropend_ident.identification.identify",
    "Recording": "aeropend_ident.bags.recording", "RecordingError": "aeropend_ident.bags.recording",
    "diagnose": "aeropend_ident.public", "identify": "aeropend_ident.public", "read": "aeropend_ident.bags.recording",
}


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
