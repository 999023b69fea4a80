"""Thousands of objects that come and go at places which a robot visits irregularly for months, with the whole truth.

What a lifetime estimator has to cope with is all here: lifetimes depend on class and place; nobody sees an object come
or go, only that it was not there at one visit and is at the next; many come and go between two visits and are never
seen at all; some were there before the first visit, some stay after the last; and detectors miss.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from evermap.errors import ConfigError
from evermap.survival import Exponential, LifetimePrior, LogNormal, Mixture, Weibull
from evermap.types import BoolArray, FloatArray, IntArray

DAY_S = 86400.0
P_OVERLOOKED = 1e-3
"""Misses in a row that happen to an object which is there with at most this probability say that it is gone."""


@dataclass(frozen=True, slots=True)
class PatrolClass:
    """A class of objects: its name, and for how long they stay at a place of factor 1."""

    name: str
    lifetime: LifetimePrior


@dataclass(frozen=True, slots=True)
class PatrolPlace:
    """A place, how long things stay there, and how often somebody comes by.

    Attributes:
        name: of the place.
        factor: lifetimes here are those of the class, times this.
        mean_gap_s: mean time between two visits.
    """

    name: str
    factor: float
    mean_gap_s: float

    def __post_init__(self) -> None:
        for name in ("factor", "mean_gap_s"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ConfigError(f"must be positive and finite, not {getattr(self, name)!r}", field=name)


CLASSES = (
    PatrolClass("cart", Exponential(1.0 / DAY_S)),
    PatrolClass("pallet", Weibull(scale_s=3.0 * DAY_S, shape=1.6)),
    PatrolClass("crate", LogNormal.from_half_life(2.0 * DAY_S, sigma=1.0)),
    PatrolClass("car", Mixture.of((Exponential(2.0 / DAY_S), Exponential(1.0 / (12.0 * DAY_S))), (0.5, 0.5))),
)
"""Of one age as of any other, worn out, log-normal, and of two kinds that nobody tells apart."""
PLACES = (
    PatrolPlace("dock", 0.6, 4.0 * 3600.0),
    PatrolPlace("aisle", 1.0, 6.0 * 3600.0),
    PatrolPlace("yard", 1.6, 12.0 * 3600.0),
    PatrolPlace("store", 2.5, 18.0 * 3600.0),
)


@dataclass(frozen=True, slots=True)
class PatrolWorld:
    """The generative model.

    Attributes:
        classes, places: objects are of each class, and at each place, equally often.
        objects: how many come in all.
        duration_s: from the first day of the patrols to the last.
        burn_in_s: objects come from this long before the first day on, evenly in time.
        gap_shape: of the gamma distribution of times between visits; 1 is without memory, less is more irregular.
        p_detect: probability that an object which is there is found at a visit.
    """

    classes: tuple[PatrolClass, ...] = CLASSES
    places: tuple[PatrolPlace, ...] = PLACES
    objects: int = 20_000
    duration_s: float = 150.0 * DAY_S
    burn_in_s: float = 30.0 * DAY_S
    gap_shape: float = 0.7
    p_detect: float = 1.0

    def __post_init__(self) -> None:
        if not (self.classes and self.places and self.objects >= 1):
            raise ConfigError("nothing without classes, places and objects", field="objects")
        for name in ("duration_s", "gap_shape"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ConfigError(f"must be positive and finite, not {getattr(self, name)!r}", field=name)
        if not 0.0 <= self.burn_in_s < math.inf:
            raise ConfigError(f"must be finite and not negative, not {self.burn_in_s!r}", field="burn_in_s")
        if not 0.0 < self.p_detect <= 1.0:
            raise ConfigError(f"must lie in (0, 1], not {self.p_detect!r}", field="p_detect")

    def survival(self, class_id: int, place_id: int, t: FloatArray) -> FloatArray:
        """True `P(T > t)` of a class at a place, for times in seconds."""
        lifetime, factor = self.classes[class_id].lifetime, self.places[place_id].factor
        return np.asarray(np.exp(lifetime.log_survival(t / factor)))

    def quantile(self, class_id: int, place_id: int, p: FloatArray) -> FloatArray:
        """Times in seconds by which true shares `p` of a class at a place are gone."""
        return np.asarray(self.places[place_id].factor * self.classes[class_id].lifetime.quantile(p))


@dataclass(frozen=True, slots=True)
class PatrolRun:
    """Months of patrols: N objects, and K stays as somebody who visits the places gets to know them.

    Attributes:
        world: what it was drawn from.
        class_id, place_id: (N,) rows of the world's classes and places.
        arrival_s, lifetime_s: (N,) truth: there from `arrival` to `arrival + lifetime`.
        visit_s: for each place (V,) times of its visits, increasing.
        object_id: (K,) of each stay; most have one or none, and two if the detector missed it for long.
        elsewhere_s: (K,) the visit before it was first seen; -inf if there was none.
        first_s, last_s: (K,) first and last visit at which it was seen.
        gone_s: (K,) the visit after, if it was missed often enough from then on to be gone; else inf.
    """

    world: PatrolWorld
    class_id: IntArray
    place_id: IntArray
    arrival_s: FloatArray
    lifetime_s: FloatArray
    visit_s: tuple[FloatArray, ...]
    object_id: IntArray
    elsewhere_s: FloatArray
    first_s: FloatArray
    last_s: FloatArray
    gone_s: FloatArray

    def stays_of(self, class_id: int, place_id: int) -> BoolArray:
        """(K,) which stays are of a class at a place."""
        return np.asarray(
            (self.class_id[self.object_id] == class_id) & (self.place_id[self.object_id] == place_id), dtype=np.bool_
        )


def simulate_patrols(world: PatrolWorld, seed: int | np.random.SeedSequence) -> PatrolRun:
    """Draw one run; the same seed gives the same run."""
    rng = np.random.default_rng(seed)
    class_id = rng.integers(0, len(world.classes), world.objects)
    place_id = rng.integers(0, len(world.places), world.objects)
    arrival = rng.uniform(-world.burn_in_s, world.duration_s, world.objects)
    lifetime = np.empty(world.objects)
    for c, one in enumerate(world.classes):
        mine = class_id == c
        lifetime[mine] = one.lifetime.sample(rng, int(mine.sum()))
    lifetime *= np.array([place.factor for place in world.places])[place_id]
    visits = tuple(_visits(place, world, rng) for place in world.places)

    columns: list[tuple[IntArray, ...]] = []
    times: list[tuple[FloatArray, ...]] = []
    for p, visit in enumerate(visits):
        mine = np.flatnonzero(place_id == p)
        of, begin, end, over = _stays(visit, arrival[mine], arrival[mine] + lifetime[mine], world.p_detect, rng)
        around = np.concatenate([[-math.inf], visit, [math.inf]])
        columns.append((mine[of],))
        times.append((around[begin], visit[begin], visit[end], np.where(over, around[end + 2], math.inf)))
    of_all = np.concatenate([c[0] for c in columns])
    elsewhere, first, last, gone = (np.concatenate([t[k] for t in times]) for k in range(4))
    order = np.lexsort((first, of_all))
    return PatrolRun(
        world=world,
        class_id=class_id,
        place_id=place_id,
        arrival_s=arrival,
        lifetime_s=lifetime,
        visit_s=visits,
        object_id=of_all[order],
        elsewhere_s=elsewhere[order],
        first_s=first[order],
        last_s=last[order],
        gone_s=gone[order],
    )


def _visits(place: PatrolPlace, world: PatrolWorld, rng: np.random.Generator) -> FloatArray:
    """Times of a place's visits, until the last day; at least one."""
    most = int(2.0 * world.duration_s / place.mean_gap_s) + 100
    gaps = rng.gamma(world.gap_shape, place.mean_gap_s / world.gap_shape, most)
    visit = np.cumsum(gaps)
    return np.asarray(visit[: max(1, int(np.searchsorted(visit, world.duration_s)))])


def _stays(
    visit: FloatArray, arrival: FloatArray, end: FloatArray, p_detect: float, rng: np.random.Generator
) -> tuple[IntArray, IntArray, IntArray, BoolArray]:
    """Stays at one place: whose, visits of the first and the last sighting, and whether enough misses follow."""
    from_visit = np.searchsorted(visit, arrival, side="left")
    n_looks = np.searchsorted(visit, end, side="right") - from_visit
    of = np.repeat(np.arange(len(arrival)), n_looks)
    look = np.arange(len(of)) - np.repeat(np.cumsum(n_looks) - n_looks, n_looks) + np.repeat(from_visit, n_looks)
    found = rng.random(len(of)) < p_detect
    of, look = of[found], look[found]
    enough = 1 if p_detect == 1.0 else max(1, math.ceil(math.log(P_OVERLOOKED) / math.log1p(-p_detect)))
    new = np.ones(len(of), dtype=np.bool_)
    new[1:] = (np.diff(of) != 0) | (np.diff(look) > enough)
    begins = np.flatnonzero(new)
    ends = np.concatenate([begins[1:], [len(of)]]) - 1 if len(of) else begins
    return of[begins], look[begins], look[ends], np.asarray(look[ends] + enough < len(visit))
