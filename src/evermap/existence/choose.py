"""Which kind of model suits some looks: each is learned without the last part of them and asked to foretell it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from evermap.errors import ConfigError, DataError
from evermap.existence.protocol import Looks, PresenceModel
from evermap.existence.rhythm import WEEK_S

Learner = Callable[[Looks], PresenceModel]
Progress = Callable[[float], None]

HELD_OUT_PART = 0.2
WEEKS_FOR_A_RHYTHM = 2.0
WEEKS_TO_HOLD_OUT_ONE = 4.0


def _phases(phases: str, *, rhythm: bool) -> Learner:
    def learner(looks: Looks) -> PresenceModel:
        from evermap.existence.learn_phases import learn

        return learn(looks, phases=phases, rhythm=rhythm).model

    return learner


def _run_length(*, rhythm: bool) -> Learner:
    def learner(looks: Looks) -> PresenceModel:
        from evermap.existence.learn_sojourns import learn

        return learn(looks, rhythm=rhythm).model

    return learner


KINDS: Mapping[str, Learner] = {
    "two-state": _phases("two-state", rhythm=False),
    "phase-type": _phases("auto", rhythm=False),
    "phase-type-rhythm": _phases("auto", rhythm=True),
    "run-length": _run_length(rhythm=False),
    "run-length-rhythm": _run_length(rhythm=True),
}
"""Kinds of recurrent models, each learned from looks alone; the simpler ones first."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What was chosen.

    Attributes:
        kind: one of `KINDS`.
        model: of that kind, learned from all looks.
        scores: log predictive density of the looks held out, of every kind that was tried; empty where one was named.
        held_out_s: how long the part held out is.
    """

    kind: str
    model: PresenceModel
    scores: Mapping[str, float]
    held_out_s: float


def choose(looks: Looks, kinds: Sequence[str] | None = None, *, progress: Progress | None = None) -> Choice:
    """Learn the kind of model that foretells the last part of the looks best.

    The last week is held out where there are four or more, else the last fifth. Rhythms are considered from two weeks
    on.

    Args:
        looks: uncertain looks; no truth.
        kinds: names in `KINDS` to choose from; all that the length of the looks allows where None.
        progress: called with the part that is done.

    Raises:
        ConfigError: a kind that does not exist.
        DataError: too few looks to learn from.
    """
    if not len(looks.stamp_s):
        raise DataError("there is no look to learn from")
    first, last = float(looks.stamp_s.min()), float(looks.stamp_s.max())
    names = list(KINDS) if kinds is None else list(kinds)
    for name in names:
        if name not in KINDS:
            raise ConfigError(f"'{name}' is no kind of model", field="kind", hint=f"one of {', '.join(KINDS)}")
    if kinds is None and last - first < WEEKS_FOR_A_RHYTHM * WEEK_S:
        names = [name for name in names if "rhythm" not in name]
    if len(names) == 1:
        return Choice(names[0], KINDS[names[0]](looks), {}, 0.0)
    held_out = WEEK_S if last - first >= WEEKS_TO_HOLD_OUT_ONE * WEEK_S else HELD_OUT_PART * (last - first)
    before = _until(looks, last - held_out)
    tell = progress or (lambda _: None)
    scores: dict[str, float] = {}
    for number, name in enumerate(names):
        model = KINDS[name](before)
        scores[name] = float(np.sum(model.track(looks).log_evidence) - np.sum(model.track(before).log_evidence))
        tell((number + 1) / (len(names) + 1))
    best = max(names, key=lambda name: scores[name])
    choice = Choice(best, KINDS[best](looks), scores, held_out)
    tell(1.0)
    return choice


def _until(looks: Looks, stamp_s: float) -> Looks:
    """The looks before an instant, at the same features."""
    kept = looks.stamp_s < stamp_s
    counts = np.add.reduceat(np.append(kept, False).astype(np.int64), looks.first[:-1]) * (np.diff(looks.first) > 0)
    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    columns = (looks.stamp_s, looks.detected, looks.p_miss, looks.p_false)
    return Looks(first, *(np.ascontiguousarray(column[kept]) for column in columns))
