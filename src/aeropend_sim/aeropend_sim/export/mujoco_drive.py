# SPDX-License-Identifier: Apache-2.0
"""The Python file beside an MJCF file: it drives MuJoCo's arm with the model's motor, air and remaining effects."""

from __future__ import annotations

from aeropend_sim.export import rigid_body
from aeropend_sim.export.plant_step import DRIVING
from aeropend_sim.export.targets import causal, python_module
from aeropend_sim.model.coefficients import steps_in
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model

DRIVER = "aeropend_mujoco.py"
XML = "aeropendulum.xml"

_TEXT = '''# SPDX-License-Identifier: Apache-2.0
"""The aeropendulum in MuJoCo: the arm is MuJoCo's, motor, propeller and sensors are those of aeropend_model.py.

    rig = Rig()
    for duty in duties:
        outputs = rig.step(duty)    # rig.mjmodel, rig.mjdata are MuJoCo's
"""

from pathlib import Path

import mujoco

from aeropend_model import PERIOD, Model, after, drive, held_voltage

INERTIA = {inertia!r}  # kg·m², of the arm about its hinge
LEVER = {lever!r}  # m, of the thrust
STEPS = {steps}  # of MuJoCo in a period
MULTIPLE = {multiple}  # steps of MuJoCo in a step of the motor


class Rig(Model):
    """The simulated rig, which starts at rest with the motor off.

    Args:
        theta: [rad] angle of the arm at the start.
        xml: the description of the arm.
    """

    def __init__(self, theta=0.0, xml=Path(__file__).with_name("{xml}")):
        super().__init__(theta)
        self.mjmodel = mujoco.MjModel.from_xml_path(str(xml))
        self.mjdata = mujoco.MjData(self.mjmodel)
        self.mjdata.qpos[0] = theta

    def next(self, duty, before, noise):
        """The rig after one period of MuJoCo."""
        v, plant = held_voltage(self.rig, duty, before), self.rig.plant
        for _ in range(STEPS // MULTIPLE):
            plant, torque, friction = drive(plant, v)
            self.mjmodel.dof_frictionloss[0] = INERTIA * friction
            self.mjdata.ctrl[0] = INERTIA * torque / LEVER
            for _ in range(MULTIPLE):
                mujoco.mj_step(self.mjmodel, self.mjdata)
            plant = plant._replace(theta=float(self.mjdata.qpos[0]), theta_dot=float(self.mjdata.qvel[0]))
        return after(self.rig, plant, noise)
'''


MULTIPLE = 2
"""Steps of MuJoCo in a step of the model. Measured: with 1, dry friction costs accuracy (test_export_mujoco)."""


def files(model: Model, period: float = SAMPLE_PERIOD) -> dict[str, str]:
    """The MJCF file, the driver and the Python module that it uses, by name.

    Args:
        model: parameters and effects.
        period: [s] time between samples.
    """
    arm, steps = rigid_body.arm(model), MULTIPLE * steps_in(causal(model), period)
    driver = _TEXT.format(inertia=arm.inertia, lever=arm.lever, steps=steps, multiple=MULTIPLE, xml=XML)
    return {XML: rigid_body.mjcf(model, period, steps), DRIVER: driver,
            "aeropend_model.py": python_module(model, period, DRIVING)}
