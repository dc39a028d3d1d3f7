# SPDX-License-Identifier: Apache-2.0
"""The arm of a model as a rigid body, for MuJoCo (MJCF), ROS (URDF) and Gazebo (SDF).

A model has torques over the arm's inertia; masses and lengths are not in it. They are chosen here so that the motion is
the model's: the lever of the thrust is the length of the simple pendulum of the same period, and the arm is a slender
rod whose end lies there.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass

from aeropend_sim.export.plant_step import NATIVE
from aeropend_sim.export.targets import SENSORS, Missing, described
from aeropend_sim.model.effects import DEFINED, PARAMETER_MISMATCH
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model

GRAVITY = 9.81
"""[m/s²] Convention."""

CENTRE = 2.0 / 3.0
"""Distance of the arm's centre of mass over the length of its simple pendulum: that of a slender rod (derived)."""

SLENDER = 1e-3
"""Inertia of the arm about its own axis over that across it. A choice: nothing turns about it."""

HINGE_HEIGHT = 0.42
"""[m] Height of the hinge, as in the drawing aeropendulum.urdf. A choice."""


@dataclass(frozen=True)
class Mode:
    """The mode of the mast as a body of its own on the hinge of the arm, held to the arm by a spring.

    Attributes:
        inertia: [kg·m²] about the hinge; its centre of mass lies there.
        stiffness: [N·m/rad].
        damping: [N·m·s/rad].
    """

    inertia: float
    stiffness: float
    damping: float


@dataclass(frozen=True)
class Arm:
    """The arm, SI units.

    Attributes:
        lever: distance of the thrust from the hinge.
        centre: distance of the centre of mass.
        mass: of arm and motor.
        inertia: about the hinge, with that of `mode`.
        damping: viscous friction of the hinge.
        friction: dry friction of the hinge.
        stiffness: of the cable.
        rest: angle at which the cable is slack.
        mode: of the mast; None without it.
    """

    lever: float
    centre: float
    mass: float
    inertia: float
    damping: float
    friction: float
    stiffness: float
    rest: float
    mode: Mode | None

    @property
    def about_centre(self) -> float:
        """[kg·m²] Inertia of the arm alone, across its axis, about its centre of mass."""
        own = self.inertia - (self.mode.inertia if self.mode else 0.0)
        return own - self.mass * self.centre**2


def arm(model: Model) -> Arm:
    """The arm of a model.

    Args:
        model: parameters and effects.
    """
    n = model.numbers()
    lever = GRAVITY / n["mgd_over_J"]
    inertia = lever / n["L_over_J"]
    mode, coupling = None, model.effect("mast_flex", "coupling")
    if coupling > 0.0:
        omega, zeta = model.effect("mast_flex", "omega"), model.effect("mast_flex", "zeta")
        own = coupling * inertia
        mode = Mode(own, own * omega**2, 2.0 * own * zeta * omega)
    centre = CENTRE * (1.0 - coupling) * lever
    return Arm(lever, centre, inertia * n["mgd_over_J"] / (GRAVITY * centre), inertia, inertia * n["c_over_J"],
               inertia * model.effect("coulomb_friction", "accel"), inertia * model.effect("cable_torque", "k"),
               model.effect("cable_torque", "theta0"), mode)


HELD = {"mjcf": NATIVE, "sdf": ("coulomb_friction", "cable_torque", "mast_flex"), "urdf": ("coulomb_friction",)}
"""Effects that a description of each kind holds."""

MOTOR = Missing("motor and propeller", "the description takes the thrust (N), not the duty")


def missing(model: Model, kind: str) -> list[Missing]:
    """What a description alone does not hold of a model.

    Args:
        model: parameters and effects.
        kind: `mjcf`, `urdf` or `sdf`.
    """
    found = [Missing(id_, ", ".join(filter(None, (DEFINED[id_].place, DEFINED[id_].physics)))) for id_ in model.effects
             if id_ != PARAMETER_MISMATCH and id_ not in HELD[kind]]
    if kind == "urdf":
        found.append(Missing("gravity", "a URDF has none: the simulator must set 9.81 m/s²"))
    return [MOTOR, *found, SENSORS]


def _number(x: float) -> str:
    return f"{x:.10g}"


def _row(*numbers: float) -> str:
    return " ".join(map(_number, numbers))


def _document(root: ET.Element, model: Model, kind: str) -> str:
    ET.indent(root)
    lines = [line for line in described(model) if not line.startswith("not in it")]
    lines += [f"not in it: {each}" for each in missing(model, kind)]
    comment = "\n".join(f"  {line}" for line in lines).replace("--", "- -")
    return ('<?xml version="1.0"?>\n<!-- SPDX-License-Identifier: Apache-2.0 -->\n'
            f"<!--\n{comment}\n-->\n{ET.tostring(root, encoding='unicode')}\n")


def mjcf(model: Model, period: float = SAMPLE_PERIOD, steps: int = 1) -> str:
    """The arm for MuJoCo.

    Args:
        model: parameters and effects.
        period: [s] time between samples.
        steps: steps of MuJoCo in it.
    """
    a = arm(model)
    root = ET.Element("mujoco", model="aeropendulum")
    ET.SubElement(root, "compiler", angle="radian")
    ET.SubElement(root, "option", timestep=_number(period / steps), gravity=_row(0, 0, -GRAVITY),
                  integrator="implicitfast")
    world = ET.SubElement(root, "worldbody")
    ET.SubElement(world, "light", pos="0 -1 2", dir="0 0.5 -1")
    ET.SubElement(world, "geom", name="mast", type="box", size=_row(0.015, 0.015, 0.5 * HINGE_HEIGHT),
                  pos=_row(0, 0.06, 0.5 * HINGE_HEIGHT), rgba="0.72 0.55 0.36 1", contype="0", conaffinity="0")
    body = ET.SubElement(world, "body", name="arm", pos=_row(0, 0, HINGE_HEIGHT))
    hinge = ET.SubElement(body, "joint", name="arm", type="hinge", axis="0 -1 0", damping=_number(a.damping))
    if a.friction > 0.0:
        hinge.set("frictionloss", _number(a.friction))
    # dry friction nearly without creep; origin: see test_mujoco
    hinge.set("solreffriction", _row(2.0 * period / steps, 1.0))
    hinge.set("solimpfriction", "0.9999 0.9999 0.001")
    if a.stiffness > 0.0:
        hinge.set("stiffness", _number(a.stiffness))
        hinge.set("springref", _number(a.rest))
    across = a.about_centre
    ET.SubElement(body, "inertial", pos=_row(0, 0, -a.centre), mass=_number(a.mass),
                  diaginertia=_row(across, across, SLENDER * across))
    ET.SubElement(body, "geom", name="rod", type="capsule", size="0.004", fromto=_row(0, 0, 0, 0, 0, -a.lever),
                  mass="0", rgba="0.62 0.65 0.7 1", contype="0", conaffinity="0")
    ET.SubElement(body, "geom", name="motor", type="cylinder", size="0.012 0.0225", pos=_row(0.01, 0, -a.lever),
                  zaxis="1 0 0", mass="0", rgba="0.12 0.12 0.14 1", contype="0", conaffinity="0")
    ET.SubElement(body, "site", name="propeller", pos=_row(0.038, 0, -a.lever), zaxis="1 0 0")
    if a.mode is not None:
        mode = ET.SubElement(body, "body", name="mast_mode")
        ET.SubElement(mode, "joint", name="mast_mode", type="hinge", axis="0 -1 0", stiffness=_number(a.mode.stiffness),
                      damping=_number(a.mode.damping))
        ET.SubElement(mode, "inertial", pos="0 0 0", mass=_number(a.mass),
                      diaginertia=_row(a.mode.inertia, a.mode.inertia, a.mode.inertia))
    actuators = ET.SubElement(root, "actuator")
    ET.SubElement(actuators, "motor", name="thrust", joint="arm", gear=_number(a.lever))
    sensors = ET.SubElement(root, "sensor")
    ET.SubElement(sensors, "jointpos", name="theta", joint="arm")
    ET.SubElement(sensors, "jointvel", name="theta_dot", joint="arm")
    return _document(root, model, "mjcf")


def _inertia(parent: ET.Element, across: float) -> None:
    ET.SubElement(parent, "inertia", ixx=_number(across), iyy=_number(across), izz=_number(SLENDER * across), ixy="0",
                  ixz="0", iyz="0")


def urdf(model: Model) -> str:
    """The arm as a URDF; its links and joint are named as in aeropendulum.urdf.

    Args:
        model: parameters and effects.
    """
    a = arm(model)
    root = ET.Element("robot", name="aeropendulum")
    ET.SubElement(root, "link", name="base")
    joint = ET.SubElement(root, "joint", name="arm", type="continuous")
    ET.SubElement(joint, "parent", link="base")
    ET.SubElement(joint, "child", link="rod")
    ET.SubElement(joint, "origin", xyz=_row(0, 0, HINGE_HEIGHT), rpy="0 0 0")
    ET.SubElement(joint, "axis", xyz="0 -1 0")
    ET.SubElement(joint, "dynamics", damping=_number(a.damping), friction=_number(a.friction))
    link = ET.SubElement(root, "link", name="rod")
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", xyz=_row(0, 0, -a.centre), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=_number(a.mass))
    _inertia(inertial, a.inertia - a.mass * a.centre**2)
    visual = ET.SubElement(link, "visual")
    ET.SubElement(visual, "origin", xyz=_row(0, 0, -0.5 * a.lever), rpy="0 0 0")
    ET.SubElement(ET.SubElement(visual, "geometry"), "cylinder", radius="0.004", length=_number(a.lever))
    tip = ET.SubElement(root, "joint", name="tip", type="fixed")
    ET.SubElement(tip, "parent", link="rod")
    ET.SubElement(tip, "child", link="propeller")
    ET.SubElement(tip, "origin", xyz=_row(0, 0, -a.lever), rpy="0 0 0")
    ET.SubElement(root, "link", name="propeller")
    return _document(root, model, "urdf")


def sdf(model: Model) -> str:
    """The arm as an SDF model for Gazebo.

    Args:
        model: parameters and effects.
    """
    a = arm(model)
    root = ET.Element("sdf", version="1.9")
    whole = ET.SubElement(root, "model", name="aeropendulum")

    def text(parent: ET.Element, tag: str, value: str) -> None:
        ET.SubElement(parent, tag).text = value

    def link(name: str, centre: float, mass: float, across: float, along: float) -> ET.Element:
        one = ET.SubElement(whole, "link", name=name)
        text(one, "pose", _row(0, 0, HINGE_HEIGHT, 0, 0, 0))
        inertial = ET.SubElement(one, "inertial")
        text(inertial, "pose", _row(0, 0, -centre, 0, 0, 0))
        text(inertial, "mass", _number(mass))
        inertia = ET.SubElement(inertial, "inertia")
        for tag, value in zip(("ixx", "iyy", "izz", "ixy", "ixz", "iyz"), (across, across, along, 0.0, 0.0, 0.0)):
            text(inertia, tag, _number(value))
        return one

    def hinge(name: str, parent: str, child: str, damping: float, friction: float, stiffness: float, rest: float
              ) -> None:
        joint = ET.SubElement(whole, "joint", name=name, type="revolute")
        text(joint, "parent", parent)
        text(joint, "child", child)
        axis = ET.SubElement(joint, "axis")
        text(axis, "xyz", "0 -1 0")
        dynamics = ET.SubElement(axis, "dynamics")
        for tag, value in (("damping", damping), ("friction", friction), ("spring_stiffness", stiffness),
                           ("spring_reference", rest)):
            text(dynamics, tag, _number(value))

    rod = link("rod", a.centre, a.mass, a.about_centre, SLENDER * a.about_centre)
    visual = ET.SubElement(rod, "visual", name="rod")
    text(visual, "pose", _row(0, 0, -0.5 * a.lever, 0, 0, 0))
    cylinder = ET.SubElement(ET.SubElement(visual, "geometry"), "cylinder")
    text(cylinder, "radius", "0.004")
    text(cylinder, "length", _number(a.lever))
    hinge("arm", "world", "rod", a.damping, a.friction, a.stiffness, a.rest)
    if a.mode is not None:
        link("mast_mode", 0.0, a.mass, a.mode.inertia, a.mode.inertia)
        hinge("mast_mode", "rod", "mast_mode", a.mode.damping, 0.0, a.mode.stiffness, 0.0)
    return _document(root, model, "sdf")


