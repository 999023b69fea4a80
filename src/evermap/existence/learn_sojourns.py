"""How long things stay and stay away, learned from uncertain looks by expectation maximisation.

No truth is needed and no list of changes: the expectation step runs the run-length filter forward and backward, and
counts, with probabilities, at which ages stays and absences ended; the maximisation step fits lifetimes to the counts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from evermap.errors import ConfigError, DataError
from evermap.existence.protocol import Looks
from evermap.existence.run_length import RunLength
from evermap.existence.sojourn_em import Ascent, Data, Expected, climb, ranked_fits, with_lifetimes
from evermap.existence.sojourns import FAMILIES, WITH_RHYTHM, Sojourns
from evermap.survival import Exponential

_WARM_UP_ROUNDS = 4
_TRIAL_ROUNDS = 8
_MOST_ROUNDS = 20

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
        families: lifetimes allowed.
        half_life_s: time after which a look counts half; infinite where nothing is forgotten.
        last_s: end of the last look.
        expected: counts of absences and stays: all that learning remembers of the looks.
    """

    model: RunLength
    log_evidence: float
    candidates: tuple[Candidate, ...]
    families: tuple[str, ...]
    half_life_s: float
    last_s: float
    expected: Expected

    def updated(self, looks: Looks) -> Learned:
        """Learn from further looks: one expectation step on them, added to what is remembered of the earlier ones.

        Args:
            looks: at the same or other features, after those learned from.

        Raises:
            DataError: no feature with two looks at different times.
        """
        rhythm = self.model.stay_rhythm is not None
        data = Data.of(looks, self.model.step_s, self.half_life_s, rhythm=rhythm)
        new = data.expect(self.model)
        fade = 2.0 ** (-max(data.last_s - self.last_s, 0.0) / self.half_life_s)
        absences, stays = (_added(old, more, fade) for old, more in zip(self.expected.counts, new.counts, strict=True))
        fitted = (
            ranked_fits(absences, self.families, None, rhythm=rhythm)[0],
            ranked_fits(stays, self.families, None, rhythm=rhythm)[0],
        )
        return replace(
            self,
            model=with_lifetimes(self.model, fitted),
            log_evidence=new.log_evidence,
            last_s=max(data.last_s, self.last_s),
            expected=replace(new, counts=(absences, stays)),
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
    progress: Progress | None = None,
) -> Learned:
    """One model of the comings and goings of all features in `looks`.

    Args:
        looks: uncertain looks; no truth.
        families: lifetimes to choose from, for stays and for absences (`sojourns.FAMILIES`, or with a rhythm
            `sojourns.WITH_RHYTHM`); all of them where None.
        rhythm: whether hazards follow the local time of the week (stamps are local wall time), and drift.
        half_life_s: time after which a look counts half.
        step_s: longest step of time; the median time between looks where None.
        hypotheses: how many the filter keeps.
        restarts: how many typical durations to start from, between a few steps and the whole recording.
        progress: called with the part that is done.

    Raises:
        ConfigError: a family that does not exist.
        DataError: no feature with two looks at different times.
    """
    known = WITH_RHYTHM if rhythm else FAMILIES
    allowed = tuple(known if families is None else families)
    for name in allowed:
        if name not in known:
            raise ConfigError(f"no family '{name}'", field="families", hint=f"one of {', '.join(known)}")
    step = step_s or _usual_gap(looks)
    data = Data.of(looks, step, half_life_s, rhythm=False)
    tell = progress or (lambda _: None)

    starts = []
    durations = np.geomspace(10.0 * step, max(data.span_s / 4.0, 20.0 * step), restarts)
    for number, duration in enumerate(durations):
        model = RunLength(Exponential(1.0 / duration), Exponential(1.0 / duration), step, hypotheses=hypotheses)
        starts.append(climb(data, model, ("exponential",), _WARM_UP_ROUNDS))
        tell(0.3 * (number + 1) / restarts)
    simple = max(starts, key=lambda ascent: ascent.expected.log_evidence)
    ascents = [climb(data, simple.model, ("exponential",), _MOST_ROUNDS)]
    tell(0.5)
    if rhythm or allowed != ("exponential",):
        # what a model of one family counts looks like that family: each has to be tried from its own counts
        calendar = Data.of(looks, step, half_life_s, rhythm=True) if rhythm else data
        trials = []
        for number, name in enumerate(allowed):
            trials.append(climb(calendar, ascents[0].model, (name,), _TRIAL_ROUNDS))
            tell(0.5 + 0.3 * (number + 1) / len(allowed))
        # hours that look like habits, and habits that look like hours: where there is a rhythm, each start goes on
        best_first = sorted(trials, key=lambda ascent: -ascent.score)
        finals = [climb(calendar, trial.model, allowed, _MOST_ROUNDS) for trial in best_first[: 2 if rhythm else 1]]
        ascents = [*finals, *trials] if rhythm else [*ascents, *trials, *finals]
    tell(1.0)
    ranked = sorted(ascents, key=lambda ascent: -ascent.score)
    best = ranked[0]
    candidates: dict[str, Candidate] = {}
    for ascent in ranked:  # the best of each kind
        candidates.setdefault(ascent.name, _candidate(ascent))
    return Learned(
        best.model,
        best.expected.log_evidence,
        tuple(candidates.values()),
        allowed,
        half_life_s,
        data.last_s,
        best.expected,
    )


def _candidate(ascent: Ascent) -> Candidate:
    """An ascent in numbers."""
    return Candidate(ascent.name, ascent.expected.log_evidence, ascent.freedom, ascent.score)


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
