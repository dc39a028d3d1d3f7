# SPDX-License-Identifier: Apache-2.0
"""Fit of the preset `bench` to the rig's measured step: `python -m aeropend_sim.studies.bench_fit [--plot FILE]`.

The thesis gives four features of a step from rest to a duty of 0.4314 (6.2, Fig 6.1) and, separately, the natural
frequency of the arm (4.3.1). No other bench test gives the four parameters `mgd_over_J`, `c_over_J`, `L_over_J` and
`J_m`. They are fitted by least squares to the five measurements and a guess of J_m. Each residual is in units of the
standard deviation of its target (`TARGETS`). The simulated step passes the angle filter, as in the measurement.

The fit cannot meet all targets. The measured t_r/t_p is 0.51. In a plant of this structure that overshoots by more than
10 % the ratio stays below 0.44 for all values of the four parameters. Without the target of the frequency, t_p would
still be 7 % late and t_r 7 % early, with mgd/J = 45 (6.7 rad/s) and almost no overshoot. So θ_ss and t_s are met, t_r
is early and t_p is late. The rig has an effect that the nominal model lacks; the catalogue of effects has candidates.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from aeropend_sim.cli.command import EXIT_CODES, Parser, entry_point
from aeropend_sim.errors import UserError
from aeropend_sim.model import actuator
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model, load
from aeropend_sim.model.rig import record
from aeropend_sim.model.step_features import step_features

Array = NDArray[np.float64]

DUTY = 0.4314
"""Duty of the measured step, from rest (thesis 6.2)."""

DURATION = 8.0
"""[s] Simulated time. A choice."""

START = {"mgd_over_J": 29.8, "c_over_J": 2.3, "L_over_J": 87.6, "J_m": 1.0e-5}
"""Start of the fit: mgd/J from the natural frequency of 5.46 rad/s, and guesses."""


class Target(NamedTuple):
    """A target of the fit: its value, the standard deviation of its logarithm, and the reason."""

    value: float
    sigma: float
    why: str


TARGETS = {
    "final": Target(0.54, 0.01, "rad, printed to 0.01; an encoder step is 0.006"),
    "peak_time": Target(0.84, 0.05, "s; one encoder step at the flat top is 45 ms"),
    "rise_time": Target(0.43, 0.05, "s, 10 to 90 %"),
    "settling_time": Target(3.53, 0.10, "s, 2 %: two encoder steps; it jumps by half a swing"),
    "natural_frequency": Target(5.46, 0.05, "rad/s, sqrt(mgd/J); printed without its angle: 8 % lower at 0.54 rad"),
    "J_m": Target(1.0e-5, 0.69, "kg·m², a guess within a factor of 2"),
}


def with_numbers(base: Model, numbers: Mapping[str, float]) -> Model:
    """`base` with some parameters replaced, and with an angle sensor without noise and quantisation.

    Args:
        base: the model.
        numbers: new values by name.
    """
    sensing = {**base.sensing, "angle_lsb": 0.0, "angle_noise": 0.0}
    return Model(base.name, {**base.model, **numbers}, sensing)


def step(model: Model) -> tuple[Array, Array]:
    """Time (N,) in s and angle read (N,) in rad of the step from rest to `DUTY`."""
    n = round(DURATION / SAMPLE_PERIOD)
    read, _ = record(model, np.full(n, DUTY))
    return SAMPLE_PERIOD * np.arange(n, dtype=float), read["theta"]


def features(base: Model, numbers: Mapping[str, float]) -> dict[str, float]:
    """The quantities of `TARGETS`, and the overshoot, of a model.

    Args:
        base: the model.
        numbers: values that replace those of `base`, by name.
    """
    model = with_numbers(base, numbers)
    found = step_features(*step(model), float(actuator.static_angle(model.model, DUTY)))
    return {**found._asdict(), "natural_frequency": math.sqrt(model.model["mgd_over_J"]), "J_m": model.model["J_m"]}


def cost(found: Mapping[str, float]) -> float:
    """Sum of squared residuals; infinite if the step lacks a feature."""
    if any(math.isnan(found[name]) for name in TARGETS):
        return math.inf
    return sum((math.log(found[name] / target.value) / target.sigma)**2 for name, target in TARGETS.items())


def fit(base: Model) -> dict[str, float]:
    """The four parameters that meet `TARGETS` best; deterministic.

    The settling time is discontinuous, so a simplex search is used. It is restarted at its result until the cost stays.
    """
    def objective(logs: Array) -> float:
        return cost(features(base, dict(zip(START, np.exp(logs).tolist(), strict=True))))

    best, value = np.log(list(START.values())), math.inf
    while True:
        simplex = np.vstack([best, best + 0.2 * np.eye(4)])
        found = minimize(objective, best, method="Nelder-Mead",
                         options={"initial_simplex": simplex, "xatol": 1e-5, "fatol": 1e-6, "maxiter": 2000})
        if not found.fun < value - 1e-4:
            return dict(zip(START, np.exp(best).tolist(), strict=True))
        best, value = found.x, found.fun


def rounded(numbers: Mapping[str, float]) -> dict[str, float]:
    """The parameters to three digits, as in the preset."""
    return {name: float(f"{value:.2e}") for name, value in numbers.items()}


def table(base: Model, fitted: Mapping[str, float]) -> str:
    """A table of the measurements, the start and the fit.

    Args:
        base: the model.
        fitted: the fitted parameters by name.
    """
    columns = {"before": features(base, START), "fitted": features(base, rounded(fitted))}
    lines = [f"Step to a duty of {DUTY} from rest", "",
             f"{'':18}{'measured':>10}{'before':>10}{'fitted':>10}{'error':>8}{'known to':>10}"]
    for name, target in TARGETS.items():
        before, after = columns["before"][name], columns["fitted"][name]
        lines.append(f"{name:18}{target.value:10.4g}{before:10.4g}{after:10.4g}{after / target.value - 1.0:+8.0%}"
                     f"{target.sigma:10.0%}  {target.why}")
    before, after = columns["before"]["overshoot"], columns["fitted"]["overshoot"]
    lines.append(f"{'overshoot':18}{'-':>10}{before:10.3f}{after:10.3f}{'':18}  not printed and not fitted; "
                 "Table 6.1 asks for at most 0.2")
    lines.append(f"{'sum of squares':18}{'':10}{cost(columns['before']):10.1f}{cost(columns['fitted']):10.1f}")
    lines += ["", f"{'':18}{'':10}{'before':>10}{'fitted':>10}   rounded (config/bench.yaml)"]
    lines += [f"{name:18}{'':10}{START[name]:10.4g}{value:10.4g}   {rounded(fitted)[name]:g}"
              for name, value in fitted.items()]
    return "\n".join(lines)


def plot(base: Model, fitted: Mapping[str, float], path: Path) -> None:
    """Save a picture of the step before and after the fit, with the measured features.

    Args:
        base: the model.
        fitted: the fitted parameters by name.
        path: of the picture.

    Raises:
        ImportError: matplotlib is not installed.
        OSError: the picture cannot be written.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    final, t_r, t_p, t_s = (TARGETS[name].value for name in ("final", "rise_time", "peak_time", "settling_time"))
    figure, axes = plt.subplots(figsize=(9.0, 4.5), layout="constrained")
    axes.axhspan(0.98 * final, 1.02 * final, color="0.92", label=f"measured: θ_ss {final} rad (band: ± 2 %), "
                 f"t_r {t_r}, t_p {t_p}, t_s {t_s} s")
    axes.axhline(final, color="0.6", linewidth=0.8)
    for label, numbers, colour in (("before", START, "tab:orange"), ("fitted", rounded(fitted), "tab:blue")):
        model = with_numbers(base, numbers)
        time, theta = step(model)
        found = step_features(time, theta, float(actuator.static_angle(model.model, DUTY)))
        axes.plot(time, theta, color=colour, label=f"{label}: θ_ss {found.final:.3f} rad, t_r {found.rise_time:.2f}, "
                  f"t_p {found.peak_time:.2f}, t_s {found.settling_time:.2f} s")
        for moment in (found.peak_time, found.settling_time):
            axes.plot(moment, np.interp(moment, time, theta), "o", color=colour)
        rise = np.interp([0.1 * found.final, 0.9 * found.final], *_first_rise(time, theta))
        axes.plot(rise, [0.1 * found.final, 0.9 * found.final], "s", color=colour, markersize=4)
    middle = float(np.mean(rise))
    axes.plot([middle - 0.5 * t_r, middle + 0.5 * t_r], [0.5 * final] * 2, "k|-", linewidth=1.0)
    axes.annotate(f"measured t_r {t_r} s", (middle + 0.5 * t_r, 0.5 * final), xytext=(4, -4),
                  textcoords="offset points")
    for name, moment in (("t_p", t_p), ("t_s", t_s)):
        axes.axvline(moment, color="k", linestyle=":", linewidth=1.0)
        axes.annotate(f"measured {name} {moment} s", (moment, 0.1), xytext=(4, 0), textcoords="offset points")
    axes.set(xlim=(0.0, 5.0), ylim=(0.0, None), xlabel="time since the step / s", ylabel="θ / rad",
             title="bench: step to a duty of 0.4314 (squares: 10 and 90 %; dots: peak and settled)")
    axes.legend(loc="upper right")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _first_rise(time: Array, y: Array) -> tuple[Array, Array]:
    top = int(np.argmax(y)) + 1
    return np.maximum.accumulate(y[:top]), time[:top]


@entry_point("bench_fit")
def main(arguments: list[str] | None = None) -> int:
    """Fit, print the table and save the picture; the exit code."""
    parser = Parser(prog="bench_fit", description="Fits the preset bench to the measured step.",
                    epilog=f"examples:\n  python -m aeropend_sim.studies.bench_fit --plot step.png\n\n{EXIT_CODES}",
                    formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plot", type=Path, metavar="FILE", help="save a picture of the step (needs matplotlib)")
    path: Path | None = parser.parse_args(arguments).plot
    if path is not None and path.exists():
        raise UserError(f"{path}: it exists; name another or remove it")
    base = load("bench")
    fitted = fit(base)
    print(table(base, fitted))
    try:
        if path is not None:
            plot(base, fitted, path)
    except ImportError:
        raise UserError("--plot needs matplotlib: pip install matplotlib") from None
    except (OSError, ValueError) as error:  # ValueError: matplotlib does not know this kind of file
        raise UserError(f"{path}: {getattr(error, 'strerror', None) or error}") from None
    return 0


if __name__ == "__main__":
    sys.exit(main())
