"""Learning of stays and absences from uncertain looks by expectation maximisation.

No truth is needed and no list of changes: the expectation step runs the run-length filter forward and backward and
counts, with probabilities, at which ages stays and absences ended; the maximisation step fits lifetimes to the counts.
Where there is a rhythm of the week the calendar matters too: from week to week the level of each hazard may drift. It
is a random walk whose steps are as large as the counts want them (smoothness by marginal likelihood, `rhythm.fit`);
the model that comes out has the level of the last week.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from evermap.errors import ConfigError, DataError
from evermap.existence.lifetimes import edges
from evermap.existence.protocol import Candidate, LookColumns, Looks
from evermap.existence.rhythm import BIN_S, BINS, DAY_S, UNUSUAL, WEEK_S, DayShares, day_shares, fit, steady_level
from evermap.existence.run_length import RunLength
from evermap.existence.run_length_smoothing import lattice
from evermap.existence.sojourns import FAMILIES, WITH_RHYTHM, Fitted, Sojourns
from evermap.show import Shown
from evermap.survival import Exponential
from evermap.types import FloatArray, IntArray

AGE_GROUP = 4
"""Bins of age that count as one where there is a rhythm."""
CHOOSING_ROUNDS = 4
"""Rounds in which the families are chosen anew."""
HOPELESS = 20.0
"""A family whose score is this much below the best is not tried again."""
SETTLED = 0.02
"""Gain of log evidence below which EM stops."""


@dataclass(frozen=True, slots=True)
class Expected(Shown):
    """Result of an expectation step.

    Attributes:
        counts: of absences and of stays, exposures times the level of their week.
        log_evidence: `log p(looks)`.
        presence: of each feature, at every step, given all its looks.
        of_period: (2, P) how many absences and stays ended in each week, the last week last.
        expected_of_period: (2, P) how many would have at the level of the model.
    """

    counts: tuple[Sojourns, Sojourns]
    log_evidence: float
    presence: list[FloatArray]
    of_period: FloatArray
    expected_of_period: FloatArray

    def levels(self) -> FloatArray:
        """Return (2, P) by what the hazards of each week differ from those of the last."""
        n = self.of_period.shape[1]
        if n == 1:
            return np.ones((2, 1))
        basis = steady_level(n)
        pairs = zip(self.of_period[..., None], self.expected_of_period[..., None], strict=True)
        logs = np.array([fit(events, expected, basis, None).log_age for events, expected in pairs])
        return np.asarray(np.exp(logs - logs[:, -1:]), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Data(Shown):
    """Looks laid out on the filter's steps.

    Attributes:
        lattices: one of each feature that was looked at twice.
        importance: weight of every step.
        period: week of every step, counted back from the last look; one for all where there is no rhythm.
        n_periods: P.
        step_s: longest step.
        rhythm: whether the time of the week is counted.
        span_s: longest time that a feature was looked at.
        last_s: end of the last look.
    """

    lattices: tuple[LookColumns, ...]
    importance: tuple[FloatArray, ...]
    period: tuple[IntArray, ...]
    n_periods: int
    step_s: float
    rhythm: bool
    span_s: float
    last_s: float

    @classmethod
    def of(cls, looks: Looks, step_s: float, half_life_s: float, *, rhythm: bool) -> Data:
        """Lay out looks; DataError if no feature has two at different times."""
        # as the filter's: never longer than a rhythm is constant
        step = min(step_s, BIN_S) if rhythm else step_s
        pieces = [lattice(one, step) for one in map(looks.of, range(looks.n_features)) if len(one.stamp_s)]
        pieces = [piece for piece in pieces if len(piece.stamp_s) > 1]
        if not pieces:
            raise DataError("no feature has looks at two instants", hint="there is nothing to learn from")
        last = max(float(piece.stamp_s[-1]) for piece in pieces)
        weights = tuple(2.0 ** (-(last - piece.stamp_s[1:]) / half_life_s) for piece in pieces)
        span = max(float(np.ptp(piece.stamp_s)) for piece in pieces)
        ago = [((last - piece.stamp_s[1:]) // WEEK_S).astype(np.int64) * rhythm for piece in pieces]
        n = 1 + max(int(weeks.max()) for weeks in ago)
        return cls(tuple(pieces), weights, tuple(n - 1 - weeks for weeks in ago), n, step_s, rhythm, span, last)

    def days(self, model: RunLength, counted: FloatArray) -> tuple[FloatArray, Data, DayShares]:
        """Estimate the kinds of the days from their looks.

        Args:
            model: presence model with a rhythm.
            counted: (K,) numbers of earlier days of each kind.

        Returns:
            (K,) how many days were of each kind; the same looks, with no weight on days on which nothing could change,
            so that what is learned from them is of the others; and the shares of days to come.
        """
        from evermap.existence.run_length_kernels import kinds_of_days

        guess = replace(model, unusual=DayShares(UNUSUAL, UNUSUAL, UNUSUAL))
        law, first = guess.law, guess.first
        likelihood = [kinds_of_days(piece, guess.slots, law, first) for piece in self.lattices]
        begun = [piece.stamp_s // DAY_S for piece in self.lattices]
        steps = [(days[:-1] - days[0]).astype(np.int64) for days in begun]
        weights = [
            np.bincount(day, weight, len(rows)) / np.maximum(np.bincount(day, minlength=len(rows)), 1)
            for day, weight, rows in zip(steps, self.importance, likelihood, strict=True)
        ]
        total, kind, shares = day_shares(np.concatenate(likelihood), np.concatenate(weights), counted)
        moving = np.split(1.0 - kind[:, 1], np.cumsum([len(rows) for rows in likelihood])[:-1])
        importance = tuple(w * m[day] for w, m, day in zip(self.importance, moving, steps, strict=True))
        return total, replace(self, importance=importance), shares

    def expect(self, model: RunLength, level: FloatArray | None = None) -> Expected:
        """Run the filter forward and backward and count.

        Args:
            model: how features come and go, on ordinary days.
            level: (2, P) by what the hazards of absences and stays are multiplied in each week.
        """
        from evermap.existence.run_length_smoothing import Calendar, SojournCounts, expect_all

        _, edge = edges(self.step_s)
        group = AGE_GROUP if self.rhythm else 1
        shape = (2, -(-len(edge) // group), BINS if self.rhythm else 1)
        calendar = (2, self.n_periods)
        total = SojournCounts(
            np.zeros(shape), np.zeros(shape), np.zeros(shape[:2]), np.zeros(calendar), np.zeros(calendar)
        )
        first = np.cumsum([0, *(len(piece.stamp_s) for piece in self.lattices)])
        looks = LookColumns(*(np.concatenate(column) for column in zip(*self.lattices, strict=True)))
        levels = np.ones(calendar) if level is None else level
        when = Calendar(np.concatenate(self.importance), np.concatenate(self.period), levels)
        smoothed = np.empty(first[-1])
        evidence = expect_all(first, looks, when, model.slots, model.law, model.first, total, smoothed)
        presence = np.split(smoothed, first[1:-1])
        coarse = np.append(edge[::group], 2.0 * edge[-1])
        absences, stays = (Sojourns(coarse, total.events[s], total.exposure_s[s], total.open_ended[s]) for s in (0, 1))
        return Expected((absences, stays), evidence, presence, total.of_period, total.expected_of_period)


@dataclass(frozen=True, slots=True)
class Ascent(Shown):
    """State of expectation maximisation.

    Attributes:
        model: the best model.
        fitted: its absences and stays.
        expected: its expectation step.
        level: (2, P) drift of the hazards over the weeks.
    """

    model: RunLength
    fitted: tuple[Fitted, Fitted]
    expected: Expected
    level: FloatArray

    @property
    def name(self) -> str:
        """Families of stay and absence."""
        absence, stay = self.fitted
        return f"{stay.family} stays, {absence.family} absences" + (", rhythm of the week" if stay.rhythm else "")

    @property
    def freedom(self) -> float:
        """Effective number of parameters."""
        return sum(one.freedom for one in self.fitted)

    @property
    def score(self) -> float:
        """Log evidence less the price of the parameters (Schwarz 1978)."""
        events = sum(counts.n_events for counts in self.expected.counts)
        return self.expected.log_evidence - 0.5 * self.freedom * float(np.log(max(events, 2.0)))

    @property
    def candidate(self) -> Candidate:
        """Return it as a candidate with scores."""
        return Candidate(self.name, self.expected.log_evidence, self.freedom, self.score)


def climb(data: Data, model: RunLength, families: Sequence[str], rounds: int, to_beat: float = -np.inf) -> Ascent:
    """Iterate expectation and maximisation until the evidence settles; families are chosen in the first rounds.

    Args:
        data: looks to learn from.
        model: where to begin.
        families: lifetimes to choose from.
        rounds: maximum number of iterations.
        to_beat: ends, too, where the score stays below this if the evidence keeps growing as in the last round.
    """
    allowed: list[Sequence[str]] = [families, families]
    level = np.ones((2, data.n_periods))
    expected = data.expect(model, level)
    best: Ascent | None = None
    fitted: tuple[Fitted, Fitted] | None = None
    for number in range(rounds):
        ranked = [
            rank_fits(expected.counts[s], allowed[s], fitted[s] if fitted else None, rhythm=data.rhythm) for s in (0, 1)
        ]
        fitted = (ranked[0][0], ranked[1][0])
        allowed = [_promising(fits, expected.counts[s]) for s, fits in enumerate(ranked)]
        if number >= CHOOSING_ROUNDS - 1:
            allowed = [[one.family] for one in fitted]
        before = expected.log_evidence
        model, level = with_lifetimes(model, fitted), expected.levels()
        expected = data.expect(model, level)
        if best is None or expected.log_evidence > best.expected.log_evidence:
            best = Ascent(model, fitted, expected, level)
        gain = expected.log_evidence - before
        if number >= CHOOSING_ROUNDS and gain < SETTLED:
            break
        if number and best.score + max(gain, 0.0) * (rounds - 1 - number) < to_beat:
            break
    assert best is not None
    return best


def rank_fits(counts: Sojourns, families: Sequence[str], start: Fitted | None, *, rhythm: bool) -> list[Fitted]:
    """Return lifetimes of some families, the highest score first."""
    known = WITH_RHYTHM if rhythm else FAMILIES
    fits = [known[name](counts, start if start and start.family == name else None) for name in families]
    return sorted(fits, key=lambda one: -one.score(counts)) if len(fits) > 1 else fits


def _promising(ranked: Sequence[Fitted], counts: Sojourns) -> list[str]:
    """The families that are worth another round."""
    best = ranked[0].score(counts)
    return list(dict.fromkeys(one.family for one in ranked if one.score(counts) > best - HOPELESS))


def with_lifetimes(model: RunLength, fitted: tuple[Fitted, Fitted]) -> RunLength:
    """Return a model like `model` with other lifetimes."""
    absence, stay = fitted
    return RunLength(
        stay.prior, absence.prior, model.step_s, stay.rhythm, absence.rhythm, model.newborn, model.hypotheses
    )


_WARM_UP_ROUNDS = 4
_TRIAL_ROUNDS = 8
_LAST_ROUNDS = 3
_MOST_ROUNDS = 20
_FEWEST = 8
"""Hypotheses of a search among lifetimes that forget their age."""

Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class LearnedSojourns(Shown):
    """Result of learning.

    Attributes:
        model: the filter to use from now on.
        log_evidence: `log p(looks)` under it.
        candidates: kinds of model considered, best first.
        families: lifetimes allowed.
        half_life_s: time after which a look counts half; infinite where nothing is forgotten.
        last_s: end of the last look.
        expected: counts of absences and stays: all that learning remembers of the looks.
        of_kind: (K,) expected numbers of days of each kind (`rhythm.DayShares`); empty where there is no rhythm.
    """

    model: RunLength
    log_evidence: float
    candidates: tuple[Candidate, ...]
    families: tuple[str, ...]
    half_life_s: float
    last_s: float
    expected: Expected
    of_kind: FloatArray

    def updated(self, looks: Looks) -> LearnedSojourns:
        """Learn from further looks: one expectation step on them, added to the stored counts of the earlier ones.

        Args:
            looks: at the same or other features, after those learned from.

        Raises:
            DataError: no feature with two looks at different times.
        """
        rhythm = self.model.stay_rhythm is not None
        data = Data.of(looks, self.model.step_s, self.half_life_s, rhythm=rhythm)
        fade = 2.0 ** (-max(data.last_s - self.last_s, 0.0) / self.half_life_s)
        of_kind, unusual = self.of_kind, None
        if rhythm:
            of_kind, data, unusual = data.days(self.model, fade * self.of_kind)
        new = data.expect(replace(self.model, unusual=None))
        absences, stays = (
            _add_counts(old, more, fade) for old, more in zip(self.expected.counts, new.counts, strict=True)
        )
        fitted = (
            rank_fits(absences, self.families, None, rhythm=rhythm)[0],
            rank_fits(stays, self.families, None, rhythm=rhythm)[0],
        )
        return replace(
            self,
            model=replace(with_lifetimes(self.model, fitted), unusual=unusual),
            log_evidence=new.log_evidence,
            last_s=max(data.last_s, self.last_s),
            expected=replace(new, counts=(absences, stays)),
            of_kind=of_kind,
        )


def learn(
    looks: Looks,
    *,
    families: Sequence[str] | None = None,
    rhythm: bool = False,
    half_life_s: float = np.inf,
    step_s: float | None = None,
    hypotheses: int = 64,
    restarts: int = 4,
    start: RunLength | None = None,
    progress: Progress | None = None,
) -> LearnedSojourns:
    """Return one model of the comings and goings of all features in `looks`.

    Args:
        looks: uncertain looks; no truth.
        families: lifetimes to choose from, for stays and for absences (`sojourns.FAMILIES`, or with a rhythm
            `sojourns.WITH_RHYTHM`); all of them where None.
        rhythm: whether hazards follow the local time of the week (stamps are local wall time), and drift.
        half_life_s: time after which a look counts half.
        step_s: longest step of time; the median time between looks where None.
        hypotheses: how many the filter keeps.
        restarts: how many typical durations to start from, between a few steps and the whole recording.
        start: a model learned from most of these looks, to go on from; nothing else is tried then.
        progress: called with the part that is done.

    Raises:
        ConfigError: a family that does not exist.
        DataError: no feature with two looks at different times.
    """
    allowed = _list_allowed(families, rhythm=rhythm)
    step = step_s or looks.median_gap_s()
    steady = Data.of(looks, step, half_life_s, rhythm=False)
    data = Data.of(looks, step, half_life_s, rhythm=True) if rhythm else steady
    tell = progress or (lambda _: None)
    if start is not None:
        ascents = [climb(data, replace(start, unusual=None), allowed, _MOST_ROUNDS)]
    else:
        ascents = _search(steady, data, allowed, hypotheses, restarts, tell)
    ranked = sorted(ascents, key=lambda ascent: -ascent.score)
    candidates: dict[str, Candidate] = {}
    for ascent in ranked:  # the best of each kind
        candidates.setdefault(ascent.name, ascent.candidate)
    best, of_kind, unusual = _with_unusual_days(data, ranked[0]) if rhythm else (ranked[0], np.zeros(0), None)
    tell(1.0)
    return LearnedSojourns(
        replace(best.model, unusual=unusual),
        best.expected.log_evidence,
        tuple(candidates.values()),
        allowed,
        half_life_s,
        data.last_s,
        best.expected,
        of_kind,
    )


def _search(
    steady: Data, data: Data, allowed: Sequence[str], hypotheses: int, restarts: int, tell: Progress
) -> list[Ascent]:
    """Climb with every family from exponential lifetimes, which `steady` looks give, and go on from the best."""
    simple = _exponential(steady, hypotheses, restarts, tell)
    # what a model of one family counts looks like that family: each has to be tried from its own counts
    trials = [] if data.rhythm else [simple]
    others = [name for name in allowed if data.rhythm or name != "exponential"]
    if not others:
        return trials
    for number, name in enumerate(others):
        to_beat = max((trial.score for trial in trials), default=-np.inf)
        trials.append(climb(data, simple.model, (name,), _TRIAL_ROUNDS, to_beat))
        tell(0.5 + 0.3 * (number + 1) / len(others))
    # hours that look like habits, and habits that look like hours: where there is a rhythm, each start goes on
    best_first = sorted(trials, key=lambda ascent: -ascent.score)
    finals = [climb(data, trial.model, allowed, _MOST_ROUNDS) for trial in best_first[: 2 if data.rhythm else 1]]
    return [*finals, *trials] if data.rhythm else [*trials, *finals]


def _with_unusual_days(data: Data, best: Ascent) -> tuple[Ascent, FloatArray, DayShares]:
    """Return the same, learned from days with possible changes; numbers and shares of the days of each kind."""
    _, moving, _ = data.days(best.model, np.zeros(4))
    families = tuple(dict.fromkeys(one.family for one in best.fitted))
    again = climb(moving, best.model, families, _LAST_ROUNDS)
    of_kind, _, shares = data.days(again.model, np.zeros(4))
    return again, of_kind, shares


def _list_allowed(families: Sequence[str] | None, *, rhythm: bool) -> tuple[str, ...]:
    """Return the families to choose from."""
    known = WITH_RHYTHM if rhythm else FAMILIES
    allowed = tuple(known if families is None else families)
    for name in allowed:
        if name not in known:
            raise ConfigError(f"unknown family '{name}'", field="families", hint=f"one of {', '.join(known)}")
    return allowed


def _exponential(data: Data, hypotheses: int, restarts: int, tell: Progress) -> Ascent:
    """The best exponential lifetimes, from several typical durations on.

    These forget their age, so that few hypotheses are exact but for the ages of the counts, which are counted at last.
    """
    starts, step = [], data.step_s
    for number, duration in enumerate(np.geomspace(10.0 * step, max(data.span_s / 4.0, 20.0 * step), restarts)):
        few = RunLength(Exponential(1.0 / duration), Exponential(1.0 / duration), step, hypotheses=_FEWEST)
        starts.append(climb(data, few, ("exponential",), _WARM_UP_ROUNDS))
        tell(0.3 * (number + 1) / restarts)
    simple = max(starts, key=lambda ascent: ascent.expected.log_evidence)
    found = climb(data, simple.model, ("exponential",), _MOST_ROUNDS)
    model = replace(found.model, hypotheses=hypotheses)
    found = replace(found, model=model, expected=data.expect(model, found.level))
    tell(0.5)
    return found


def _add_counts(old: Sojourns, new: Sojourns, fade: float) -> Sojourns:
    """Counts of two recordings, the older faded."""
    return Sojourns(
        old.edge_s,
        fade * old.events + new.events,
        fade * old.exposure_s + new.exposure_s,
        fade * old.open_ended + new.open_ended,
    )
