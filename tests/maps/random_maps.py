"""Living maps of seeded random content, and whether two are the same bit by bit."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from evermap.existence.sites import Evidence
from evermap.maps.lives import EVERYWHERE, Life, Lives
from evermap.maps.living import LivingMap, Members, Metres, Places, Sites, Stays
from evermap.sensing.sightlines import HEADINGS, Glimpses, SightLines, Views
from evermap.survival import Exponential, GeneralPurpose, Mixture, PiecewiseConstantHazard, Weibull
from evermap.types import UNKNOWN, ChangeKind, Clock, MapChange

HOUR_S = 3600.0


def random_map(
    seed: int, *, cliques: int = 6, stamp_s: float | None = None, format_1: bool = False, dim: int = 2
) -> LivingMap:
    """A consistent map: every clique has one to three landmarks and one or two sites, each with its stays.

    Args:
        seed: of everything in it.
        cliques: how many.
        stamp_s: of the map; None for any.
        format_1: as it is read where format 1 wrote it, which `data/schema_2.evermap` holds.
        dim: 3 for one in space, in which about half of the places have an orientation.
    """
    random = np.random.default_rng(seed)
    now_s = float(random.uniform(50, 100) * HOUR_S) if stamp_s is None else stamp_s
    clique = np.repeat(np.arange(cliques), random.integers(1, 4, cliques))
    landmark = np.sort(random.choice(10 * len(clique) + 10, len(clique), replace=False)).astype(np.int64)
    site_clique = np.repeat(np.arange(cliques), random.integers(1, 3, cliques))
    share = random.dirichlet(np.ones(3), cliques)
    first = np.append(True, site_clique[1:] != site_clique[:-1])[: len(site_clique)]
    p_here = np.where(first, share[site_clique, 0], share[site_clique, 1])
    since_s = random.uniform(0, 40, len(site_clique)) * HOUR_S
    pairs = [(s, n) for s, c in enumerate(site_clique) for n in landmark[clique == c]]
    place_site, place_landmark = np.array(pairs, dtype=np.int64).reshape(-1, 2).T.copy()
    factor = random.normal(size=(dim * len(pairs), dim * len(pairs))) * 0.02
    order = np.argsort(since_s, kind="stable")
    classes = random.integers(UNKNOWN, 2, cliques)
    lives = Lives(
        class_id=np.array([UNKNOWN, 1]),
        chunk=np.array([[EVERYWHERE, EVERYWHERE], [2, -3]]),
        life=(
            Life(stay=GeneralPurpose(1e-8, 1e-3), absence=Exponential(float(random.uniform(1e-5, 1e-4)))),
            Life(
                stay=Mixture((Weibull(1e5, 0.7), Exponential(1e-9)), (0.25, 0.75)),
                absence=PiecewiseConstantHazard((0.0, 1e4), (1e-4, 1e-7)),
                p_hop=1.0 / 3.0,
                n_stays=7,
                n_ended=3,
            ),
        ),
    )
    living = LivingMap(
        stamp_s=now_s,
        session_start_s=now_s,
        members=Members(
            landmark,
            classes[clique],
            clique.astype(np.int64),
            random.random(len(clique)) < 0.1,
            random.random(len(clique)) < 0.1,
        ),
        sites=Sites(
            np.arange(len(site_clique)),
            site_clique.astype(np.int64),
            p_here,
            p_here,
            since_s,
            since_s + random.uniform(0, 9, len(site_clique)) * HOUR_S,
        ),
        places=Places(
            place_site,
            place_landmark,
            random.uniform(-20, 20, (len(pairs), dim)),
            random.integers(0, 500, len(pairs)),
            random.integers(0, 50, len(pairs)),
        ),
        stays=Stays(
            site_clique[order].astype(np.int64),
            np.arange(len(site_clique))[order],
            classes[site_clique][order],
            random.uniform(-20, 20, (len(site_clique), dim)),
            np.where(random.random(len(order)) < 0.3, -np.inf, since_s[order] - HOUR_S),
            since_s[order],
            since_s[order] + HOUR_S,
            np.where(random.random(len(order)) < 0.5, np.inf, since_s[order] + 2 * HOUR_S),
            np.zeros(len(order)),
        ),
        covariance_m2=factor @ factor.T,
        lives=lives,
        class_names=("pallet", "cart"),
        clock=Clock.RECORDING,
        n_cliques_ever=cliques + seed % 7,
        n_sites_ever=len(site_clique) + seed % 5,
    )
    ended = np.isfinite(living.stays.gone_s)
    if format_1:
        return replace(living, stays=replace(living.stays, p_gone=ended.astype(np.float64)))
    random = np.random.default_rng([seed, dim])
    if dim == 3:
        living = replace(living, places=turned(random, living.places))
    return replace(
        living,
        session_start_s=now_s - 0.5 * HOUR_S,
        sites=replace(living.sites, p_kept=p_here * random.random(len(p_here))),
        stays=replace(living.stays, p_gone=ended * random.uniform(0.5, 1.0, len(ended))),
        sightlines=random_lines(random, living.places),
        metres=Metres(
            np.array([0, 2**52 + 1]),
            random.normal(size=2) * 0.01,
            random.uniform(1e-6, 1e-3, 2),
            np.array([np.inf, 1e4]),
        ),
        views=Views(
            random.integers(-40, 40, (30, 2)),
            random.integers(0, HEADINGS, 30),
            random.uniform(0, 1, 30) * now_s,
            random.integers(1, 9, 30).astype(np.float64),
        ),
        glimpses=Glimpses.empty().joined(random.uniform(-20, 20, (7, 2)), now_s),
    )


def turned(random: np.random.Generator, places: Places) -> Places:
    """Places in space, with an orientation about every other."""
    rotation = random.normal(size=(len(places), 4))
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    spread = random.uniform(1e-4, 1e-2, (len(places), 1, 1)) * np.eye(3)
    points = random.random(len(places)) < 0.5
    rotation[points], spread[points] = np.nan, np.nan
    return replace(places, rotation=rotation, rotation_covariance=spread)


def random_lines(random: np.random.Generator, places: Places) -> SightLines:
    """Some lines of sight to each place."""
    place = np.repeat(np.arange(len(places)), 4)
    target = places.position_m[place, :2]
    sensor = target + random.uniform(-8, 8, (len(place), 2))
    cell = SightLines.empty().cells(sensor, target)
    hit = random.random(len(place)) < 0.5
    lines = SightLines.empty().learned(
        (places.site_id, places.landmark_id), place, cell, hit, random.random(len(place)) + 0.1
    )
    return replace(
        lines,
        hidden=random.uniform(0, 9, 3),
        shown=random.uniform(0, 99, 3),
        open_space=random.uniform(0.1, 9.0, 4),
    )


def random_evidence(seed: int, living: LivingMap, *, looks: int = 40) -> Evidence:
    """What a session could have seen of every clique, the last looks before `stamp_s`."""
    random = np.random.default_rng(seed)
    cliques = np.unique(living.members.clique_id)
    count = len(cliques) * looks
    return Evidence(
        np.repeat(cliques, looks),
        np.tile(living.stamp_s - np.arange(looks)[::-1] * 0.5, len(cliques)),
        random.integers(0, 4, count),
        random.integers(0, 3, count),
        random.uniform(0, 4, count),
        random.normal(size=count) * 3,
        random.random(count),
    )


def random_changes(seed: int, living: LivingMap) -> tuple[MapChange, ...]:
    """Some changes, with everything in them that can be unknown."""
    random = np.random.default_rng(seed)
    names = living.members.landmark_id.tolist()
    step_m, nowhere = tuple(random.normal(size=living.dim).tolist()), (np.nan,) * living.dim
    return (
        MapChange(tuple(names[:2]), ChangeKind.MOVED, 1.5, living.stamp_s, step_m, 0.0, 0.9, 5, 6),
        MapChange(tuple(names[2:3]), ChangeKind.APPEARED, np.nan, living.stamp_s, nowhere, 0.0, 0.75, 9, 0),
    )


def assert_same(left: Any, right: Any, name: str = "map") -> None:
    """Equal types, and equal bits in every array and number."""
    assert type(left) is type(right), name
    if is_dataclass(left):
        for item in fields(left):
            assert_same(getattr(left, item.name), getattr(right, item.name), f"{name}.{item.name}")
    elif isinstance(left, np.ndarray):
        assert left.dtype == right.dtype, name
        assert left.shape == right.shape, name
        assert left.tobytes() == right.tobytes(), name
    elif isinstance(left, tuple):
        assert len(left) == len(right), name
        for k, (one, other) in enumerate(zip(left, right, strict=True)):
            assert_same(one, other, f"{name}[{k}]")
    elif isinstance(left, float):
        assert np.float64(left).tobytes() == np.float64(right).tobytes(), name
    else:
        assert left == right, name
