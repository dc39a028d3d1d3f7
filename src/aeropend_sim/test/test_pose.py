# SPDX-License-Identifier: Apache-2.0
"""The drawing of the rig moves as the rig does."""

import math
import re
import subprocess
import xml.etree.ElementTree as ET
from importlib.resources import files

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aeropend_sim.model.parameters import load
from aeropend_sim.nodes.pose import PAUSE_S, Rotor
from aeropend_sim.ros import interface

URDF = files("aeropend_sim").joinpath("urdf/aeropendulum.urdf")
ROBOT = ET.fromstring(URDF.read_text(encoding="utf-8"))
JOINTS = {joint.get("name"): joint for joint in ROBOT.iter("joint")}
G = 9.81


def numbers(joint, tag, attribute="xyz"):
    found = joint.find(tag)
    return np.array((found.get(attribute, "0 0 0") if found is not None else "0 0 0").split(), float)


def placed(theta, rotor=0.0):
    """Rotation and origin of each link in the root's frame, by the rules of URDF."""
    links = {"base": (Rotation.identity(), np.zeros(3))}
    for name, angle in (("arm", theta), ("rotor", rotor)):
        joint = JOINTS[name]
        parent, origin = links[joint.find("parent").get("link")]
        turn = Rotation.from_rotvec(angle * numbers(joint, "axis"))  # no joint's origin is turned
        links[joint.find("child").get("link")] = (parent * turn, origin + parent.apply(numbers(joint, "origin")))
    return links


@pytest.mark.promise("Views", "The 3D model moves as the rig does")
def test_joints_are_named_as_in_joint_states():
    assert tuple(JOINTS) == interface.JOINTS
    assert not any(numbers(joint, "origin", "rpy").any() for joint in JOINTS.values())  # `placed` relies on it
    assert [joint.get("type") for joint in JOINTS.values()] == ["revolute", "continuous"]
    for joint in JOINTS.values():
        assert np.linalg.norm(numbers(joint, "axis")) == pytest.approx(1.0)
    links = {link.get("name") for link in ROBOT.iter("link")}
    assert {joint.find(end).get("link") for joint in JOINTS.values() for end in ("parent", "child")} == links
    named = {material.get("name") for material in ROBOT.findall("material")}
    assert {material.get("name") for material in ROBOT.iter("material")} == named


@pytest.mark.promise("Views", "Drawing and bags are read by the libraries of RViz and Foxglove")
def test_the_parser_of_rviz_and_robot_state_publisher_takes_the_drawing():
    """check_urdf is urdfdom, which both read a drawing with."""
    done = subprocess.run(["check_urdf", str(URDF)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.findall(r"child\(\d\): +(\w+)", done.stdout) == ["rod", "propeller"]
    assert not re.search("warning|error", done.stdout + done.stderr, re.IGNORECASE)


@pytest.mark.promise("Views", "The 3D model moves as the rig does")
def test_the_arm_hangs_at_0_and_is_level_in_front_at_a_quarter_turn():
    pivot = placed(0.0)["rod"][1]
    end = numbers(JOINTS["rotor"], "origin")[2]
    length = -end
    assert length == pytest.approx(G / load("bench").model["mgd_over_J"], abs=0.005)
    for theta, tip in ((0.0, (0, 0, -length)), (math.pi / 2, (length, 0, 0)), (math.pi, (0, 0, length))):
        assert placed(theta)["rod"][0].apply([0, 0, end]) == pytest.approx(tip, abs=1e-9)
    assert pivot[2] > length  # it does not hit the ground


@pytest.mark.parametrize("theta", [-0.5, 0.0, 0.7, 2.0])
def test_the_propeller_pulls_the_way_in_which_theta_grows(theta):
    def at(angle):
        return placed(angle)["propeller"][1]

    motion = at(theta + 1e-6) - at(theta - 1e-6)
    turned, _ = placed(theta)["propeller"]
    thrust = turned.apply(numbers(JOINTS["rotor"], "axis"))
    assert thrust @ motion / np.linalg.norm(motion) > 0.99


def test_the_rotor_turns_with_its_speed_over_the_stamps():
    rotor = Rotor(slow=2.0)
    step = round(0.02e9)
    angles = [rotor.turn(k * step, 100.0) for k in range(51)]
    assert angles[0] == 0.0
    assert angles[1] == pytest.approx(1.0)
    assert angles[-1] == pytest.approx(math.remainder(50.0, 2 * math.pi))
    assert max(map(abs, angles)) <= math.pi


def test_the_rotor_stays_where_its_motion_is_not_known():
    rotor = Rotor()
    rotor.turn(10**9, 100.0)
    for stamp, omega in ((10**9 + 10**7, math.nan), (10**9 + 2 * 10**7, math.inf), (10**9 + 3 * 10**7, 1e300),
                         (10**9, 100.0), (10**9 + round(2e9 * PAUSE_S), 100.0)):
        assert rotor.turn(stamp, omega) == 0.0
