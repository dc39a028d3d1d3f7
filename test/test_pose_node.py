# SPDX-License-Identifier: Apache-2.0
"""What robot_state_publisher gets of the rig."""

import numpy as np
from evaluation.support.graph import parameters, stamps
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

from aeropend_sim.ros import interface


def test_every_joint_has_a_position_that_moves_as_the_rig_does(graph, start):
    start("plant")
    start("pose", *parameters(rate=20.0))
    with (
        graph.listening(JointState, interface.JOINT_STATES) as measured,
        graph.listening(JointState, interface.POSE) as shown,
        graph.talking(Float64, interface.DUTY_COMMAND) as send,
    ):
        graph.until(lambda: shown, "a pose")
        first = len(measured)
        send(Float64(data=0.4))
        graph.until(lambda: len(measured) > first + 490, "a second of samples")
    positions = np.array([message.position for message in shown])
    assert {tuple(message.name) for message in shown} == {interface.JOINTS}
    assert np.isfinite(positions).all()
    readings = {stamp: message.position[0] for stamp, message in zip(stamps(measured), measured, strict=True)}
    both = [(readings[stamp], shown) for stamp, shown in zip(stamps(shown), positions[:, 0]) if stamp in readings]
    assert len(both) > 10
    assert all(reading == angle for reading, angle in both)
    assert len(set(positions[-5:, 1])) == 5  # the propeller turns
    assert np.diff(stamps(shown)).mean() > 0.04e9  # of 20 a second
