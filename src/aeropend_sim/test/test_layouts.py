# SPDX-License-Identifier: Apache-2.0
"""The layouts for Foxglove and PlotJuggler show readings, by the names that these tools give them."""

import json
import re
import xml.etree.ElementTree as ET
from importlib.resources import files

import pytest
from std_msgs.msg import Float64

from aeropend_sim.ros import interface

LAYOUTS = files("aeropend_sim").joinpath("layouts")
MESSAGES = {
    interface.JOINT_STATES: interface.joint_states_message(0, theta=0.1, omega=100.0),
    interface.ARMATURE: interface.armature_message(0, v_a=1.5, i_a=0.5, duty=0.25),
    interface.REFERENCE: Float64(data=0.3),
    interface.DUTY_COMMAND: Float64(data=0.2),
}
SHOWN = [0.1, 0.3, 100.0, 1.5, 0.5, 0.25, 0.2]
"""Angle and reference, rotor speed, voltage, current, duty applied and commanded."""


def in_foxglove(path):
    """What a message path stands for: /topic.field or /topic.field[index]."""
    topic, field, index = re.fullmatch(r"/(\w+)\.(\w+)(?:\[(\d+)\])?", path).groups()
    value = getattr(MESSAGES[topic], field)
    return value if index is None else value[int(index)]


def in_plotjuggler(name):
    """What a curve stands for: of a JointState /topic/joint/field, of others /topic/field."""
    _, topic, *rest = name.split("/")
    if topic == interface.JOINT_STATES:
        joint, field = rest
        return getattr(MESSAGES[topic], field)[MESSAGES[topic].name.index(joint)]
    (field,) = rest
    return getattr(MESSAGES[topic], field)


def panels(node):
    return [node] if isinstance(node, str) else panels(node["first"]) + panels(node["second"])


@pytest.mark.promise("Views", "The layouts for Foxglove and PlotJuggler show what the rig measures")
def test_foxglove_plots_what_the_rig_measures():
    layout = json.loads(LAYOUTS.joinpath("foxglove.json").read_text(encoding="utf-8"))
    assert sorted(panels(layout["layout"])) == sorted(layout["configById"])
    kinds = {"3D", "Plot", "DiagnosticSummary", "Publish", "CallService"}
    assert {panel.split("!")[0] for panel in layout["configById"]} == kinds
    plots = [layout["configById"][panel] for panel in panels(layout["layout"]) if panel.startswith("Plot!")]
    paths = [path for plot in plots for path in plot["paths"]]
    assert [in_foxglove(path["value"]) for path in paths] == pytest.approx(SHOWN)
    stamped = {hasattr(MESSAGES[path["value"][1:].split(".")[0]], "header"): path["timestampMethod"] for path in paths}
    assert stamped == {True: "headerStamp", False: "receiveTime"}


def test_foxglove_talks_to_the_rig_by_its_names():
    configs = json.loads(LAYOUTS.joinpath("foxglove.json").read_text(encoding="utf-8"))["configById"]
    publish, call = configs["Publish!reference"], configs["CallService!off"]
    assert publish["topicName"] == f"/{interface.REFERENCE}"
    assert json.loads(publish["value"]).keys() == Float64.get_fields_and_field_types().keys()
    assert call["serviceName"] == f"/{interface.ENABLE}"
    assert json.loads(call["requestPayload"]) == {"data": False}
    assert configs["DiagnosticSummary!nodes"]["topicToRender"] == interface.DIAGNOSTICS
    urdf = ET.fromstring(files("aeropend_sim").joinpath("urdf/aeropendulum.urdf").read_text(encoding="utf-8"))
    assert configs["3D!rig"]["followTf"] in {link.get("name") for link in urdf.iter("link")}


@pytest.mark.promise("Views", "The layouts for Foxglove and PlotJuggler show what the rig measures")
def test_plotjuggler_plots_what_the_rig_measures():
    root = ET.fromstring(LAYOUTS.joinpath("plotjuggler.xml").read_text(encoding="utf-8"))
    values = [in_plotjuggler(curve.get("name")) for curve in root.iter("curve")]
    assert values == pytest.approx(SHOWN)
    (splitter,) = root.iter("DockSplitter")
    shares = [float(share) for share in splitter.get("sizes").split(";")]
    assert int(splitter.get("count")) == len(splitter) == len(shares)
    assert sum(shares) == pytest.approx(1.0)
    assert all([child.tag for child in area] == ["plot"] for area in splitter)
