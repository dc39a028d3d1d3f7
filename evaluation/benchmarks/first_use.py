# SPDX-License-Identifier: Apache-2.0
"""Run each kernel of the simulation once, and print the processor time of all since the start [s]."""

import time

import numpy as np

from aeropend_sim.model import dynamics, ensemble, rig
from aeropend_sim.model.coefficients import prepare
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import load
from aeropend_sim.model.state import State


def main() -> None:
    """Run and print."""
    duty, model = np.full(10, 0.3), load("bench")
    full = model.with_effects({i: {n: p.default for n, p in e.parameters.items()} for i, e in CATALOGUE.items()})
    for one in (model, full):
        rig.record(one, duty)
        dynamics.swing(one, duty, State())
        dynamics.run_motor(duty, State(), *prepare(one), np.empty((3, 10)))
    ensemble.squared_errors([model], duty, np.zeros((4, 10)))
    print(time.process_time())


if __name__ == "__main__":
    main()
