"""Alignment of boxes without identity with a map: by the frame of an odometry, or by their constellation.

One alignment of a session with the map must be far better than all others, since a wrong one is worse than none: rows
of parked cars resemble each other, and cars come and go (`slam.association.constellation`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from evermap.config import BoxesConfig, Config, SlamConfig
from evermap.geometry import se2, se3
from evermap.geometry.chunked import blocks
from evermap.geometry.rigid import rigid
from evermap.maps.living import LivingMap
from evermap.maps.sessions.box_visit import SeenBoxes
from evermap.slam.association.constellation import LocalMap, list_agreed_pairs
from evermap.slam.association.identify import ALL_TRIED
from evermap.slam.association.place_index import PlaceIndex
from evermap.tracking.frame import heading_of
from evermap.types import BoolArray, FloatArray, IntArray

GATE = 18.4
"""Squared distance of two dimensions that one of 10,000 exceeds."""
WINDOWS = 12, 6
"""Boxes, one after the other on the way, that are searched for in the map together; fewer where it is known about."""
TESTED_M2 = 157.0
"""Area that one trial of the search covers: chance agreement is proportionally more probable in a large map."""
FACTORS = 1.0, 0.99, 1.01, 0.98, 1.02
"""Candidate factors on the lengths of a session with the scale of its odometry."""


class MapBoxes(NamedTuple):
    """Boxes of a map at their places: (M,) rows.

    Attributes:
        place: row of the map's places.
        landmark_id, class_id: which.
        position_m, covariance_m2: (M, 3), (M, 3, 3).
        heading_rad, size_m: (M,), nan where there is none, and (M, 3).
        p: probability that it stands there when the session begins.
        settings: which boxes are the same.
        slam: settings of the alignment by constellation.
    """

    place: IntArray
    landmark_id: IntArray
    class_id: IntArray
    position_m: FloatArray
    covariance_m2: FloatArray
    heading_rad: FloatArray
    size_m: FloatArray
    p: FloatArray
    settings: BoxesConfig
    slam: SlamConfig

    @classmethod
    def of(cls, living: LivingMap, p_site: FloatArray, config: Config) -> MapBoxes:
        """Return those of a map, by beliefs (S,) in its sites."""
        places, members, settings = living.places, living.members, config.living.boxes
        row = np.flatnonzero(np.isin(places.landmark_id, living.boxes.landmark_id))
        name = places.landmark_id[row]
        known = np.isfinite(places.rotation[row, :1])
        pose = np.hstack([places.position_m[row], np.where(known, places.rotation[row], se3.NO_TURN)])
        member = np.searchsorted(members.landmark_id, name)
        p = p_site[np.searchsorted(living.sites.site_id, places.site_id[row])]
        return cls(
            row, name, members.class_id[member], places.position_m[row],
            blocks(living.covariance_m2, 3)[row].reshape(-1, 3, 3),
            np.where(known[:, 0], heading_of(pose), np.nan), living.boxes.of(name),
            np.where(members.deleted[member], settings.p_stands, p), settings, config.slam,
        )  # fmt: skip


def placed(seen: SeenBoxes, known: MapBoxes, *, metre: bool) -> tuple[FloatArray, float] | None:
    """Return the motion (7,) from a session to the map, and the factor on its lengths; None if these are ambiguous.

    The session is in the frame of its odometry. Where its `metre` is known the factor is 1.
    """
    if not len(known.place) or not len(seen.place):
        return None
    every, sized = np.ones(len(known.place), dtype=np.bool_), np.flatnonzero(np.isfinite(seen.size_m[:, 0]))
    windows = _windows(sized, seen, WINDOWS[0])
    best = max((_list_agreeing(seen, known, some, every, np.zeros(3)) for some in windows), key=len, default=[])
    settings = known.settings
    if len(best) < settings.shared_pairs:
        best = _search_pairs(seen, known, windows, (1.0,) if metre else FACTORS)
        if len(best) < settings.found_pairs:
            return None
    mine, theirs = (np.array(part) for part in zip(*best, strict=True))
    factor = 1.0 if metre else _factor(seen.position_m[mine, :2], known.position_m[theirs, :2], settings)
    own = np.column_stack([factor * seen.position_m[mine, :2], seen.position_m[mine, 2]])
    return in_space(rigid(own[:, :2], known.position_m[theirs, :2]), own, known.position_m[theirs]), factor


def _search_pairs(
    seen: SeenBoxes, known: MapBoxes, windows: list[IntArray], factors: tuple[float, ...]
) -> list[tuple[int, int]]:
    """Pairs of boxes that are the same, by the constellation of some at a time; the largest such set."""
    every, best = np.ones(len(known.place), dtype=np.bool_), list[tuple[int, int]]()
    for factor in factors:
        scaled = replace(seen, position_m=factor * seen.position_m)
        for some in windows:
            best = max(best, _list_agreeing(scaled, known, some, every), key=len)
            if len(best) >= known.settings.enough_pairs:
                return best
        if len(best) >= known.settings.found_pairs:
            return best
    return best


def _factor(own_m: FloatArray, there_m: FloatArray, settings: BoxesConfig) -> float:
    """Return the ratio of distances between points (K, 2) in the map to those given; 1 if it is hardly determined."""
    own, there = (np.linalg.norm(at[:, None] - at[None], axis=2) for at in (own_m, there_m))
    factor = float((own * there).sum() / max(float((own**2).sum()), 1e-9))
    spread_m = float(np.linalg.norm(own_m - own_m.mean(axis=0)))
    return factor if abs(factor - 1.0) * spread_m > settings.metre_sigmas * math.sqrt(2.0) * settings.drift_m else 1.0


def regain(seen: SeenBoxes, known: MapBoxes, place: IntArray) -> tuple[IntArray, IntArray]:
    """Return matching rows of boxes of a session, in the map as far as it is known, and of the map, by their
    constellation.

    Those of the session stand at places (K,) of the map, -1 for none.
    """
    found: dict[int, int] = {}
    left = np.flatnonzero((place < 0) & np.isfinite(seen.size_m[:, 0]))
    for some in [window for size in WINDOWS for window in _windows(left, seen, size)]:
        free = ~np.isin(known.place, place)
        away = np.linalg.norm(known.position_m[:, None, :2] - seen.position_m[some, :2], axis=2).min(axis=1)
        pairs = _list_agreeing(seen, known, some, free & (away < known.settings.near_m))
        if len(pairs) < known.settings.found_pairs:
            continue
        mine, theirs = (np.array(part) for part in zip(*pairs, strict=True))
        motion = rigid(seen.position_m[mine, :2], known.position_m[theirs, :2])
        off = np.linalg.norm(se2.transform(motion, seen.position_m[mine, :2]) - seen.position_m[mine, :2], axis=1)
        if abs(motion[2]) < known.settings.largest_turn_rad and off.max() < known.settings.near_m:
            taken = set(found.values())
            found |= {one: other for one, other in pairs if one not in found and other not in taken}
    return np.array(list(found), dtype=np.int64), np.array(list(found.values()), dtype=np.int64)


def _windows(rows: IntArray, seen: SeenBoxes, size: int) -> list[IntArray]:
    """Boxes, some at a time, in the order in which they were met."""
    return windows(rows[np.argsort(seen.first_s[rows], kind="stable")], size) if len(rows) > 1 else []


def windows(rows: IntArray, size: int) -> list[IntArray]:
    """Return rows, `size` at a time, each half of them with those before and half with those after."""
    return [rows[k : k + size] for k in range(0, max(len(rows) - size // 2, 1), size // 2)]


def _list_agreeing(
    seen: SeenBoxes, known: MapBoxes, some: IntArray, among: BoolArray, motion: FloatArray | None = None
) -> list[tuple[int, int]]:
    """Pairs of some boxes of a session with some of the map that are certain; by any motion, or by one that is given.

    Of a covariance only what neighbours do not share matters: those next to each other drift alike.
    """
    row, settings = np.flatnonzero(among), known.settings
    if len(row) < 2 or len(some) < 2:
        return []
    at, area_m2 = known.position_m[row, :2], float(np.prod(np.ptp(known.position_m[row, :2], axis=0) + 10.0))
    source = LocalMap(seen.position_m[some, :2], block_diag(*_floor(seen.covariance_m2[some], settings.drift_m)))
    motions = None if motion is None else [motion]
    if motion is None and len(row) > ALL_TRIED:
        sigma_m = math.sqrt(float(np.trace(source.covariance)) / len(some))
        index = PlaceIndex(at, _floor(known.covariance_m2[row], settings.drift_m), settings=known.slam)
        motions = list(index.motions(source.place, sigma_m))
    anywhere_nats = known.slam.association.constellation.certain_nats + max(math.log(area_m2 / TESTED_M2), 0.0)
    found = list_agreed_pairs(
        source,
        LocalMap(at, block_diag(*_floor(known.covariance_m2[row], settings.drift_m))),
        _alike(seen, known)[np.ix_(some, row)],
        density=max(len(row) / area_m2, settings.density),
        probability=settings.p_stands,
        motions=motions,
        margins_nats=(anywhere_nats if motion is None else settings.shared_nats, settings.lead_nats),
        settings=known.slam,
    )
    pairs = [(int(some[k]), int(row[m])) for k, m in found]
    return pairs if not pairs or _headings_agree(seen, known, pairs) else []


def _floor(covariance_m2: FloatArray, drift_m: float) -> FloatArray:
    """(K, 2, 2) of positions on the floor."""
    own = np.minimum(np.diagonal(covariance_m2[:, :2, :2], axis1=1, axis2=2), drift_m**2)
    return np.asarray((own + drift_m**2)[:, :, None] * np.eye(2))


def in_space(motion: FloatArray, own_m: FloatArray, there_m: FloatArray) -> FloatArray:
    """Return a motion (3,) on the floor as one in space (7,), with the difference in height of points (K, 3)."""
    pose = se3.from_plane(motion)
    pose[2] = np.median(there_m[:, 2] - own_m[:, 2])
    return pose


def _alike(seen: SeenBoxes, known: MapBoxes) -> BoolArray:
    """(K, M) boxes that may be one by their class, and by their size about."""
    off = (seen.size_m[:, None] - known.size_m[None]) / np.array(known.settings.sigma_class_m)
    return np.asarray((seen.class_id[:, None] == known.class_id) & ~((off**2).sum(axis=2) > GATE))


def _headings_agree(seen: SeenBoxes, known: MapBoxes, pairs: list[tuple[int, int]]) -> bool:
    """Return whether the headings of boxes agree with the motion of their positions."""
    mine, theirs = (np.array(part) for part in zip(*pairs, strict=True))
    turn = rigid(seen.position_m[mine, :2], known.position_m[theirs, :2])[2]
    off = half_turn(known.heading_rad[theirs] - seen.heading_rad[mine] - turn)
    off = off[np.isfinite(off)]
    return not len(off) or float(np.median(np.abs(off))) < 3.0 * known.settings.heading_rad


def half_turn(angle_rad: FloatArray) -> FloatArray:
    """Return angles between directions that are the same the other way round."""
    return np.asarray(np.remainder(angle_rad + 0.5 * np.pi, np.pi) - 0.5 * np.pi)
