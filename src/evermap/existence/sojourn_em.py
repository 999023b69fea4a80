"""Expectation maximisation for stays and absences: looks on the filter's steps, counts, lifetimes, and again.

Where there is a rhythm of the week the calendar matters too: from week to week the level of each hazard may drift. It
is a random walk whose steps are as large as the counts want them (smoothness by marginal likelihood, `smooth_rates`);
the model that comes out has the level of the last week.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evermap.errors import DataError
from evermap.existence.hazard_table import edges
from evermap.existence.lattice import Lattice, lattice
from evermap.existence.protocol import Looks
from evermap.existence.rhythm import BIN_S, BINS, WEEK_S
from evermap.existence.run_length import RunLength
from evermap.existence.smooth_rates import fit, steady_level
from evermap.existence.sojourns import FAMILIES, WITH_RHYTHM, Fitted, Sojourns
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
class Expected:
    """What an expectation step finds.

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
        """(2, P) by what the hazards of each week differ from those of the last."""
        n = self.of_period.shape[1]
        if n == 1:
            return np.ones((2, 1))
        basis = steady_level(n)
        logs = np.array(
            [
                fit(events[:, None], expected[:, None], basis, None).log_age
                for events, expected in zip(self.of_period, self.expected_of_period, strict=True)
            ]
        )
        return np.asarray(np.exp(logs - logs[:, -1:]), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Data:
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

    lattices: tuple[Lattice, ...]
    importance: tuple[FloatArray, ...]
    period: tuple[IntArray, ...]
    n_periods: int
    step_s: float
    rhythm: bool
    span_s: float
    last_s: float

    @classmethod
    def of(cls, looks: Looks, step_s: float, half_life_s: float, *, rhythm: bool) -> Data:
        """Lay out looks.

        Raises:
            DataError: no feature with two looks at different times.
        """
        # as the filter's: never longer than a rhythm is constant
        step = min(step_s, BIN_S) if rhythm else step_s
        pieces = [lattice(one, step) for one in map(looks.of, range(looks.n_features)) if len(one.stamp_s)]
        pieces = [piece for piece in pieces if len(piece.stamp_s) > 1]
        if not pieces:
            raise DataError("no feature was looked at twice", hint="there is nothing to learn from")
        last = max(float(piece.stamp_s[-1]) for piece in pieces)
        weights = tuple(2.0 ** (-(last - piece.stamp_s[1:]) / half_life_s) for piece in pieces)
        span = max(float(np.ptp(piece.stamp_s)) for piece in pieces)
        ago = [((last - piece.stamp_s[1:]) // WEEK_S).astype(np.int64) * rhythm for piece in pieces]
        n = 1 + max(int(weeks.max()) for weeks in ago)
        return cls(tuple(pieces), weights, tuple(n - 1 - weeks for weeks in ago), n, step_s, rhythm, span, last)

    def expect(self, model: RunLength, level: FloatArray | None = None) -> Expected:
        """Run the filter forward and backward and count.

        Args:
            model: how features come and go.
            level: (2, P) by what the hazards of absences and stays are multiplied in each week.
        """
        from evermap.existence.run_length_smoothing import Counts, expectations

        _, edge = edges(self.step_s)
        group = AGE_GROUP if self.rhythm else 1
        shape = (2, -(-len(edge) // group), BINS if self.rhythm else 1)
        calendar = (2, self.n_periods)
        total = Counts(np.zeros(shape), np.zeros(shape), np.zeros(shape[:2]), np.zeros(calendar), np.zeros(calendar))
        levels = np.ones(calendar) if level is None else level
        evidence, presence = 0.0, []
        for piece, importance, period in zip(self.lattices, self.importance, self.period, strict=True):
            smoothed = np.empty(len(piece.stamp_s))
            gain, _ = expectations(
                *piece, importance, period, levels, model.slots, model.law, model.first, total, smoothed
            )
            evidence += gain
            presence.append(smoothed)
        coarse = np.append(edge[::group], 2.0 * edge[-1])
        absences, stays = (Sojourns(coarse, total.events[s], total.exposure_s[s], total.open_ended[s]) for s in (0, 1))
        return Expected((absences, stays), evidence, presence, total.of_period, total.expected_of_period)


@dataclass(frozen=True, slots=True)
class Ascent:
    """Where expectation maximisation has arrived.

    Attributes:
        model: the best model.
        fitted: its absences and stays.
        expected: what it finds in the looks.
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


def climb(data: Data, model: RunLength, families: Sequence[str], rounds: int) -> Ascent:
    """Expectation and maximisation in turn until the evidence settles; families are chosen in the first rounds."""
    allowed: list[Sequence[str]] = [families, families]
    level = np.ones((2, data.n_periods))
    expected = data.expect(model, level)
    best: Ascent | None = None
    fitted: tuple[Fitted, Fitted] | None = None
    for number in range(rounds):
        ranked = [
            ranked_fits(expected.counts[s], allowed[s], fitted[s] if fitted else None, rhythm=data.rhythm)
            for s in (0, 1)
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
        if number >= CHOOSING_ROUNDS and expected.log_evidence - before < SETTLED:
            break
    assert best is not None
    return best


def ranked_fits(counts: Sojourns, families: Sequence[str], start: Fitted | None, *, rhythm: bool) -> list[Fitted]:
    """Lifetimes of some families, the highest score first."""
    known = WITH_RHYTHM if rhythm else FAMILIES
    fits = [known[name](counts, start if start and start.family == name else None) for name in families]
    return sorted(fits, key=lambda one: -one.score(counts)) if len(fits) > 1 else fits


def _promising(ranked: Sequence[Fitted], counts: Sojourns) -> list[str]:
    """The families that are worth another round."""
    best = ranked[0].score(counts)
    return list(dict.fromkeys(one.family for one in ranked if one.score(counts) > best - HOPELESS))


def with_lifetimes(model: RunLength, fitted: tuple[Fitted, Fitted]) -> RunLength:
    """A model like `model` with other lifetimes."""
    absence, stay = fitted
    return RunLength(
        stay.prior, absence.prior, model.step_s, stay.rhythm, absence.rhythm, model.newborn, model.hypotheses
    )
