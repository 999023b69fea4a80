"""Rates of a chain of phases learned from uncertain looks, by expectation and maximisation.

Nothing but the looks is used: no truth, no guess of when a feature came or went. The E-step is exact for looks at any
times (`phase_kernels`); the M-step divides expected changes by expected time, or fits a smooth rhythm of the week to
the two (`rhythm.fit`).
Between structures, and between rhythm and none, the Bayesian information criterion decides: log evidence minus half
the number of parameters times the logarithm of the number of looks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from evermap.errors import ConfigError, DataError
from evermap.existence.phase_type import PhaseType, Structure, structure_of
from evermap.existence.protocol import Candidate, LookColumns, Looks
from evermap.existence.rhythm import BINS, Rhythm
from evermap.show import Shown
from evermap.types import FloatArray

AUTO = ("two-state", "three-phase")
HALF_AN_EVENT = 0.5
"""Prior of every rate: half a change in half of a middling time, so that what never happened is not impossible."""
FASTEST = 10.0
"""Most changes between two looks a median gap apart that are worth a thought."""
SHORTEST_RHYTHM_S = 2.0 * 86400.0
"""Looks over less than this say nothing about the days."""
_TRIAL_ROUNDS = 12
_MOST_ROUNDS = 300
_RHYTHM_ROUNDS = 12
_RHYTHM_SETTLED = 0.5
"""The same for a rhythm, whose smoothness is learned anew in every round."""
_SETTLED = 1e-5
"""Gain of log evidence, in a round, below which the search ends (relative to the number of parameters)."""


class Statistics(NamedTuple):
    """Expected sufficient statistics of the rates, given the looks.

    Attributes:
        events: (B, n, n) changes of phase at each time of the week (B is 1008, or 1 without rhythm).
        exposure_s: (B, n) time spent in each phase.
        at_s: instant at which a change weighs 1; earlier ones less, where forgetting is asked for.
    """

    events: FloatArray
    exposure_s: FloatArray
    at_s: float


class Limits(NamedTuple):
    """Prior of every rate.

    Attributes:
        fastest_hz: no rate is above; changes faster than the looks are unobservable.
        prior_s: time in which half a change has been seen: half of the geometric mean of the median gap between looks
            and of the time they span, since habits of any length in between are alike to us.
    """

    fastest_hz: float
    prior_s: float

    @classmethod
    def of(cls, looks: Looks) -> Limits:
        """Return them from the times of the looks; DataError if no feature has looks at two instants."""
        gap, span = looks.median_gap_s(), float(np.ptp(looks.stamp_s))
        return cls(FASTEST / gap, 0.5 * float(np.sqrt(gap * span)))


@dataclass(frozen=True, eq=False)
class LearnedPhases(Shown):
    """A model learned from looks, with the state for further learning.

    Attributes:
        model: the chosen chain; it starts as in the long run.
        log_evidence: of the looks under it.
        candidates: all that was tried, the chosen one first.
        structure: of the model.
        statistics: expected changes and times so far.
        belief: (F, n) phases after each feature's last look.
        stamp_s: (F,) that look.
        half_life_s: what happened this long ago weighs half; inf: nothing is forgotten.
        limits: on the rates.
    """

    model: PhaseType
    log_evidence: float
    candidates: tuple[Candidate, ...]
    structure: Structure
    statistics: Statistics
    belief: FloatArray
    stamp_s: FloatArray
    half_life_s: float
    limits: Limits

    def updated(self, looks: Looks, *, rounds: int = 3) -> LearnedPhases:
        """Go on learning with later looks at the same features; earlier ones are kept as decayed statistics.

        Args:
            looks: later looks, features in the same order.
            rounds: EM rounds over the new looks.

        Raises:
            DataError: another number of features, or looks before the last ones.
            NumericalError: a look that is impossible, whether the feature is there or not.
        """
        if looks.n_features != len(self.stamp_s):
            raise DataError(f"looks at {looks.n_features} features instead of {len(self.stamp_s)}")
        if not len(looks.stamp_s):
            return self
        first_s, last_s = looks.ends_s(self.stamp_s)
        early = np.flatnonzero(first_s < self.stamp_s)
        if early.size:
            raise DataError(f"feature {early[0]}: looks before the last one learned from", hint="later looks only")
        at_s = max(self.statistics.at_s, float(looks.stamp_s.max()))
        fade = 2.0 ** (-(at_s - self.statistics.at_s) / self.half_life_s)
        old = Statistics(self.statistics.events * fade, self.statistics.exposure_s * fade, at_s)
        data = _Data.of(looks, at_s, self.half_life_s, self.limits)._replace(begin_s=self.stamp_s)
        model, total = self.model, old
        for _ in range(rounds):
            new = _expect(data, model, self.belief).statistics
            total = Statistics(old.events + new.events, old.exposure_s + new.exposure_s, at_s)
            model, _ = _maximise(self.structure, total, bool(model.rhythms), self.limits)
        expected = _expect(data, model, self.belief)
        return replace(
            self,
            model=model,
            log_evidence=self.log_evidence + expected.log_evidence,
            statistics=total,
            belief=np.where(np.diff(looks.first)[:, None] > 0, expected.last, self.belief),
            stamp_s=last_s,
        )


def learn(
    looks: Looks,
    *,
    phases: str | Structure | Sequence[str | Structure] = "auto",
    rhythm: bool | str = "auto",
    half_life_s: float | None = None,
    restarts: int = 4,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> LearnedPhases:
    """Learn one presence model of these features.

    Args:
        looks: at features that share one model; one feature alone is `looks.of(feature)`.
        phases: 'auto', the name of a structure ('two-state', 'three-phase', '2+3'), a structure, or several.
        rhythm: whether rates follow the hours of the week (stamps in local wall time); 'auto' tries both where the
            looks span two days or more.
        half_life_s: what happened this long before the last look weighs half; None: nothing is forgotten.
        restarts: number of starting points for each structure.
        seed: of the starting points.
        progress: told in a few words what is being tried.

    Raises:
        ConfigError: a structure, a half life or a number of restarts that cannot be.
        DataError: fewer than two looks at every feature.
        NumericalError: a look that is impossible, whether the feature is there or not.
    """
    structures = _structures(phases)
    _check_settings(structures, rhythm, half_life_s, restarts)
    end_s = float(looks.stamp_s.max())
    data = _Data.of(looks, end_s, np.inf if half_life_s is None else half_life_s, Limits.of(looks))
    span_s = end_s - float(looks.stamp_s.min())
    with_rhythm = rhythm is True or (rhythm == "auto" and span_s >= SHORTEST_RHYTHM_S)
    found: list[tuple[Candidate, _Fit, Structure]] = []
    random = np.random.default_rng(seed)
    for structure in structures:
        if progress:
            progress(structure.name)
        fit = _best_of(data, structure, restarts, random, span_s)
        fits = [] if rhythm is True else [fit]
        if with_rhythm:
            if progress:
                progress(f"{structure.name} + rhythm")
            fits.append(_with_rhythm(data, structure, fit))
        found += [(_candidate(looks, structure, fit), fit, structure) for fit in fits]
    found.sort(key=lambda one: -one[0].score)
    best, fit, structure = found[0]
    final = _expect(data, fit.model, fit.start[None])
    return LearnedPhases(
        model=fit.model,
        log_evidence=best.log_evidence,
        candidates=tuple(candidate for candidate, _, _ in found),
        structure=structure,
        statistics=final.statistics,
        belief=final.last,
        stamp_s=looks.ends_s(end_s)[1],
        half_life_s=data.half_life_s,
        limits=data.limits,
    )


def _check_settings(
    structures: Sequence[Structure], rhythm: bool | str, half_life_s: float | None, restarts: int
) -> None:
    if not structures or restarts < 1:
        raise ConfigError("nothing to try", field="phases" if restarts >= 1 else "restarts", hint="at least one")
    if half_life_s is not None and not half_life_s > 0.0:
        raise ConfigError(f"invalid half life {half_life_s}", field="half_life_s", hint="seconds, above 0")
    if rhythm not in (True, False, "auto"):
        raise ConfigError(f"unknown setting {rhythm!r}", field="rhythm", hint="True, False or 'auto'")


def _structures(phases: str | Structure | Sequence[str | Structure]) -> list[Structure]:
    """Return the candidate structures."""
    names = AUTO if isinstance(phases, str) and phases == "auto" else phases
    several = [names] if isinstance(names, (str, Structure)) else list(names)
    return [structure_of(s) if isinstance(s, str) else s for s in several]


class _Data(NamedTuple):
    """Looks as the E-step wants them."""

    looks: Looks
    columns: LookColumns
    begin_s: FloatArray
    end_s: float
    half_life_s: float
    limits: Limits

    @classmethod
    def of(cls, looks: Looks, end_s: float, half_life_s: float, limits: Limits) -> _Data:
        return cls(looks, looks.columns(), looks.ends_s(end_s)[0], end_s, half_life_s, limits)


class _Expected(NamedTuple):
    """The E-step's answer."""

    log_evidence: float
    statistics: Statistics
    smoothed: FloatArray
    last: FloatArray


class _Fit(NamedTuple):
    """Rates at the end of a search."""

    model: PhaseType
    start: FloatArray
    parameters: float
    history: tuple[float, ...]


def _expect(data: _Data, model: PhaseType, start: FloatArray) -> _Expected:
    """Expected changes and times under a model; `start` is (n,) rows, one a feature or one for all."""
    from evermap.existence.phase_kernels import Expectations, expect_all

    rates = model.chain.rates_hz
    features, n = data.looks.n_features, model.n_phases
    begin = np.array(np.broadcast_to(start, (features, n)), order="C")  # any other would be compiled for once more
    integrals = np.zeros_like(rates)
    smoothed, last = np.empty((features, n)), np.empty((features, n))
    fading = float(data.end_s), float(data.half_life_s)
    out = Expectations(integrals, smoothed, last)
    evidence, bad = expect_all(model.chain, data.begin_s, begin, data.looks.first, data.columns, fading, out)
    if bad >= 0:
        raise data.looks.impossible(bad)
    exposure = np.einsum("bii->bi", integrals).copy()
    return _Expected(evidence, Statistics(rates * integrals, exposure, data.end_s), smoothed, last)


def _maximise(structure: Structure, statistics: Statistics, rhythm: bool, limits: Limits) -> tuple[PhaseType, float]:
    """Rates of greatest posterior density given expected changes and times, and how many parameters they are."""
    from evermap.existence.rhythm import constant, fit, week_basis

    rates = np.zeros(structure.changes.shape)
    edges = np.argwhere(structure.changes)
    if not rhythm:
        for i, j in edges:
            changes = statistics.events[:, i, j].sum() + HALF_AN_EVENT
            rates[i, j] = min(changes / (statistics.exposure_s[:, i].sum() + limits.prior_s), limits.fastest_hz)
        return PhaseType(structure.present, rates), float(len(edges))
    rhythms: list[Rhythm] = []
    which, freedom = np.full(rates.shape, -1), 0.0
    basis = week_basis()
    for i, j in edges:
        exposure = statistics.exposure_s[:, i] + limits.prior_s / BINS
        smooth = fit(statistics.events[:, i, j][None], exposure[None], constant(1), basis)  # adds half an event
        level = min(float(np.exp(smooth.log_age[0])), limits.fastest_hz)
        rates[i, j] = level
        which[i, j] = len(rhythms)
        rhythms.append(Rhythm(np.minimum(smooth.log_week, np.log(limits.fastest_hz / level))))
        freedom += smooth.freedom
    return PhaseType(structure.present, rates, None, tuple(rhythms), which), freedom


def _round(
    data: _Data, structure: Structure, model: PhaseType, start: FloatArray
) -> tuple[float, PhaseType, FloatArray]:
    """Objective at a model without rhythm, and the next model and start."""
    expected = _expect(data, model, start)
    rates = model.rates_hz[structure.changes]
    # of the log rates and of the start, up to a constant, as in the M-step
    log_prior = HALF_AN_EVENT * float(np.log(rates).sum() + np.log(start).sum())
    log_prior -= data.limits.prior_s * float(rates.sum())
    counts = expected.smoothed.sum(0) + HALF_AN_EVENT
    following, _ = _maximise(structure, expected.statistics, False, data.limits)
    return expected.log_evidence + log_prior, following, counts / counts.sum()


def _search(data: _Data, structure: Structure, model: PhaseType, start: FloatArray, rounds: int) -> _Fit:
    """EM until it settles, three rounds at a time extrapolated (SQUAREM, Varadhan and Roland 2008) where that helps."""
    changes = structure.changes
    history: list[float] = []
    while len(history) < rounds:
        objective, once, start_once = _round(data, structure, model, start)
        history.append(objective)
        objective_once, twice, start_twice = _round(data, structure, once, start_once)
        history.append(objective_once)
        here, there = np.log(model.rates_hz[changes]), np.log(once.rates_hz[changes])
        first, second = there - here, np.log(twice.rates_hz[changes]) - there
        model, start = twice, start_twice
        bend = float(np.linalg.norm(second - first))
        stretch = float(np.linalg.norm(first)) / bend if bend > 0.0 else 1.0
        if objective_once - objective < _SETTLED * len(here):
            break
        if stretch > 1.0:
            rates = np.zeros(changes.shape)
            bold = here + 2.0 * stretch * first + stretch**2 * (second - first)
            rates[changes] = np.minimum(np.exp(np.clip(bold, -700.0, 700.0)), data.limits.fastest_hz)
            candidate = PhaseType(structure.present, rates)
            objective_bold, following, start_bold = _round(data, structure, candidate, start_twice)
            if objective_bold >= objective_once:
                history.append(objective_bold)
                model, start = following, start_bold
    return _Fit(model, start, float(changes.sum()), tuple(history))


def _best_of(data: _Data, structure: Structure, restarts: int, random: np.random.Generator, span_s: float) -> _Fit:
    """The best of several searches, each from rates of its own; only the most promising is led to its end."""
    n = len(structure.present)
    low, high = np.log(2.0 / span_s), np.log(0.2 * data.limits.fastest_hz)
    trials = []
    for _ in range(restarts):
        pace = np.exp(random.uniform(low, high, n))  # how soon each phase is left
        share = np.where(structure.changes, random.uniform(0.1, 1.0, (n, n)), 0.0)
        rates = pace[:, None] * share / np.maximum(share.sum(1, keepdims=True), 1e-300)
        model = PhaseType(structure.present, rates)
        trials.append(_search(data, structure, model, np.full(n, 1.0 / n), _TRIAL_ROUNDS))
    best = max(trials, key=lambda trial: trial.history[-1])
    final = _search(data, structure, best.model, best.start, _MOST_ROUNDS)
    return final._replace(history=best.history + final.history)


def _with_rhythm(data: _Data, structure: Structure, flat: _Fit) -> _Fit:
    """EM with smooth rhythms, from the rates found without."""
    which = np.where(structure.changes, 0, -1)
    model = PhaseType(structure.present, flat.model.rates_hz, None, (Rhythm(np.zeros(BINS)),), which)
    start, parameters = flat.start, flat.parameters
    before = -np.inf
    for _ in range(_RHYTHM_ROUNDS):
        expected = _expect(data, model, start)
        if expected.log_evidence - before < _RHYTHM_SETTLED:
            break
        before = expected.log_evidence
        model, parameters = _maximise(structure, expected.statistics, True, data.limits)
        counts = expected.smoothed.sum(0) + HALF_AN_EVENT
        start = counts / counts.sum()
    return _Fit(model, start, parameters, ())


def _candidate(looks: Looks, structure: Structure, fit: _Fit) -> Candidate:
    """Return the score of a fit: log evidence less the cost of its parameters."""
    evidence = float(fit.model.track(looks).log_evidence.sum())
    penalty = 0.5 * fit.parameters * float(np.log(max(len(looks.stamp_s), 2)))
    name = f"{structure.name} + rhythm" if fit.model.rhythms else structure.name
    return Candidate(name, evidence, fit.parameters, evidence - penalty, fit.history)
