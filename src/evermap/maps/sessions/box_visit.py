"""A session with boxes without identity, after association with a map: what it found and looked at."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from evermap.config import BoxesConfig, LivingConfig, TrackConfig
from evermap.geometry import se3
from evermap.maps.living import Boxes, LivingMap
from evermap.maps.sessions.extend import Extended, Found
from evermap.maps.sessions.looks import Watch
from evermap.maps.sessions.placing import Laid
from evermap.maps.sessions.spatial import SpatialVisit
from evermap.slam.intake import most_of
from evermap.slam.space.moving import TrafficIntake, conclude_in_traffic
from evermap.slam.space.solve import SpatialSolved
from evermap.tracking.frame import boxes_of, heading_of, mounts_of
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray, SlamResult, SpatialRecording


@dataclass(frozen=True, slots=True)
class SeenBoxes:
    """Static boxes of a session: (K,) rows.

    Attributes:
        place: row of the problem's places.
        class_id, track: the class, and the track that it was first.
        position_m, covariance_m2: (K, 3), (K, 3, 3).
        heading_rad: nan where there is none.
        size_m: (K, 3).
        first_s, last_s: first and last detection.
        since_s, until_s: when it was seen to come, and to leave; nan where it was not.
        p_stay: probability that it stood.
    """

    place: IntArray
    class_id: IntArray
    track: IntArray
    position_m: FloatArray
    covariance_m2: FloatArray
    heading_rad: FloatArray
    size_m: FloatArray
    first_s: FloatArray
    last_s: FloatArray
    since_s: FloatArray
    until_s: FloatArray
    p_stay: FloatArray


def list_boxes(taken: TrafficIntake, solved: SpatialSolved, settings: BoxesConfig) -> SeenBoxes:
    """Return the static boxes of a session at their estimated places."""
    optimum, stands = solved.optimum, taken.stays
    problem, estimate, count = optimum.smoother.problem, optimum.estimate, len(optimum.estimate.place)
    row = taken.used[taken.intake.used]
    given, stay_of = taken.recording.detections, np.full(len(taken.recording.detections), UNKNOWN)
    stay_of[boxes_of(taken.recording)] = stands.stay
    good = np.flatnonzero((optimum.now.weight > problem.settings.inlier) & (stay_of[row] != UNKNOWN))
    place, stay, stamp_s = problem.place[good], stay_of[row[good]], problem.stamp_s[problem.pose_row[good]]
    found, first = np.unique(place, return_index=True)  # detections are in order of time
    last = len(place) - 1 - np.unique(place[::-1], return_index=True)[1]
    mount = estimate.mount(problem)[problem.sensor[good]]
    turn = np.hstack([np.zeros((len(good), 3)), given.rotation[row[good]]])
    with np.errstate(invalid="ignore"):
        ahead = heading_of(se3.compose(se3.compose(estimate.pose[problem.pose_row[good]], mount), turn))
    size = np.full((count, 3), np.nan)
    heading = np.full(count, np.nan)
    for one in found.tolist():
        mine = np.flatnonzero(place == one)
        size[one] = np.nanmedian(given.size_m[row[good[mine]]], axis=0)
        heading[one] = _heading(ahead[mine]) if size[one, 0] > settings.round * size[one, 1] else np.nan
    spread = optimum.smoother.spread(optimum.now)
    at = spread.own_first[len(problem.stamp_s) + found]
    own = spread.own[at[:, None] + np.arange(9)].reshape(-1, 3, 3)
    start_s = taken.intake.start_s
    return SeenBoxes(
        place=found,
        class_id=most_of(problem.place, given.class_id[row], count)[found],
        track=stands.track[stay[first]],
        position_m=estimate.place[found, :3],
        covariance_m2=own,
        heading_rad=heading[found],
        size_m=size[found],
        first_s=start_s + stamp_s[first],
        last_s=start_s + stamp_s[last],
        since_s=stands.since_s[stay[first]],
        until_s=stands.until_s[stay[last]],
        p_stay=np.minimum(stands.p_stay[stay[first]], stands.p_stay[stay[last]]),
    )


def _heading(ahead_rad: FloatArray) -> float:
    """The heading that most detections agree on; a box is detected the wrong way round now and then."""
    good = ahead_rad[np.isfinite(ahead_rad)]
    if not len(good):
        return float("nan")
    axis = 0.5 * float(np.angle(np.exp(2j * good).sum()))
    forth = np.cos(good - axis).sum() >= 0.0
    return axis if forth else float(np.angle(np.exp(1j * (axis + np.pi))))


@dataclass(frozen=True, kw_only=True)
class BoxVisit(SpatialVisit):
    """A session in traffic.

    Attributes:
        taken: its static objects.
        track: settings of the tracker.
        boxes: where they are, by the places of the problem.
        kept: (P,) places that enter the map.
        tied_m: (H, 2) boxes that tie the session to the map; none of a session that begins it.
    """

    taken: TrafficIntake
    track: TrackConfig
    boxes: SeenBoxes
    kept: BoolArray
    tied_m: FloatArray

    @property
    def used(self) -> SpatialRecording:
        """The recording of which `concluded` names rows."""
        return self.taken.recording

    @functools.cached_property
    def landmark_id(self) -> IntArray:
        """(P,) ids of the places of the problem."""
        return self.intake.landmark_id

    def named(self, living: LivingMap) -> LivingMap:
        """Return the map with the names of its new landmarks, and their sizes."""
        kept = np.isin(self.boxes.place, np.flatnonzero(self.kept))
        name = self.landmark_id[self.boxes.place[kept]]
        texts = {text for one, text in self.intake.names.items() if one in name}
        old = living.boxes[~np.isin(living.boxes.landmark_id, name)]
        both = old.joined(Boxes(name, self.boxes.size_m[kept]))
        both = both[np.argsort(both.landmark_id, kind="stable")]
        return replace(living, boxes=both, landmark_texts=tuple(sorted({*living.landmark_texts, *texts})))

    def concluded(self, scratch: str = "first_pose") -> SlamResult:  # noqa: ARG002
        """Return the solved session, with the tracks of moving objects."""
        return conclude_in_traffic(self.taken, self.intake, self.solved, self.track)[0]

    def told(self, some: BoolArray) -> tuple[IntArray, FloatArray]:
        """Return rows (K,) of those of some places (P,) that enter the map, by their ids; and orientations (K, 4)."""
        row, rotation = super().told(some & self.kept)
        heading = np.full(len(self.kept), np.nan)
        heading[self.boxes.place] = self.boxes.heading_rad
        half, known = 0.5 * heading[row], np.isfinite(heading[row])
        rotation[known] = np.column_stack([0.0 * half, 0.0 * half, np.sin(half), np.cos(half)])[known]
        return row, rotation

    def found(self, where: Laid | None, living: LivingMap, config: LivingConfig) -> Found:
        """Return the landmarks of the session in the frame of a map; every box is a body of its own."""
        found = super().found(where, living, config)
        mine = np.isin(found.landmark_id, self.landmark_id[self.boxes.place])
        assert found.rotation is not None
        assert found.rotation_covariance is not None
        tilt_rad = self.intake.problem.settings.traffic.tilt_rad
        spread = np.where(
            (mine & np.isfinite(found.rotation[:, 0]))[:, None, None],
            np.diag([tilt_rad**2, tilt_rad**2, config.boxes.heading_rad**2]),
            found.rotation_covariance,
        )
        number = np.where(mine, np.arange(len(mine)), UNKNOWN)
        return replace(found, rotation_covariance=spread, object_id=number)

    def watched(self, entry: Extended, config: LivingConfig) -> Watch:
        """Return what was looked at: a detection that is of no stay may show a box of the map all the same, and what
        another box hides was not looked at.
        """
        settings = config.boxes
        watch = self.witnessed.unlooked(super().watched(entry, config), entry)
        recording, listed = self.taken.recording, watch.listed
        frame = np.searchsorted(recording.frames.stamp_s, watch.stamp_s - 1e-3)
        rows, at = self._detected()
        of = recording.detections.frame[rows]
        looks = frame[listed.pose] * len(entry.living.places) + listed.landmark
        glimpsed = self._list_glimpses(entry, looks, rows, at, settings) & ~listed.hit
        often = np.bincount(listed.landmark[glimpsed], minlength=len(entry.living.places)) >= settings.fewest_glimpses
        hit = listed.hit | (glimpsed & often[listed.landmark])
        shown = hit | ~glimpsed  # one alone may be a wrong box
        place = entry.living.places.position_m[:, :2]
        order = np.argsort(of, kind="stable")
        first = np.searchsorted(of[order], np.arange(len(recording.frames) + 1))
        length = recording.detections.size_m[rows, 0]
        begin = np.searchsorted(listed.pose, np.arange(len(watch.stamp_s) + 1))
        for view, k in enumerate(frame.tolist()):
            mine = np.arange(begin[view], begin[view + 1])
            mine, other = mine[~hit[mine]], order[first[k] : first[k + 1]]
            if len(mine) and len(other):
                eye, far = watch.eye[view, :2], settings.behind_m
                box, half_m = at[other, :2] - eye, settings.covered * length[other]
                shown[mine] &= ~_is_hidden_by(place[listed.landmark[mine]] - eye, box, half_m, far)
        if len(self.tied_m):
            away = np.linalg.norm(watch.eye[:, None, :2] - self.tied_m, axis=2).min(axis=1)
            shown &= hit | (away <= settings.tied_m)[listed.pose]
        glimpsed_m = self._find_glimpses(rows, at[:, :2], settings)
        return watch._replace(listed=listed._replace(hit=hit).rows(shown), glimpsed_m=glimpsed_m)

    def _find_glimpses(self, rows: IntArray, at_m: FloatArray, settings: BoxesConfig) -> FloatArray:
        """Of boxes, rows (N,) at (N, 2), the positions (K, 2) of those that may stand, but are of no landmark of the
        map, and of none that was seen to leave: where there are several; one alone may be a wrong box.
        """
        taken, of_place = self.taken, self.kept.copy()
        of_place[self.boxes.place[np.isfinite(self.boxes.until_s)]] = True
        assigned = taken.used[self.intake.used][of_place[self.intake.problem.place]]
        moves = boxes_of(taken.recording)[taken.stays.p_static < 0.5]
        at_m = at_m[~np.isin(rows, assigned) & ~np.isin(rows, moves)]
        if not len(at_m):
            return at_m
        count = cKDTree(at_m).query_ball_point(at_m, settings.glimpse_m, return_length=True)
        return np.asarray(at_m[count >= settings.fewest_glimpses])

    def _detected(self) -> tuple[IntArray, FloatArray]:
        """Rows (N,) of boxes in frames that have a pose, and (N, 3) where they are."""
        recording, frames = self.taken.recording, self.intake.frames
        row_of = np.full(len(recording.frames), -1)
        row_of[frames.row] = np.arange(len(frames.row))
        rows = boxes_of(recording)
        rows = rows[row_of[recording.detections.frame[rows]] >= 0]
        seen = self.taken.gauge.range_scale * recording.detections.position_sensor_m[rows]
        eye = se3.compose(self.path[row_of[recording.detections.frame[rows]]], mounts_of(recording)[rows])
        return rows, se3.transform(eye, seen)

    def _list_glimpses(
        self, entry: Extended, looks: IntArray, rows: IntArray, at: FloatArray, settings: BoxesConfig
    ) -> BoolArray:
        """Looks, by frame and place, at boxes of the map that a detection shows which no stay has."""
        living, recording = entry.living, self.taken.recording
        box = np.flatnonzero(np.isin(living.places.landmark_id, living.boxes.landmark_id))
        stands = self.taken.stays
        spare = np.isin(rows, boxes_of(recording)[(stands.stay == UNKNOWN) & ~(stands.p_static < 0.5)])
        rows, at = rows[spare], at[spare]
        if not len(box) or not len(rows):
            return np.zeros(len(looks), dtype=np.bool_)
        found = cKDTree(living.places.position_m[box, :2]).query(at[:, :2])
        away, nearest = np.asarray(found[0]), np.asarray(found[1], dtype=np.int64)
        member = np.searchsorted(living.members.landmark_id, living.places.landmark_id[box[nearest]])
        range_m = np.linalg.norm(recording.detections.position_sensor_m[rows], axis=1)
        here = away < settings.glimpse_m + settings.glimpse_share * range_m
        here &= living.members.class_id[member] == recording.detections.class_id[rows]
        return np.isin(looks, recording.detections.frame[rows[here]] * len(living.places) + box[nearest[here]])


def _is_hidden_by(place: FloatArray, box: FloatArray, half_m: FloatArray, behind_m: float) -> BoolArray:
    """(P,) whether places (P, 2) are behind any of some boxes (B, 2), as seen from the origin."""
    range_m, near_m = np.linalg.norm(place, axis=1), np.maximum(np.linalg.norm(box, axis=1), 0.1)
    along = place / np.maximum(range_m, 0.1)[:, None]
    across = np.abs(along[:, :1] * box[:, 1] - along[:, 1:] * box[:, 0])
    ahead = along @ box.T
    hides = (across < half_m) & (ahead > 0.0) & (near_m < range_m[:, None] - behind_m)
    return np.asarray(hides.any(axis=1))
