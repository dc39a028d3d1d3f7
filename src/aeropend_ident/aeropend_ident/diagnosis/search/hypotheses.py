# SPDX-License-Identifier: Apache-2.0
"""The hypotheses: each effect of the catalogue, and each parameter of the model that may be far off."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aeropend_ident.diagnosis.chain.chain import DELAY, CutChain, CutChains
from aeropend_ident.diagnosis.chain.known import Known
from aeropend_ident.diagnosis.chain.priors import (
    CHOSEN,
    FINDINGS,
    SIZE_SD,
    initial_states,
    model_parameters,
    usual_size,
)
from aeropend_ident.diagnosis.chain.values import FEWEST_PARAMETERS, PLACE_OF_PARAMETER, STAGES, limits
from aeropend_ident.diagnosis.policy import angle_only
from aeropend_ident.estimation.parameter import Parameter, key
from aeropend_sim.model.effects import CATALOGUE, DEFINED, PARAMETER_MISMATCH, RANDOM, EffectParameter
from aeropend_sim.model.forms import FORMS
from aeropend_sim.model.parameters import Model

MISMATCH_SD = 0.3
"""Relative standard deviation of a parameter that `parameter_mismatch` blames.

Choice: ten times that of a calibrated one.

Measured: at ±30 % no verdict of 20 recordings changes (docs/results/thresholds.md)."""

EFFECT_ODDS = 1.0 / 50.0
"""Prior odds of one given effect against no further effect: about even for the catalogue as a whole (choice).

`parameter_mismatch` shares them among its parameters.

Measured: at ±30 % no verdict of 23 recordings changes (docs/results/thresholds.md)."""

FIRST_SIZE = 0.3
"""Size, in default sizes, from which a search starts (choice).

Measured: at ±30 % no verdict of 25 recordings changes (docs/results/thresholds.md)."""

SIZES = (0.3, 1.0, 3.0)
"""Sizes, in default sizes, from which the search of a form starts whose size is no parameter of its effect (choice)."""

SMALLER = 0.1
"""Second size, over the first, from which the search for dry friction starts.

Choice: what sticks at once gives no gradient."""

STICKING = ("coulomb_friction", "rotor_friction")
"""Effects that can stick."""

TOGETHER = {("mgd_over_J", "L_over_J", "c_over_J"): "a mass put on the arm, or taken off, changes these together",
            ("k_load", "J_m"): "another propeller changes these together"}
"""Parameters that change together, and what a person has done then."""

SCATTERED = 32
"""Further start points of an effect by formula (choice: a twentieth of the range of two parameters is met)."""

SAME = 1e-6
"""Change of a residual, in units of a reading's noise, that is rounding (choice).

Measured: at ±30 % no verdict of 25 recordings changes (docs/results/thresholds.md)."""


@dataclass(frozen=True)
class Hypothesis:
    """One effect of the catalogue, or one parameter of the model that is far off.

    Attributes:
        effect: id of the effect.
        parameter: of the model, the first of its own, for `parameter_mismatch`; else "".
        starts: start points of searches, each the effect's own parameters, its size first.
        begun: names and values from which a search starts, if it was identified with the nominal model.
    """

    effect: str
    parameter: str = ""
    starts: tuple[tuple[Parameter, ...], ...] = ()
    begun: tuple[tuple[str, float], ...] = ()

    @property
    def name(self) -> str:
        """A unique name."""
        return f"{self.effect}:{'+'.join(p.name for p in self.own)}" if self.parameter else self.effect

    @property
    def place(self) -> str:
        """Its place in the chain."""
        return PLACE_OF_PARAMETER[self.parameter] if self.parameter else DEFINED[self.effect].place

    @property
    def own(self) -> tuple[Parameter, ...]:
        """Its own parameters, its size first."""
        return self.starts[0]

    @property
    def family(self) -> str:
        """The effect of which it is a form, or its own; see `name` for a parameter."""
        return self.name if self.parameter else DEFINED[self.effect].family

    @property
    def log_odds(self) -> float:
        """Prior log odds against no further effect; the other forms of an effect are as likely as the first."""
        if self.parameter:
            return math.log(EFFECT_ODDS / FEWEST_PARAMETERS)
        of = DEFINED[self.effect].form_of
        return math.log(EFFECT_ODDS / max(sum(form.form_of == of for form in FORMS.values()) if of else 1, 1))


def hypotheses(model: Model, further: Sequence[str] = (), left_out: Sequence[str] = (), *, mismatches: bool = True,
               known: Known | None = None) -> list[Hypothesis]:
    """Every effect that the model lacks: of the catalogue, and of effect files.

    Args:
        model: the nominal model.
        further: ids of effects of effect files.
        left_out: ids of effects that are not tried.
        mismatches: whether each parameter of the model may be far off, too.
        known: what earlier verdicts know; parameters and effects that they have determined may have changed.
    """
    there = {DEFINED[id_].family for id_ in model.effects if id_ in DEFINED}
    all_ = [Hypothesis(id_, starts=tuple(_starts(id_, model))) for id_ in (*CATALOGUE, *further)
            if DEFINED[id_].family not in there and id_ not in left_out and not DEFINED[id_].form_of]
    if known is not None:
        return [*all_, *_changes(model, known)]
    if not mismatches:
        return all_
    for names in STAGES.values():
        for name in names:
            nominal = model.model[name]
            if nominal != 0.0:
                all_.append(Hypothesis(PARAMETER_MISMATCH, name, ((_far_off(name, nominal),),)))
    return all_


def other_forms(h: Hypothesis, chains: CutChains) -> list[Hypothesis]:
    """The other forms of an effect, of effect files too, each with its own parameters at their defaults."""
    model = chains.model
    if h.parameter or h.effect in model.effects:
        return []
    forms = []
    for effect in (DEFINED[id_] for id_ in (*FORMS, *chains.further)):
        if effect.form_of != h.effect or effect.id in chains.left_out:
            continue
        others = [_somewhere(f"{effect.id}.{name}", p, math.nan) for name, p in effect.parameters.items()
                  if name != effect.size and not p.refines]
        # a size that the effect itself does not have is not known from it
        sizes = (FIRST_SIZE,) if effect.size in {key(p.name).name for p in h.own} else SIZES
        forms.append(Hypothesis(effect.id, starts=tuple((_size(effect.id, model, x), *others) for x in sizes)))
    return forms


def as_form(h: Hypothesis, form: Hypothesis, values: Mapping[str, float]) -> dict[str, float]:
    """Values with those of an effect handed to a form of it; what only the form has starts at its default.

    Args:
        h: the effect.
        form: another form of it.
        values: of a fit with the effect.
    """
    own = {key(p.name).name: values[p.name] for p in h.own}
    return {**{n: v for n, v in values.items() if n not in {p.name for p in h.own}},
            **{p.name: min(max(own[key(p.name).name], p.low), p.high) for p in form.own if key(p.name).name in own}}


def _far_off(name: str, nominal: float) -> Parameter:
    """A parameter of the model that may be far from its nominal value."""
    p = limits(name)
    return Parameter(name, nominal, MISMATCH_SD * abs(nominal), p.low, p.high, start=1.1 * nominal)


def _changes(model: Model, known: Known) -> Iterable[Hypothesis]:
    """A parameter or the size of an effect that differs from what earlier verdicts have determined."""
    numbers = {}
    for p in (p for stage in STAGES for p in known.parameters([stage], math.inf)):
        own = _far_off(p.name, p.mean)
        if key(p.name).owner == "" and known.sd(p.name) < own.sd:
            numbers[p.name] = own
            yield Hypothesis(PARAMETER_MISMATCH, p.name, ((own,),))
    for names in TOGETHER:
        if all(name in numbers for name in names):
            yield Hypothesis(PARAMETER_MISMATCH, names[0], (tuple(numbers[name] for name in names),))
    for id_, parameters in model.effects.items():
        if id_ in DEFINED and id_ not in RANDOM and f"{id_}.{DEFINED[id_].size}" in known.names:
            size = DEFINED[id_].parameters[DEFINED[id_].size]
            was = parameters[DEFINED[id_].size]
            wide = max(abs(was - size.neutral), abs(usual_size(id_, model) - size.neutral))
            own = Parameter(f"{id_}.{DEFINED[id_].size}", was, wide, size.low, size.high,
                            start=was + FIRST_SIZE * wide)
            yield Hypothesis(id_, starts=((own,),))


def _starts(id_: str, model: Model) -> Iterable[tuple[Parameter, ...]]:
    """Start points for an effect: a third of its usual size, each other parameter at several places of its range."""
    effect = DEFINED[id_]
    head = _size(id_, model, FIRST_SIZE)
    if id_ in STICKING:
        return [(head,), (_size(id_, model, SMALLER * FIRST_SIZE),)]
    others = [(name, p) for name, p in effect.parameters.items() if name != effect.size and not p.refines]
    if not others:
        return [(head,)]
    if effect.term:
        return _scattered(id_, head, others)
    grids: list[list[Parameter]] = []
    for name, p in others:
        full = f"{id_}.{name}"
        if p.low > 0.0:
            spread = 0.5 * math.log(p.high / p.low)
            places = [p.default * math.exp(f * spread) for f in (-0.7, -0.35, 0.0, 0.35, 0.7)]
            grids.append([Parameter(full, p.default, 0.6 * spread, p.low, p.high, min(max(x, p.low), p.high), log=True)
                          for x in places])
        else:
            middle, half = 0.5 * (p.low + p.high), 0.5 * (p.high - p.low)
            grids.append([Parameter(full, middle, half, p.low, p.high, middle + f * half) for f in (-0.6, 0.05, 0.65)])
    # the second parameter is searched; a third starts in its middle
    return [(head, first, *(g[len(g) // 2] for g in grids[1:])) for first in grids[0]]


def _size(id_: str, model: Model, share: float) -> Parameter:
    """The size of an effect, with a start at a share of its usual size."""
    size = DEFINED[id_].parameters[DEFINED[id_].size]
    step = usual_size(id_, model) - size.neutral
    return Parameter(f"{id_}.{DEFINED[id_].size}", size.neutral, SIZE_SD * abs(step), size.low, size.high,
                     start=size.neutral + share * step)


def _scattered(id_: str, head: Parameter, others: Sequence[tuple[str, EffectParameter]]
               ) -> list[tuple[Parameter, ...]]:
    """Start points of an effect by formula: at its defaults, and evenly over the ranges of its other parameters."""
    from scipy.stats import qmc  # its import is slow

    points = np.vstack([np.full(len(others), math.nan), qmc.Sobol(len(others), seed=0).random(SCATTERED)])
    return [(head, *(_somewhere(f"{id_}.{name}", p, share) for (name, p), share in zip(others, point, strict=True)))
            for point in points.tolist()]


def _somewhere(name: str, p: EffectParameter, share: float) -> Parameter:
    """A parameter with a start at a share of its range, on a scale of ratios if it is positive; at its default: NaN."""
    if p.low > 0.0:
        spread = math.log(p.high / p.low)
        start = p.default if math.isnan(share) else p.low * math.exp(share * spread)
        return Parameter(name, p.default, 0.3 * spread, p.low, p.high, start, log=True)
    start = p.default if math.isnan(share) else p.low + share * (p.high - p.low)
    return Parameter(name, 0.5 * (p.low + p.high), 0.5 * (p.high - p.low), p.low, p.high, start)


def stages_of(chains: CutChains, tried: Sequence[Hypothesis]) -> dict[str, tuple[str, ...]]:
    """Name of each hypothesis -> the stages whose residuals it changes, found by trying it."""
    guess = not chains.policy.calibrated
    # an effect of the arm shows only if the arm moves: without a drive it needs its initial state
    states = {stage: {p.name: p.mean for p in initial_states(chains, stage)} if guess else {} for stage in STAGES}
    residuals = {stage: chains.residuals(stage) for stage in STAGES}
    before = {stage: residuals[stage](states[stage]) for stage in STAGES}

    def changes(stage: str, values: Mapping[str, float]) -> bool:
        after = residuals[stage]({**states[stage], **values})
        return any(len(r) and not np.array_equal(r, after[k]) and not (
            guess and np.allclose(r, after[k], rtol=0.0, atol=SAME)) for k, r in before[stage].items())

    out = {}
    for h in tried:
        if h.parameter:
            values = {h.parameter: 1.2 * chains.model.model[h.parameter]}
        else:
            values = {f"{h.effect}.{k}": p.default for k, p in DEFINED[h.effect].parameters.items()}
        out[h.name] = tuple(stage for stage in STAGES if changes(stage, values))
    return out


def delay_from_voltage(chain: CutChain, hypothesis: Hypothesis, values: Mapping[str, float]) -> Hypothesis:
    """The command delay with its start where the voltage places it: no gradient leads there, as readings jump with it.

    Args:
        chain: of a recording.
        hypothesis: any; others than `command_delay` are returned as they are.
        values: of the actuator without a delay.
    """
    if hypothesis.effect != "command_delay" or not chain.signals.has("v_a"):
        return hypothesis
    start = chain.likeliest_delay(values)
    own = hypothesis.own[0]
    assert own.name == DELAY
    return replace(hypothesis, starts=((replace(own, mean=start, start=start),),))


def is_decided(chains: CutChains, hypothesis: Hypothesis) -> bool:
    """Whether the identification of the nominal model has decided on an effect that such a model may hold."""
    return (chains.policy.wide_search and angle_only(chains.recordings) and hypothesis.effect not in FINDINGS
            and hypothesis.own[0].name in CHOSEN)


def as_identified(chains: CutChains, hypothesis: Hypothesis) -> Hypothesis:
    """An effect with which the parameters of the nominal model were identified starts from what was identified."""
    own = {p.name: chains.likely[p.name] for p in hypothesis.own if p.name in chains.likely}
    if not own:
        return hypothesis
    numbers = {p.name: p.mean for p in model_parameters(chains, "arm")}
    starts = (tuple(replace(p, start=own.get(p.name, p.start)) for p in hypothesis.own), *hypothesis.starts)
    return replace(hypothesis, starts=starts, begun=tuple({**numbers, **own}.items()))


def linear_parameters(id_: str) -> list[Parameter]:
    """Two parameters in which an effect is linear, in place of its size and second parameter; both 0 without it."""
    size, second = list(DEFINED[id_].parameters.values())[:2]
    if DEFINED[id_].linear_in == "polar":
        return [Parameter(f"{id_}.cosine", 0.0, SIZE_SD * size.default),
                Parameter(f"{id_}.sine", 0.0, SIZE_SD * size.default)]
    return [Parameter(f"{id_}.slope", 0.0, SIZE_SD * size.default, size.low, size.high),
            Parameter(f"{id_}.product", 0.0, SIZE_SD * size.default * second.default)]


def from_linear(id_: str, values: Mapping[str, float]) -> dict[str, float]:
    """Values with those of `linear_parameters` turned into the effect's own parameters."""
    (size_name, size), (second_name, _) = list(DEFINED[id_].parameters.items())[:2]
    own = dict(values)
    if DEFINED[id_].linear_in == "polar":
        x, y = own.pop(f"{id_}.cosine"), own.pop(f"{id_}.sine")
        pair = math.hypot(x, y), math.atan2(y, x)
    else:
        x, y = own.pop(f"{id_}.slope"), own.pop(f"{id_}.product")
        x = max(x, 1e-6 * size.default)  # the product alone must be able to act
        pair = x, y / x
    own[f"{id_}.{size_name}"], own[f"{id_}.{second_name}"] = pair
    return own
