"""How long things stay and stay away, learned from uncertain looks by expectation maximisation.

No truth is needed and no list of changes: the expectation step runs the run-length filter forward and backward, and
counts, with probabilities, at which ages stays and absences ended; the maximisation step fits lifetimes to the counts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from evermap.errors import DataError
from evermap.recurrence.hazard_table import edges
from evermap.recurrence.lattice import Lattice, lattice
from evermap.recurrence.protocol import Looks
from evermap.recurrence.rhythm import BINS
from evermap.recurrence.run_length import RunLength
from evermap.recurrence.sojourns import FAMILIES, WITH_RHYTHM, Fitted, Sojourns
from evermap.survival import Exponential
from evermap.types import FloatArray

AGE_GROUP = 4
"""Bins of age that count as one where there is a rhythm."""
_WARM_UP_ROUNDS = 4
_CHOOSING_ROUNDS = 4
_MOST_ROUNDS = 20
_SETTLED = 0.02
"""Gain of log evidence below which EM stops."""

Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class Candidate:
    """A kind of model that was considered.

    Attributes:
        name: families of stay and absence.
        log_evidence: `log p(looks)` of the best model of this kind.
        freedom: effective number of parameters.
        score: evidence less `freedom / 2 log(events)`; the highest is chosen.
    """

    name: str
    log_evidence: float
    freedom: float
    score: float


@dataclass(frozen=True, slots=True)
class Learned:
    """What was learned.

    Attributes:
        model: the filter to use from now on.
        log_evidence: `log p(looks)` under it.
        candidates: kinds of model considered, best first.
        counts: expected events and exposure of absences and stays: all that learning remembers of the looks.
        last_s: end of the last look.
        half_life_s: time after which a look counts half; infinite where nothing is forgotten.
    """

    model: RunLength
    log_evidence: float
    candidates: tuple[Candidate, ...]
    counts: tuple[Sojourns, Sojourns]
    last_s: float
    half_life_s: float
    families: tuple[str, ...]

    def updated(self, looks: Looks) -> Learned:
        """Learn from further looks: one expectation step on them, added to what is remembered of the earlier ones.

        Args:
            looks: at the same or other features, after those learned from.
        """
        rhythm = self.model.stay_rhythm is not None
        data = _Data.of(looks, self.model.step_s, self.half_life_s, rhythm)
        new, evidence, _ = data.expect(self.model)
        fade = 2.0 ** (-max(data.last_s - self.last_s, 0.0) / self.half_life_s)
        counts = tuple(_added(old, more, fade) for old, more in zip(self.counts, new, strict=True))
        fitted = [_best(state, self.families, rhythm) for state in counts]
        model = _model(self.model, fitted)
        return replace(
            self,
            model=model,
            log_evidence=evidence,
            counts=(counts[0], counts[1]),
            last_s=max(data.last_s, self.last_s),
        )


def learn(
    looks: Looks,
    *,
    families: Sequence[str] = tuple(FAMILIES),
    rhythm: bool = False,
    half_life_s: float = np.inf,
    step_s: float | None = None,
    hypotheses: int = 64,
    restarts: int = 4,
    progress: Progress | None = None,
) -> Learned:
    """One model of the comings and goings of all features in `looks`.

    Args:
        looks: uncertain looks; no truth.
        families: lifetimes to choose from, each for stays and absences by itself (`sojourns.FAMILIES`); with a rhythm
            only `exponential` and `smooth` can be had.
        rhythm: whether hazards follow the local time of the week (stamps are local wall time).
        half_life_s: time after which a look counts half.
        step_s: longest step of time; the median time between looks where None.
        hypotheses: how many the filter keeps.
        restarts: how many typical durations to start from, between a few steps and the whole recording.
        progress: called with the part that is done.

    Raises:
        DataError: no feature with two looks at different times.
    """
    step = step_s or _usual_gap(looks)
    data = _Data.of(looks, step, half_life_s, rhythm)
    allowed = tuple(name for name in families if not rhythm or name in WITH_RHYTHM)
    tell = progress or (lambda _: None)

    starts = []
    durations = np.geomspace(10.0 * step, max(data.span_s / 4.0, 20.0 * step), restarts)
    for number, duration in enumerate(durations):
        model = RunLength(Exponential(1.0 / duration), Exponential(1.0 / duration), step, hypotheses=hypotheses)
        starts.append(_climb(data, model, ("exponential",), rhythm, _WARM_UP_ROUNDS))
        tell(0.3 * (number + 1) / restarts)
    simple = max(starts, key=lambda state: state.evidence)
    states = [_climb(data, simple.model, ("exponential",), rhythm, _MOST_ROUNDS)]
    tell(0.5)
    if allowed != ("exponential",):
        states.append(_climb(data, states[0].model, allowed, rhythm, _MOST_ROUNDS))
    tell(1.0)
    ranked = sorted(states, key=lambda state: -state.candidate.score)
    best = ranked[0]
    return Learned(
        best.model, best.evidence, tuple(state.candidate for state in ranked), best.counts, data.last_s, half_life_s,
        allowed,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class _State:
    """Where an ascent has arrived."""

    model: RunLength
    evidence: float
    counts: tuple[Sojourns, Sojourns]
    candidate: Candidate


@dataclass(frozen=True, slots=True)
class _Data:
    """Looks laid out on the filter's steps, with the weight of every step."""

    lattices: tuple[Lattice, ...]
    importance: tuple[FloatArray, ...]
    step_s: float
    rhythm: bool
    span_s: float
    last_s: float

    @classmethod
    def of(cls, looks: Looks, step_s: float, half_life_s: float, rhythm: bool) -> _Data:
        pieces = [lattice(one, step_s) for one in map(looks.of, range(looks.n_features)) if len(one.stamp_s)]
        pieces = [piece for piece in pieces if len(piece.stamp_s) > 1]
        if not pieces:
            raise DataError("no feature was looked at twice", hint="there is nothing to learn from")
        last = max(float(piece.stamp_s[-1]) for piece in pieces)
        weights = [2.0 ** (-(last - piece.stamp_s[1:]) / half_life_s) for piece in pieces]
        span = max(float(np.ptp(piece.stamp_s)) for piece in pieces)
        return cls(tuple(pieces), tuple(weights), step_s, rhythm, span, last)

    def expect(self, model: RunLength) -> tuple[tuple[Sojourns, Sojourns], float, list[FloatArray]]:
        """Expected counts of absences and stays, log evidence, and presence at every step given all looks."""
        from evermap.recurrence.run_length_smoothing import Counts, expectations

        _, edge = edges(self.step_s)
        bins, group = len(edge), AGE_GROUP if self.rhythm else 1
        rows, weeks = -(-bins // group), BINS if self.rhythm else 1
        total = Counts(np.zeros((2, rows, weeks)), np.zeros((2, rows, weeks)), np.zeros((2, rows)))
        evidence, presence = 0.0, []
        for piece, importance in zip(self.lattices, self.importance, strict=True):
            smoothed = np.empty(len(piece.stamp_s))
            gain, _ = expectations(*piece, importance, model.slots, model.law, model.first, total, smoothed)
            evidence += gain
            presence.append(smoothed)
        coarse = np.append(edge[::group], 2.0 * edge[-1])
        absences, stays = (Sojourns(coarse, total.events[s], total.exposure_s[s], total.open_ended[s]) for s in (0, 1))
        return (absences, stays), evidence, presence


def _climb(data: _Data, model: RunLength, families: Sequence[str], rhythm: bool, rounds: int) -> _State:
    """Expectation and maximisation in turn until the evidence settles; families are chosen in the first rounds."""
    chosen: list[Sequence[str]] = [families, families]
    counts, evidence, _ = data.expect(model)
    freedom = 0.0
    state: _State | None = None
    for number in range(rounds):
        fitted = [_best(counts[s], chosen[s], rhythm) for s in (0, 1)]
        if number >= _CHOOSING_ROUNDS - 1:
            chosen = [[one.family] for one in fitted]
        candidate_model = _model(model, fitted)
        new_counts, new_evidence, _ = data.expect(candidate_model)
        freedom = sum(one.freedom for one in fitted)
        events = sum(c.n_events for c in new_counts)
        name = f"{fitted[1].family} stays, {fitted[0].family} absences" + (", rhythm of the week" if rhythm else "")
        score = new_evidence - 0.5 * freedom * float(np.log(max(events, 2.0)))
        gain = new_evidence - evidence
        if state is None or new_evidence > state.evidence:
            state = _State(candidate_model, new_evidence, new_counts, Candidate(name, new_evidence, freedom, score))
        model, counts, evidence = candidate_model, new_counts, new_evidence
        if number >= _CHOOSING_ROUNDS and gain < _SETTLED:
            break
    assert state is not None
    return state


def _best(counts: Sojourns, families: Sequence[str], rhythm: bool) -> Fitted:
    """The family of the highest score."""
    known = WITH_RHYTHM if rhythm else FAMILIES
    fits = [known[name](counts) for name in families]
    return max(fits, key=lambda one: one.score(counts))


def _model(model: RunLength, fitted: Sequence[Fitted]) -> RunLength:
    """A model like `model` with other lifetimes."""
    absence, stay = fitted
    return RunLength(
        stay.prior, absence.prior, model.step_s, stay.rhythm, absence.rhythm, model.newborn, model.hypotheses
    )


def _added(old: Sojourns, new: Sojourns, fade: float) -> Sojourns:
    """Counts of two recordings, the older faded."""
    return Sojourns(
        old.edge_s,
        fade * old.events + new.events,
        fade * old.exposure_s + new.exposure_s,
        fade * old.open_ended + new.open_ended,
    )


def _usual_gap(looks: Looks) -> float:
    """Median time between looks at a feature."""
    gaps = [np.diff(looks.of(f).stamp_s) for f in range(looks.n_features)]
    positive = np.concatenate([g[g > 0.0] for g in gaps]) if gaps else np.empty(0)
    if not positive.size:
        raise DataError("no feature was looked at twice", hint="there is nothing to learn from")
    return float(np.median(positive))
