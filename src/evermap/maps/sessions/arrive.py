"""Whether a landmark that the map did not know has appeared, or had only not been seen yet.

It has appeared if its place was seen empty: an earlier session looked at it from where it is seen now, or past it at
something behind. With `t` the time since that look and `S` the survival of its class in this place,

    odds(appeared) = (1 - S(t)) / S(t) / P(all looks missed it | it was there)

since the age of what one comes upon is distributed as a stay is, if hazards are constant (which of them is what is not
known of a class). Without a look the map grew, and nothing has changed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from evermap.maps.living import LivingMap
from evermap.maps.sessions.believe import ALONG_M, Looks, class_of, clique_rows, site_middles
from evermap.sensing.sightlines import HEADINGS, Views, offsets
from evermap.sensing.visibility import NominalField
from evermap.types import BoolArray, FloatArray, IntArray, Sensor

NEAR_M = 0.6
"""Positions this close to one from which a place was seen have a clear line to it, too [m]."""
LEAST_EXPECTED = 2.0
"""Detections that earlier looks must have been expected to give to count as looks."""
STICKY = 2.0
"""Frames in a row that say as much as one that is independent of all others."""


@dataclass(frozen=True, slots=True)
class Arrivals:
    """Where cliques were seen that had no site there before: (A,) rows.

    Attributes:
        site: (A,) row of the new site.
        looked_s: (A,) last time before this session at which its place was looked at; -inf for never.
        p_appeared: (A,) probability that it came after that; 0 without a look.
    """

    site: IntArray
    looked_s: FloatArray
    p_appeared: FloatArray


def arrivals(before: LivingMap, after: LivingMap, looks: Looks, sensor: Sensor) -> Arrivals:
    """What earlier sessions saw of the places of new sites.

    Args:
        before: the map as the session found it.
        after: with the sites that it found.
        looks: of the session, at places of `after`.
        sensor: of the session.
    """
    new = np.flatnonzero(~np.isin(after.sites.site_id, before.sites.site_id))
    looked, p_appeared = np.full(len(new), -np.inf), np.zeros(len(new))
    if not len(before.views) or not len(new):
        return Arrivals(new, looked, p_appeared)
    at_eye = replace(sensor, mount_robot_sensor=(0.0, 0.0, 0.0))
    cliques, row = clique_rows(after.sites)
    kinds, middle = class_of(after, cliques), site_middles(after)
    site_of_place = np.searchsorted(after.sites.site_id, after.places.site_id)
    cells, p_hidden = after.sightlines.cell_m, float(before.sightlines.p_hidden[2])
    rays = _Rays.of(before)
    for k, site in enumerate(new.tolist()):
        expected: dict[float, float] = {}
        log_missed: dict[float, float] = {}
        for place in np.flatnonzero(site_of_place == site).tolist():
            mine = looks.rows.hit & (looks.place == place)
            place_m = after.places.position_m[place]
            seen_from = place_m + offsets(np.unique(looks.cell[mine]), cells)
            frames, rate, stamps = _empty_looks(before.views, rays, seen_from, place_m, at_eye)
            for stamp in np.unique(stamps):
                then = stamps == stamp
                expected[stamp] = expected.get(stamp, 0.0) + float(frames[then] @ rate[then])
                log_missed[stamp] = log_missed.get(stamp, 0.0) + float(frames[then] @ np.log1p(-rate[then])) / STICKY
        enough = [stamp for stamp, number in expected.items() if number >= LEAST_EXPECTED]
        if not enough:
            continue
        looked[k] = max(enough)
        missed = p_hidden + (1.0 - p_hidden) * np.exp(log_missed[looked[k]])
        stay = after.lives.of(int(kinds[row[site]]), middle[site]).stay
        young = -float(np.expm1(stay.log_survival(after.stamp_s - looked[k])))
        p_appeared[k] = young / (young + (1.0 - young) * missed)
    return Arrivals(new, looked, p_appeared)


@dataclass(frozen=True, slots=True)
class _Rays:
    """Lines along which a place was seen: (K, 2) from, (K, 2) to."""

    from_m: FloatArray
    to_m: FloatArray

    @classmethod
    def of(cls, living: LivingMap) -> _Rays:
        lines = living.sightlines
        row = living.place_row(lines.landmark_id, lines.site_id)
        used = (row >= 0) & (lines.hits >= 0.5)
        to_m = living.places.position_m[row[used]]
        return cls(to_m + offsets(lines.cell[used], lines.cell_m), to_m)

    def pass_by(self, eye_m: FloatArray, place_m: FloatArray) -> BoolArray:
        """(V,) whether something behind a place (2,) was seen from eyes (V, 2), past the place."""
        away = place_m - self.from_m
        ahead = self.to_m - self.from_m
        length = np.maximum(np.hypot(*ahead.T), 1e-9)
        along = (away * ahead).sum(axis=1) / length
        across = np.abs(away[:, 0] * ahead[:, 1] - away[:, 1] * ahead[:, 0]) / length
        past = self.from_m[(across < ALONG_M) & (along > 0.0) & (length > along + ALONG_M)]
        gap = np.linalg.norm(eye_m[:, None] - past[None], axis=2).min(axis=1, initial=np.inf)
        return np.asarray(gap <= NEAR_M)


def _empty_looks(
    views: Views, rays: _Rays, seen_from_m: FloatArray, place_m: FloatArray, sensor: Sensor
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Frames of earlier views that would have shown a place, its detection rate in them, and when they were."""
    pose = views.pose
    near = np.linalg.norm(pose[:, None, :2] - seen_from_m[None], axis=2).min(axis=1, initial=np.inf) <= NEAR_M
    near |= rays.pass_by(pose[:, :2], place_m)
    pose = pose[near]
    half, field = np.pi / HEADINGS, NominalField(sensor)
    rate = np.min(
        [field.p_detect(pose + np.array([0, 0, turn]), place_m[None])[:, 0] for turn in (-half, half)],
        axis=0,
        initial=1.0,
    )
    good = field.worth_a_look(rate)
    return views.frames[near][good], rate[good], views.stamp_s[near][good]
