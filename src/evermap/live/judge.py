"""Beliefs of landmarks in view, and changes, during a drive."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evermap.config import Config, LivingConfig
from evermap.live.inbox import LiveFrame
from evermap.live.keeper import News
from evermap.maps.living import LivingMap
from evermap.maps.sessions.looks import Sighting
from evermap.maps.sessions.session import judge_so_far, lives_of
from evermap.maps.vicinity import Vicinity, near
from evermap.slam.batch import sight_at
from evermap.slam.known_places import KnownPlaces
from evermap.slam.localize import Located
from evermap.types import UNKNOWN, ChangeKind, FloatArray, IntArray, Landmarks, MapChange, Sensor, rows_of

REST_S = 2.5e-4
"""Minimum time between two updates per sighting: some twenty times what an update takes."""


class _Glance(NamedTuple):
    """A frame: stamp and pose (3,); landmarks (H,) that were seen at places of the map, with the sites of these; and
    landmarks (K,) of the map that were seen elsewhere, with how far (K, 2) from their places.
    """

    stamp_s: float
    pose: FloatArray
    landmark_id: IntArray
    site_id: IntArray
    elsewhere_id: IntArray
    away_m: FloatArray


class Judge:
    """Accumulated looks at a map, evaluated from time to time by another thread.

    `places` are the map as the localiser has it. Looks of the one `before`, of the map as it was, go on where they are
    later than this map.
    """

    def __init__(
        self, living: LivingMap, places: KnownPlaces, sensor: Sensor, config: Config, before: Judge | None = None
    ) -> None:
        self._lock = threading.Lock()
        self._whole, self._sensor, self._config = living, sensor, config
        self._names = places.landmark_id
        self._sites = living.places.site_id[places.joint_row]
        self._position_m = places.position_m
        self._mount = np.array(sensor.mount_robot_sensor, dtype=np.float64)
        self._classes = lives_of(living, config.living)
        self._table = living.landmarks()
        earlier = () if before is None else before._glances
        self._glances: list[_Glance] = [one for one in earlier if one.stamp_s > living.stamp_s]
        self._news = News()
        self._after: tuple[LivingMap, Vicinity | None] = living, None
        self.rest_s = 0.0
        """Minimum time until the next update."""

    @property
    def living(self) -> LivingMap:
        """The map with its present beliefs."""
        after, vicinity = self._after
        return after if vicinity is None else vicinity.put_back(after)

    def look(self, frame: LiveFrame, located: Located, states: FloatArray) -> None:
        """Take the looks of a frame, with (11,) calibration states; a subset of dense frames."""
        if located.lost or not len(located.expected):
            return
        if self._glances and frame.stamp_s < self._glances[-1].stamp_s + self._config.live.look_s:
            return
        known = located.place != UNKNOWN
        seen, off = (located.place[known & some] for some in (located.p_inlier > 0.5, located.p_inlier <= 0.5))
        reading = frame.rows[known & (located.p_inlier <= 0.5), 1:3]
        away_m = sight_at(located.pose, reading, states, self._mount) - self._position_m[off]
        glance = _Glance(frame.stamp_s, located.pose, self._names[seen], self._sites[seen], self._names[off], away_m)
        with self._lock:
            self._glances.append(glance)

    def judge(self) -> None:
        """Ask what the looks say."""
        with self._lock:
            glances = self._glances[:]
        if len(glances) < 2:
            return
        self.rest_s = REST_S * sum(len(one.landmark_id) for one in glances)
        config, whole = self._config.living, self._whole
        living, vicinity = whole, None
        if len(whole.places) > config.whole_places:
            vicinity = _around(whole, glances, self._sensor, config)
            living = vicinity.part
        after, told = judge_so_far(living, _list_sights(living, glances), self._sensor, config, self._classes)
        changes, judged = _with_moves(told, glances, self._config.slam.fewest_sightings), after.landmarks()
        with self._lock:
            self._after = after, vicinity
            at = np.searchsorted(self._table.landmark_id, judged.landmark_id)
            p_exists = self._table.p_exists.copy()
            p_exists[at] = judged.p_exists
            self._table = replace(self._table, p_exists=p_exists)
            self._news.add(changes)
        if glances[-1].stamp_s - glances[0].stamp_s > self._config.live.beliefs_s:
            whole = self.living
            with self._lock:
                self._whole, self._after = whole, (whole, None)
                self._glances = self._glances[len(glances) :]
                self._news.known.clear()

    def told(self) -> tuple[MapChange, ...]:
        """Return changes that were not returned before."""
        with self._lock:
            return self._news.taken()[0]

    def in_view(self, located: Located) -> Landmarks:
        """Return the landmarks that are, or should be, in view, with their present beliefs."""
        with self._lock:
            table = self._table
        seen = located.place[located.place != UNKNOWN]
        names = np.unique(self._names[np.concatenate([located.expected, seen])])
        at = np.searchsorted(table.landmark_id, names)
        at = at[at < len(table)]
        shown: Landmarks = rows_of(table, at[np.isin(table.landmark_id[at], names)])
        return shown


def _list_sights(living: LivingMap, glances: Sequence[_Glance]) -> Sighting:
    """Looks by rows of the map's places."""
    frame = np.repeat(np.arange(len(glances)), [len(one.landmark_id) for one in glances])
    place = living.place_row(
        np.concatenate([one.landmark_id for one in glances]), np.concatenate([one.site_id for one in glances])
    )
    stamps, pose = np.array([one.stamp_s for one in glances]), np.array([one.pose for one in glances])
    return Sighting(stamps, pose, frame[place >= 0], place[place >= 0])


def _with_moves(changes: Sequence[MapChange], glances: Sequence[_Glance], fewest: int) -> list[MapChange]:
    """Return changes in which a landmark that left its place and is seen at a new one has moved."""
    names = np.concatenate([one.elsewhere_id for one in glances])
    away_m = np.concatenate([one.away_m for one in glances])
    told = []
    for change in changes:
        mine = np.isin(names, change.landmark_ids)
        if change.kind is ChangeKind.VANISHED and np.count_nonzero(mine) >= fewest:
            x, y = np.median(away_m[mine], axis=0).tolist()
            n_hits = int(np.count_nonzero(mine))
            told.append(replace(change, kind=ChangeKind.MOVED, displacement_m=(x, y), n_hits=n_hits))
        else:
            told.append(change)
    return told


def _around(living: LivingMap, glances: Sequence[_Glance], sensor: Sensor, config: LivingConfig) -> Vicinity:
    """The part of a large map that may have been in view."""
    path_m = np.array([one.pose[:2] for one in glances])
    reach_m = sensor.range_max_m + 1.0
    if not np.isfinite(reach_m):
        return Vicinity.of(living, np.unique(living.sites.clique_id), config, jointly=False)
    cliques, box = near(living, path_m, reach_m)
    return Vicinity.of(living, cliques, config, box, jointly=False)


def warm_up(config: Config) -> None:
    """Compile what a step needs, or load it."""
    from evermap.maps.sessions import open_space
    from evermap.slam import localize_recording, warmup

    localize_recording.warm_up()
    open_space.warm_up()
    warmup.warm_up(search=False)
    marks = Landmarks.at([0, 1, 2], [[2.0, 0.0], [2.0, 1.0], [9.0, 9.0]], sigma_m=0.1)
    living = LivingMap.begun(marks).from_now_on(0.0)
    pose, frame = np.zeros((3, 3)), np.array([0, 1, 2, 2])
    sighting = Sighting(np.array([1.0, 2.0, 3.0]), pose, frame, np.array([0, 0, 0, 1]))
    judge_so_far(living, sighting, Sensor(range_max_m=5.0), config.living)
