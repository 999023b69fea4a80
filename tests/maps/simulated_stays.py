"""Histories of things from known laws, as a map knows them that was looked at in sessions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evermap.maps.lives import Lives
from evermap.maps.living import Stays
from evermap.types import FloatArray
from evermap_studies.sim.config import DAY_S, ObjectClass


@dataclass(frozen=True)
class TrueStay:
    """One thing at one site."""

    thing: int
    kind: int
    site: int
    start_s: float
    end_s: float


def two_looks_a_day(days: int) -> FloatArray:
    """(2 days,) stamps, in the morning and in the afternoon."""
    return np.sort(np.concatenate([(np.arange(days) + share) * DAY_S for share in (0.4, 0.7)]))


def histories(
    classes: Sequence[ObjectClass], end_s: float, rng: np.random.Generator, warmup_s: float
) -> list[TrueStay]:
    """Draw true stays as `evermap_studies.sim.changes` does, without geometry: a new place is a new site."""
    stays: list[TrueStay] = []
    thing = 0
    for kind, law in enumerate(classes):
        arrivals = [-warmup_s] * law.count
        arrivals += list(rng.uniform(0.0, end_s, rng.poisson(law.arrivals_per_day * end_s / DAY_S)))
        for arrival in arrivals:
            start, site, sites = arrival, 0, 1
            while start < end_s:
                end = start + (np.inf if law.stay is None else law.stay.sample_s(rng))
                stays.append(TrueStay(thing, kind, site, start, end))
                if law.mount == "hinge":
                    start, site = end, 1 - site
                    continue
                start = end
                if rng.random() < law.p_vanish:
                    if rng.random() >= law.p_return:
                        break
                    start = end + law.absence.sample_s(rng)
                    if rng.random() < law.p_same_place:
                        continue
                site, sites = sites, sites + 1
            thing += 1
    return stays


def as_seen(true: Sequence[TrueStay], looks_s: FloatArray, position_m: FloatArray | None = None) -> Stays:
    """What is known after looks at everything, at which nothing is overlooked: stays that no look hits are not."""
    rows: list[tuple[float, ...]] = []
    by_thing: dict[int, list[TrueStay]] = {}
    for stay in true:
        by_thing.setdefault(stay.thing, []).append(stay)
    for thing, own in by_thing.items():
        site_at = np.full(len(looks_s), -1)
        for stay in own:
            site_at[(looks_s >= stay.start_s) & (looks_s < stay.end_s)] = stay.site
        changes = np.flatnonzero(np.diff(site_at)) + 1
        for first, after in zip([0, *changes], [*changes, len(looks_s)], strict=True):
            if site_at[first] >= 0:
                elsewhere = looks_s[first - 1] if first > 0 else -np.inf
                gone = looks_s[after] if after < len(looks_s) else np.inf
                site = 1000 * thing + site_at[first]
                rows.append((thing, site, own[0].kind, elsewhere, looks_s[first], looks_s[after - 1], gone))
    table = np.array(sorted(rows, key=lambda row: row[4])).reshape(-1, 7)
    names = table[:, :3].astype(np.int64)
    places = np.zeros((len(table), 2)) if position_m is None else position_m[names[:, 0]]
    p_gone = np.isfinite(table[:, 6]).astype(np.float64)
    return Stays(names[:, 0], names[:, 1], names[:, 2], places, *table[:, 3:].T, p_gone)


def looked(looks_s: FloatArray) -> Lives:
    """Nothing learned, after looks."""
    return Lives(looks_s=looks_s)
