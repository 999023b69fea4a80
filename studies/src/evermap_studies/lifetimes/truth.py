"""The truth of the pipeline: lifetimes by class and place from irregular patrols, and how often bands hold the truth.

Every estimator is given the same stays of one class at one place. Two know what a stay says and what it does not: the
bounds of its two ends, and that what was never seen is missing. The others leave something out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from evermap.errors import NumericalError
from evermap.survival import LifetimePrior
from evermap.survival.censored import CensoredLifetimes, lifetimes_of_sightings
from evermap.survival.gaussian_process import gp_fit
from evermap.survival.nonparametric import kaplan_meier
from evermap.survival.parametric_fit import fit, fit_best
from evermap.types import FloatArray
from evermap_studies.lifetimes.sightings import fit_sightings, settled_samples, weighted_sightings
from evermap_studies.worlds.patrol_lifetimes import PatrolRun, PatrolWorld, simulate_patrols

SHARES = (0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95)
"""Of true lifetimes that are over at the times at which bands are judged."""
KINDS = ("exponential", "weibull", "lognormal", "two-exponentials")
"""Among which the parametric estimate chooses."""
INSTANTS = 3
"""Of arrival, for each stay."""

Value = dict[str, Any]
Curve = tuple[FloatArray, FloatArray, FloatArray]
"""Estimated `P(T > t)` at some times, and the two bounds of its 95 % band."""


@dataclass(frozen=True, slots=True)
class Stays:
    """Stays of one class at one place, as somebody who visits it gets to know them; (K,) each, in seconds."""

    elsewhere_s: FloatArray
    first_s: FloatArray
    last_s: FloatArray
    gone_s: FloatArray

    @classmethod
    def of(cls, run: PatrolRun, class_id: int, place_id: int) -> Stays:
        """Those of a run."""
        mine = run.stays_of(class_id, place_id)
        return cls(run.elsewhere_s[mine], run.first_s[mine], run.last_s[mine], run.gone_s[mine])

    def samples(self, given: LifetimePrior | None = None, instants: int = INSTANTS) -> CensoredLifetimes:
        """Censored samples that know of the unseen ones."""
        return weighted_sightings(self.columns, given, instants)

    @property
    def columns(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """In order of time."""
        return self.elsewhere_s, self.first_s, self.last_s, self.gone_s

    def begun_in_view(self) -> Stays:
        """Those whose coming is bounded."""
        known = np.isfinite(self.elsewhere_s)
        return Stays(self.elsewhere_s[known], self.first_s[known], self.last_s[known], self.gone_s[known])


def chosen_family(stays: Stays, t: FloatArray) -> Curve:
    """Maximum likelihood of the family with the least AIC, which one sample a stay is enough to choose.

    A mixture may have no clear maximum with more of them; the Weibull model takes its place.
    """
    kind = fit_best(stays.samples(instants=1), KINDS).kind
    samples = lifetimes_of_sightings(*stays.columns, instants=INSTANTS)
    try:
        found = fit_sightings(kind, *samples)
    except NumericalError:
        found = fit_sightings("weibull", *samples)
    return np.exp(found.prior.log_survival(t)), *found.band(t)


def gaussian_process(stays: Stays, t: FloatArray) -> Curve:
    """No family: a hazard that is a Gaussian process over age."""
    samples = settled_samples(lambda known: gp_fit(known).at().prior(), stays.samples, rounds=2)
    return gp_fit(samples).at().survival(t)


def bounds_alone(stays: Stays, t: FloatArray) -> Curve:
    """A Weibull model of the bounds as plain intervals: those never seen are forgotten."""
    known = stays.begun_in_view()
    found = fit("weibull", CensoredLifetimes.of(known.last_s - known.first_s, known.gone_s - known.elsewhere_s))
    return np.exp(found.prior.log_survival(t)), *found.band(t)


def middle_of_bounds(stays: Stays, t: FloatArray) -> Curve:
    """Kaplan-Meier of lifetimes from the middle of one pair of bounds to the middle of the other."""
    known = stays.begun_in_view()
    came = 0.5 * (known.elsewhere_s + known.first_s)
    ended = np.isfinite(known.gone_s)
    left = np.where(ended, 0.5 * (known.last_s + np.where(ended, known.gone_s, 0.0)), known.last_s) - came
    found = kaplan_meier(CensoredLifetimes.of(left, np.where(ended, left, np.inf)))
    return found.survival(t), *found.band(t)


def sightings_as_lifetimes(stays: Stays, t: FloatArray) -> Curve:
    """Kaplan-Meier of the times from first to last sighting, as if all had ended then."""
    seen = stays.last_s - stays.first_s
    seen = seen[seen > 0.0]
    found = kaplan_meier(CensoredLifetimes.of(seen, seen))
    return found.survival(t), *found.band(t)


def mean_of_sightings(stays: Stays, t: FloatArray) -> Curve:
    """An exponential with the mean time from first to last sighting."""
    seen = stays.last_s - stays.first_s
    spread = 1.96 / np.sqrt(len(seen))
    curve, lower, upper = (np.exp(-t / (seen.mean() * np.exp(s))) for s in (0.0, -spread, spread))
    return curve, lower, upper


ESTIMATORS: dict[str, Callable[[Stays, FloatArray], Curve]] = {
    "chosen family": chosen_family,
    "Gaussian process": gaussian_process,
    "bounds alone": bounds_alone,
    "middle of the bounds": middle_of_bounds,
    "sightings as lifetimes": sightings_as_lifetimes,
    "mean of sightings": mean_of_sightings,
}
"""The first two know everything; what the others leave out is in their descriptions."""
NAIVE = tuple(ESTIMATORS)[2:]


def groups(world: PatrolWorld) -> Iterator[tuple[int, int]]:
    """Every class at every place."""
    for class_id in range(len(world.classes)):
        for place_id in range(len(world.places)):
            yield class_id, place_id


def judge(world: PatrolWorld, repetitions: int, seed: int, progress: Callable[[float], None]) -> list[Value]:
    """Coverage, bias and root mean square error of all estimators, for every class at every place.

    Args:
        world: patrols to draw.
        repetitions: runs, each with its own random stream.
        seed: of all of them.
        progress: told the number of runs that are done.
    """
    shares = np.array(SHARES)
    inside: dict[tuple[str, int, int], list[Any]] = {}
    error: dict[tuple[str, int, int], list[Any]] = {}
    for done, stream in enumerate(np.random.SeedSequence(seed).spawn(repetitions), start=1):
        run = simulate_patrols(world, stream)
        for class_id, place_id in groups(world):
            t = world.quantile(class_id, place_id, shares)
            stays = Stays.of(run, class_id, place_id)
            for name, estimator in ESTIMATORS.items():
                curve, lower, upper = estimator(stays, t)
                key = name, class_id, place_id
                inside.setdefault(key, []).append((lower <= 1.0 - shares) & (1.0 - shares <= upper))
                error.setdefault(key, []).append(curve - (1.0 - shares))
        progress(done)
    return [
        {
            "estimator": name,
            "class": world.classes[class_id].name,
            "place": world.places[place_id].name,
            "coverage": np.mean(inside[name, class_id, place_id], axis=0).tolist(),
            "bias": np.mean(error[name, class_id, place_id], axis=0).tolist(),
            "rmse": np.sqrt(np.mean(np.square(error[name, class_id, place_id]), axis=0)).tolist(),
        }
        for name, class_id, place_id in inside
    ]


def coverage(values: list[Value], estimator: str) -> float:
    """Mean share of the bands that hold the truth."""
    return float(np.mean([value["coverage"] for value in values if value["estimator"] == estimator]))
