# SPDX-License-Identifier: Apache-2.0
"""The ten commands that read a recording, and command lines for them drawn at random."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np

from aeropend_ident.testing import bags
from aeropend_ident.testing.rigs import BENCH, drawn_rig, steps
from aeropend_sim.model import rig
from aeropend_sim.model.excitation import KINDS
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model, save
from evaluation.fuzz import recordings
from evaluation.fuzz.draw import Draw

EFFECTS = """\
magnetic_detent:
  place: arm
  physics: a magnet pulls the arm towards an angle
  term: -k * (theta - at) * exp(-((theta - at) / width)**2)
  parameters:
    k: {unit: 1/s^2, default: 20, low: 0, high: 500, description: stiffness over inertia}
    at: {unit: rad, default: 0.4, low: -1.5, high: 1.5}
    width: {unit: rad, default: 0.15, low: 0.02, high: 1}
"""
MODELS = ("v_full.yaml", "reverse.yaml", "augmented.yaml")


def prepare(folder: Path) -> None:
    """Write the models, the effects and the earlier recording that the command lines name into a folder."""
    numbers = {name: value for name, value in BENCH.model.items() if name not in ("k0", "k1", "k2", "k3")}
    save(Model("v_full", {**numbers, "v_full": 3.0}, BENCH.sensing, {}), folder / "v_full.yaml", "drawn")
    save(Model("reverse", {**BENCH.model, "reverse": 1.0}, BENCH.sensing, {}), folder / "reverse.yaml", "drawn")
    save(drawn_rig(5, {"coulomb_friction": {}}), folder / "augmented.yaml", "drawn")
    (folder / "effects.yaml").write_text(EFFECTS, encoding="utf-8")
    duty = steps(12.0, 5)
    columns = {**rig.record(drawn_rig(5, {"coulomb_friction": {}}), duty, 5)[0], "duty": duty}
    bags.write(folder / "monday", columns, round(SAMPLE_PERIOD * 1e9))


Words = Callable[[Draw, Sequence[Path], Path], list[str]]
"""From draws, recordings and the folder that `prepare` filled to a command line; results go into the current folder."""


def model(draw: Draw, files: Path, probability: float) -> list[str]:
    """A model, sometimes none or not one."""
    return draw.option(probability, "--model",
                       ["thesis", *(files / name for name in MODELS), "nonsense", files / "effects.yaml"])


def diagnose(draw: Draw, bags: Sequence[Path], files: Path) -> list[str]:
    """One or several recordings, calibrated or not, with little time."""
    first, *others = map(str, bags)
    words = [first, *draw.some(0.35, "--uncalibrated")]
    kind = draw.pick("one", "one", "one", "several", "test", "each", "since", "effects", "model")
    if kind in ("several", "each"):
        words += [*others, *(["--each"] if kind == "each" else [])]
    elif kind == "test" and others:
        words += ["--test", others[0]]
    elif kind == "since":
        words = [first, "--since", str(files / "monday")]
    elif kind == "effects":
        words += ["--effects", str(files / "effects.yaml")]
    elif kind == "model":
        words += model(draw, files, 1.0)
    return [*words, "--seconds", str(draw.pick(0, 0.2, 0.2, 0.2, 1, 3)), "--jobs", draw.pick("1", "1", "1", "2"),
            *draw.option(0.25, "--held-out", [0.3, 0.05, 0.8, 0.5, "nan", 0]),
            *draw.option(0.15, "--material", [0, 1, 0.03, "nan"]),
            *draw.option(0.05, "--namespace", ["rig1", "/", "none"]), "--out", "out"]


def identify(draw: Draw, bags: Sequence[Path], files: Path) -> list[str]:
    """All methods, with libraries of few terms."""
    return [str(bags[0]), "--method", draw.pick("sindy", "weak", "weak", "discrepancy-sindy", "discrepancy-weak"),
            *draw.option(0.85, "--terms", [
                "sin(theta),theta_dot,omega*omega,i_a,omega,v_a", "1", "sin(theta),theta_dot,omega^1.8,i_a,omega,v_a",
                "theta^-1", "log(theta)", "omega^300", "omega^0.5,omega^-2", "theta*theta_dot*omega*i_a",
                "abs(omega)*omega,sign(theta_dot),cos(theta)", "", "x", "duty"]),
            *draw.option(0.3, "--states", ["theta,theta_dot", "theta,theta_dot,omega", "omega,i_a", "i_a", "theta", "",
                                           "v_a", "x", "theta,theta", "theta_dot"]),
            *draw.option(0.3, "--input", ["duty", "v_a", "omega", "duty,v_a", "", "theta", "x", "i_a"]),
            *draw.option(0.3, "--derivative", ["smoothed", "smoothed", "tv", "tv", "x"]),
            *model(draw, files, 0.3), *draw.option(0.3, "--held-out", [0.05, 0.8, 0.25, "nan", 1]), "--out", "out"]


def replay(draw: Draw, bags: Sequence[Path], _files: Path) -> list[str]:
    """At all speeds, from anywhere, with and without subscribers."""
    settings = [f"rate:={draw.pick(1000.0, 1000.0, 50.0, 1.0, 0.001)}", f"subscribers:={draw.pick(0, 0, 0, 1)}",
                f"wait:={draw.pick(0.0, 0.5)}"]
    for name, values in (("start", [0.0, 1.0, 1e9, 0.001, -1.0]), ("loop", ["true", "false"]),
                         ("topics", ["duty_command", "joint_states,armature", "none"]), ("clock", [100.0, 1000.0]),
                         ("stop_duty", ["false"]), ("namespace", ["/rig1", "/none"])):
        if draw.chance(0.15):
            settings.append(f"{name}:={draw.pick(*values)}")
    return [str(bags[0]), "--ros-args", *(word for one in settings for word in ("-p", one)),
            *draw.some(0.1, "-r", "__ns:=/rig2")]


def step_response(draw: Draw, bags: Sequence[Path], _files: Path) -> list[str]:
    """All laws, with and without a plot."""
    return [str(bags[0]), *draw.option(0.4, "--law", ["small_signal", "feedback_linearization", "cascade",
                                                      "feedback_linearization_cascade", "x"]),
            *draw.some(0.7, "--plot", "out.svg")]


def bench_test(draw: Draw, bags: Sequence[Path], files: Path) -> list[str]:
    """Any of the tests, with any of the recordings."""
    tests = ("--blocked-rotor", "--current-step", "--steady", "--duty-map", "--thrust")
    chosen = [name for name in tests if draw.chance(0.45)] or [draw.pick(*tests)]
    return [*(word for name in chosen for word in (name, str(draw.pick(*bags)))), *model(draw, files, 0.2),
            "--out", "out"]


def recover(draw: Draw, bags: Sequence[Path], _files: Path) -> list[str]:
    """A folder, or its file, which is often broken off or has wrong bytes."""
    if draw.chance(0.5):
        return [str(bags[0]), "--out", "out"]
    file = next(path for path in sorted(bags[0].iterdir()) if path.suffix in (".mcap", ".db3"))
    data, damage = bytearray(file.read_bytes()), draw.pick("none", "end", "end", "bytes")
    if damage == "end":
        del data[int(draw.rng.integers(len(data))):]
    elif damage == "bytes":
        for at in draw.rng.integers(len(data), size=int(draw.rng.integers(1, 20))):
            data[at] = int(draw.rng.integers(256))
    file.write_bytes(data)
    return [str(file), "--out", "out"]


def excitation_quality(draw: Draw, bags: Sequence[Path], files: Path) -> list[str]:
    """A recording, seldom an experiment that is only planned."""
    if draw.chance(0.93):
        return [str(bags[0]), *model(draw, files, 0.3)]
    values = ["0", "1", "-1", "nan", "inf", "0.5", "3", "1e-9", "x"]
    return [*model(draw, files, 0.3), "--duration", draw.pick("5", "5", "5", *values),
            *(word for name in ("--duty-min", "--duty-max", "--hold-min", "--hold-max", "--rest")
              for word in draw.option(0.2, name, values)),
            *draw.option(0.4, "--kind", [*KINDS, "x"])]


def isolate(draw: Draw, bags: Sequence[Path], files: Path) -> list[str]:
    """A recording whose duty, channels and noise are taken."""
    return [str(bags[0]), *draw.some(0.9, "--no-sensors"), *model(draw, files, 0.3), "--jobs", "1",
            *draw.option(0.5, "--channels", ["theta", "omega", "i_a", "v_a", "x"]), *draw.some(0.3, "--json"),
            *draw.option(0.4, "--size", ["brush_drop=0.1", "brush_drop=nan", "brush_drop=-1", "x=1",
                                         "thrust_lag=1e300"]),
            *draw.option(0.15, "--effects", [str(files / "effects.yaml")])]


def design(draw: Draw, bags: Sequence[Path], files: Path) -> list[str]:
    """A recording whose channels and noise are taken, with any limits."""
    numbers = ["0.5", "1", "2", "5", "nan", "-0.2", "1e300", "x"]
    pairs = [word for name in ("--theta", "--duty") if draw.chance(0.3)
             for word in (name, draw.pick("-1", "-0.2", "0", "nan"), draw.pick("1", "0.5", "0.01", "x"))]
    length = draw.option(0.1, "--duration", numbers) or ["--duration", "5"]
    return [str(bags[0]), "--tries", "2", "--jobs", "1", *length,
            *model(draw, files, 0.3), *pairs,
            *(word for name in ("--speed", "--current", "--duty-rate") for word in draw.option(0.1, name, numbers)),
            *draw.option(0.4, "--separate", ["thrust_lag", "gust", "parameter_mismatch:K_t", "mast_flex", "x"]),
            *draw.option(0.1, "--fix", ["K_t", "k0", "R_a"]), *draw.some(0.3, "--json"), *draw.some(0.3, "--overwrite"),
            *draw.option(0.3, "--size", ["brush_drop=0.1", "brush_drop=nan", "thrust_lag=1e300", "thrust_lag=1e-9"]),
            *draw.option(0.3, "--html", ["page.html", "nowhere/page.html"]),
            *draw.option(0.15, "--effects", [str(files / "effects.yaml")])]


def import_(draw: Draw, bags: Sequence[Path], files: Path) -> list[str]:
    """A recording, or a table of one, with any options."""
    if draw.chance(0.35):
        return _table(draw, bags, files)
    words = [str(bags[0]), "out"]
    for name, values in _MAPPINGS.items():
        words += draw.option(0.25, name, values)
    words += [*draw.some(0.3, "--flip"), *draw.some(0.1, "--motor-off"), *draw.some(0.1, "--skip-bad"),
              *draw.option(0.3, "--zero", ["start", "end", "0.4", "-83deg", "nan", "1e300", "x", "inf"]),
              *draw.option(0.15, "--supply", ["12V", "0V", "nan", "12", "-3V", "1e300V"]),
              *draw.option(0.15, "--both-ways", ["reverse", "brake", "clip"]),
              *draw.option(0.2, "--clock", ["even", "stamps", "auto"])]
    if "--time" not in words:
        words += draw.option(0.1, "--rate", ["490", "0.1", "1e6", "nan", "0"])
    return words if len(words) > 2 else [*words, "--flip"]


_MAPPINGS = {
    "--theta": ["theta:deg", "theta:rad", "theta:turn", "omega:rad", "theta:-1rad", "theta:1e300rad",
                "theta:counts:4096", "none:rad", "theta:x", "theta:nan rad", "theta:54deg", "arm:rad", "pendulum:deg"],
    "--omega": ["omega:rpm", "theta:rad/s", "omega:-1rad/s", "omega:1e-300rpm"],
    "--current": ["i_a:mA", "v_a:A", "i_a:-4.9mA"], "--voltage": ["v_a:mV", "i_a:V", "duty:V"],
    "--duty": ["duty:%", "duty:1", "duty:counts:255", "v_a:V", "i_a:1", "reference:1", "duty:V"],
    "--time": ["t:s", "t:ms", "t:ns", "theta:s", "t:day"],
    "--reference": ["reference:deg", "theta:rad", "reference:rad/s"]}


def _table(draw: Draw, _bags: Sequence[Path], _files: Path) -> list[str]:
    """A table with the columns of a recording, in the habits of other programs."""
    content = recordings.recorded(draw, 20.0, draw.chance(0.5))
    recordings.change(draw, content, True)
    seconds, nanoseconds = content.stamps["joints"]
    with np.errstate(all="ignore"):
        time = ((seconds - recordings.START_NS // 10**9) + nanoseconds * 1e-9) * draw.pick(1.0, 1.0, 1e3, 1e6)
    columns = {"t": time, **content.columns}
    titles = {"t": ("t", "time", "time [ms]", "t/s", "Zeit"), "theta": ("theta", "angle", "angle [deg]", "Winkel"),
              "omega": ("omega", "rpm", "speed"), "i_a": ("i", "current [mA]", "i_a"), "v_a": ("u", "voltage", "v_a"),
              "duty": ("duty", "pwm", "pwm [%]", "u")}
    between, point = draw.pick((",", "."), (";", ","), ("\t", "."))
    empty = draw.pick(["nan"], ["NaN", "inf", "-inf", "1e999"], ["", "n/a"], ["-"])
    form = draw.pick("%.6g", "%.10g", "%.3f")
    lines = [] if draw.chance(0.15) else [between.join(draw.pick(*titles[name]) for name in columns)]
    for row in range(content.n):
        cells = [(form % value[row] if np.isfinite(value[row]) else empty[row % len(empty)]).replace(".", point)
                 for value in columns.values()]
        lines.append(between.join(cells[:-1] if draw.chance(0.0005) else cells))
    Path("run.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    if draw.chance(0.5):
        return ["run.csv", "out", "--accept", *draw.pick([], ["--flip"], ["--supply", "12V"])]
    return ["run.csv", "out", *draw.option(0.7, "--time", ["1:s", "1:ms", "1:us"]),
            *draw.option(0.7, "--theta", ["2:rad", "2:deg"]), *draw.option(0.7, "--duty", ["6:1", "6:%", "6:V"]),
            *draw.option(0.7, "--omega", ["3:rad/s", "3:rpm"])]


def doctor(draw: Draw, bags: Sequence[Path], files: Path) -> list[str]:
    """Recordings, sometimes a model file."""
    return [*map(str, bags if draw.chance(0.3) else bags[:1]), *model(draw, files, 0.2),
            *draw.some(0.1, str(files / "augmented.yaml"))]


@dataclass(frozen=True)
class Command:
    """How a command is tried.

    Attributes:
        module: where its `main` is.
        words: draws a command line.
        mildness: share of recordings that it can often use.
        longest: [s] length of recordings.
        references: share of recordings with references.
        several: share of runs with three recordings.
        kinds: of experiments.
        first: arguments of a first run, which loads what is compiled, so that each case need not; None: no such run.
    """

    module: str
    words: Words
    mildness: float = 0.2
    longest: float = 40.0
    references: float = 0.35
    several: float = 0.0
    kinds: tuple[str, ...] = recordings.KINDS
    first: tuple[str, ...] | None = None

    def load(self, files: Path) -> None:
        """Load its modules, and run it once if it is slow to start.

        Args:
            files: what `prepare` wrote; results go there.
        """
        main = import_module(self.module).main
        if self.first is not None:
            with redirect_stdout(io.StringIO()):
                main([str(files / "monday"), *(word.format(files=files) for word in self.first)])

    def run(self, words: list[str]) -> int:
        """Run it in this process; returns its exit code, or raises what it raises."""
        code: int = import_module(self.module).main(words)
        return code


_COMMANDS = "aeropend_ident.commands"
COMMANDS = {
    "diagnose": Command(f"{_COMMANDS}.diagnose", diagnose, mildness=0.65, several=0.4,
                        first=("--seconds", "1", "--jobs", "1", "--out", "{files}/verdict")),
    "identify": Command(f"{_COMMANDS}.identify", identify, mildness=0.65, longest=60.0,
                        first=("--method", "weak", "--terms", "sin(theta),omega,v_a", "--out", "{files}/found")),
    "replay": Command("aeropend_ident.nodes.replay", replay),
    "step_response": Command(f"{_COMMANDS}.step_response", step_response, references=0.9, longest=400.0),
    "bench_test": Command(f"{_COMMANDS}.bench", bench_test, mildness=0.65, several=0.4, longest=120.0,
                          kinds=("staircase", "staircase", "steps", "constant", "free decay")),
    "recover": Command(f"{_COMMANDS}.recover", recover),
    "excitation_quality": Command(f"{_COMMANDS}.excitation_quality", excitation_quality, mildness=0.65,
                                  first=()),
    "design": Command(f"{_COMMANDS}.design", design, mildness=0.65, longest=20.0),
    "isolate": Command(f"{_COMMANDS}.isolate", isolate, mildness=0.65, longest=20.0),
    "import": Command(f"{_COMMANDS}.import_table", import_),
    "doctor": Command(f"{_COMMANDS}.doctor", doctor, mildness=0.65, several=0.4, first=()),
}
