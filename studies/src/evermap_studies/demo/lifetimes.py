"""What evermap learned of how long things stay, against the lifetimes that the simulation drew from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.maps.learning import ClassLives
from evermap.survival import Gamma
from evermap.types import FloatArray
from evermap_studies.demo.study import Study
from evermap_studies.sim.config import DAY_S, ObjectClass

QUARTILES = (0.75, 0.5, 0.25)
"""Where the learned curve is held against the truth: the ages up to which these shares truly stay."""
CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class LearnedLife:
    """One class.

    Attributes:
        name: of the class.
        n_stays, n_ended: stays of its cliques in the map's history, and those that were seen to end.
        age_days: (N,) ages.
        truth: (N,) share that truly stays as long.
        mean, low, high: (N,) learned, with the bounds of the 95 % interval.
        covers: (3,) whether the interval holds the truth at the ages of `QUARTILES`; empty where all stay for ever.
    """

    name: str
    n_stays: int
    n_ended: int
    age_days: FloatArray
    truth: FloatArray
    mean: FloatArray
    low: FloatArray
    high: FloatArray
    covers: tuple[bool, ...]


def learned_lives(study: Study) -> tuple[LearnedLife, ...]:
    """Every class of the building, in its order."""
    longest = float(study.scenario.days)
    return tuple(_learned(study, row, kind, longest) for row, kind in enumerate(study.building.config.classes))


def true_life(kind: ObjectClass, change_rate: float) -> Gamma | None:
    """How long a thing of this class truly stays at one place; None for ever."""
    if kind.stay is None or change_rate == 0.0:
        return None
    return Gamma(kind.stay.mean_days * DAY_S / kind.stay.shape / change_rate, kind.stay.shape)


def _learned(study: Study, row: int, kind: ObjectClass, longest_days: float) -> LearnedLife:
    living, truth = study.living, true_life(kind, study.scenario.change_rate)
    span = longest_days if truth is None else min(longest_days, 3.0 * truth.mean() / DAY_S)
    age_days = np.linspace(0.0, span, 61)
    mean, low, high = ClassLives.of(living.stays, living.lives).band(row, age_days * DAY_S, CONFIDENCE)
    covers: tuple[bool, ...] = ()
    if truth is not None:
        at_s = truth.quantile([1.0 - share for share in QUARTILES])
        _, below, above = ClassLives.of(living.stays, living.lives).band(row, at_s, CONFIDENCE)
        covers = tuple((below[k] <= share <= above[k]).item() for k, share in enumerate(QUARTILES))
    mine = living.stays.class_id == row
    return LearnedLife(
        name=kind.name,
        n_stays=int(mine.sum()),
        n_ended=int(np.isfinite(living.stays.gone_s[mine]).sum()),
        age_days=age_days,
        truth=np.ones(len(age_days)) if truth is None else np.exp(truth.log_survival(age_days * DAY_S)),
        mean=mean,
        low=low,
        high=high,
        covers=covers,
    )
