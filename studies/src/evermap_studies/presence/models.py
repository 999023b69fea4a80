"""The contenders of the comparison, each behind the same two steps: learn from looks, then believe causally.

What takes long is learned once for each set of looks; a choice (`options`) is applied to it afterwards, so that trying
all of them is cheap. Which choice it is, only looks inside the training data decide.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from evermap.existence.one_stay import OneStay
from evermap.existence.protocol import Instants, Looks, PresenceModel
from evermap.survival import Exponential
from evermap.types import FloatArray
from evermap_studies.presence.baselines import (
    PERIODIC_OPTIONS,
    SPECTRAL_OPTIONS,
    last_look,
    long_term_mean,
    periodic,
    spectral,
    spectrum,
    week_counts,
)

Believe = Callable[[Looks, Instants], FloatArray]
"""Probability of presence at every instant, given each feature's looks up to and including it."""

MEAN_STAYS_S = tuple(60.0 * minutes for minutes in (1, 3, 10, 30, 60, 240, 720, 1440, 4320, 10080, 40320, 524160))
"""What Rosen's filter may expect: from a minute to a year."""


@dataclass(frozen=True, slots=True)
class Contender:
    """A way to predict presence.

    Attributes:
        name: in `summary.json`.
        label: in tables.
        learn: from looks at one feature; the costly part.
        believe: what was learned and an option -> beliefs.
        options: what has to be chosen; one entry where nothing has.
        says: what was learned and an option -> words for the table.
    """

    name: str
    label: str
    learn: Callable[[Looks], Any]
    believe: Callable[[Any, Any], Believe]
    options: tuple[Any, ...] = (None,)
    says: Callable[[Any, Any], str] = lambda _, __: "nothing to choose"


def _rosen(mean: float, mean_stay_s: float) -> Believe:
    """Rosen's filter from the first detection on; before it, the long-term mean."""
    model = OneStay(Exponential(1.0 / mean_stay_s))

    def believe(looks: Looks, instants: Instants) -> FloatArray:
        p_present = model.track(looks, instants).p_present
        return np.where(np.isnan(p_present), mean, p_present)

    return believe


def _tracked(learned: Any, _: Any) -> Believe:
    """What a learned model of presence believes."""
    model: PresenceModel = learned.model
    return lambda looks, instants: model.track(looks, instants).p_present


def _kind(learned: Any, _: Any) -> str:
    """Which of the kinds that learning considers it took."""
    return str(learned.candidates[0].name)


def _phases(structure: str, *, rhythm: bool) -> Callable[[Looks], Any]:
    def learn(looks: Looks) -> Any:
        from evermap.existence import learn_phases

        return learn_phases.learn(looks, phases=structure, rhythm=rhythm)

    return learn


def _sojourns(*, rhythm: bool) -> Callable[[Looks], Any]:
    def learn(looks: Looks) -> Any:
        from evermap.existence import learn_sojourns

        return learn_sojourns.learn(looks, rhythm=rhythm)

    return learn


LAST = Contender("last", "last observation", lambda looks: float(looks.detected[-1]), last_look)
MEAN = Contender(
    "mean",
    "long-term mean",
    long_term_mean,
    lambda mean, _: lambda _looks, instants: np.full(len(instants.stamp_s), mean),
    says=lambda mean, _: f"{mean:.3f}",
)
PERIODIC = Contender(
    "periodic",
    "periodic (weekly) mean",
    week_counts,
    periodic,
    PERIODIC_OPTIONS,
    lambda _, option: f"smoothed by {option.smooth_s / 60:g} min, {option.weeks:g} weeks of the like day",
)
ROSEN = Contender(
    "rosen",
    "Rosen's filter (never returns)",
    long_term_mean,
    _rosen,
    MEAN_STAYS_S,
    lambda _, stay_s: f"mean stay {stay_s / 60:g} min",
)
SPECTRAL = Contender(
    "spectral",
    "spectral, FreMEn-style",
    spectrum,
    spectral,
    SPECTRAL_OPTIONS,
    lambda _, option: f"{option.harmonics} harmonics, within {option.margin:g} of 0 and 1",
)
TWO_STATE = Contender(
    "two_state", "phase-type, two states", _phases("two-state", rhythm=False), _tracked, says=lambda *_: "rates by EM"
)
PHASES = Contender("phase_type", "phase-type, structure learned", _phases("auto", rhythm=False), _tracked, says=_kind)
PHASES_RHYTHM = Contender(
    "phase_type_rhythm",
    "phase-type, three phases and rhythm",
    _phases("three-phase", rhythm=True),
    _tracked,
    says=lambda *_: "rates by EM",
)
RUN_LENGTH = Contender("run_length", "run-length", _sojourns(rhythm=False), _tracked, says=_kind)
RUN_LENGTH_RHYTHM = Contender(
    "run_length_rhythm", "run-length with rhythm", _sojourns(rhythm=True), _tracked, says=_kind
)

ROOM = (LAST, MEAN, ROSEN, SPECTRAL, TWO_STATE, PHASES, RUN_LENGTH)
"""Three hours have no days: no rhythm, no periodic mean."""
DOOR = (LAST, MEAN, PERIODIC, ROSEN, SPECTRAL, TWO_STATE, PHASES_RHYTHM, RUN_LENGTH, RUN_LENGTH_RHYTHM)
HOME = (MEAN, PERIODIC, TWO_STATE, RUN_LENGTH_RHYTHM)
"""A few of them once more, where nothing was made to fit."""
ROOM_DEFAULT, DOOR_DEFAULT = RUN_LENGTH, RUN_LENGTH_RHYTHM
