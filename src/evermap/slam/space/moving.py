"""Boxes without identity around a moving robot: static ones constrain its poses, moving ones are tracked.

The tracker gives the boxes identities where the odometry has the robot; what stands by them shows the errors that
odometry and detector repeat (`gauge`); with these taken off, the tracker is asked again, until nothing changes. What
stands is then a landmark for as long as it does, and the rest is the solver's.

Where landmarks with identities locate the robot, they are solved first, as in a recording without boxes: with noise of
the odometry, and with rests of bodies. Boxes are then followed along that path, and what stands joins the solution.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from evermap.config import SpaceConfig, StillConfig, TrackConfig, TrafficConfig
from evermap.errors import ConfigError, DataError
from evermap.geometry import se3
from evermap.geometry.symmetry import Symmetries
from evermap.slam.intake import most_of, usable_detections
from evermap.slam.space.bodies import FEWEST, with_rests
from evermap.slam.space.bridge import bridge
from evermap.slam.space.drift import Gauge, gauge_of
from evermap.slam.space.estimate import converge, first_places
from evermap.slam.space.intake import SpatialIntake, prepare_space, scale_between
from evermap.slam.space.problem import SpatialProblem
from evermap.slam.space.result import conclude_in_space, distinguish
from evermap.slam.space.smoother import SpatialSmoother
from evermap.slam.space.solve import SpatialSolved, solve_space, times_of
from evermap.tracking.frame import Poses, box_table, boxes_of, in_world, mounts_of, with_empty_frames
from evermap.tracking.run import TrackResult, run_track
from evermap.tracking.standing import Stood, long_enough
from evermap.types import (
    UNKNOWN,
    AnyRecording,
    ChangeKind,
    FloatArray,
    Frames,
    IntArray,
    Landmarks,
    MapChange,
    ParameterEstimate,
    Progress,
    SlamResult,
    SpatialRecording,
    is_in_space,
    rows_of,
)

ROUNDS = 4
SETTLED = 0.2
"""Standard deviations by which the gauge changes in the last round, at most."""
MOSTLY = 0.5
"""Share of the frames beside looks at landmarks that it takes to locate a robot by these."""
WANDERS = 0.03, 0.003
"""From where the noise of an odometry that wanders is sought [m/sqrt(s), rad/sqrt(s)]."""


def has_traffic(recording: AnyRecording) -> TypeGuard[SpatialRecording]:
    """Return whether there are boxes without identity, and odometry."""
    if not is_in_space(recording) or recording.odometry is None:
        return False
    return len(recording.odometry) > 1 and len(boxes_of(recording)) > 0


def run_in_traffic(
    recording: SpatialRecording,
    space: SpaceConfig,
    track: TrackConfig,
    prior_map: Landmarks | None = None,
    progress: Progress | None = None,
) -> SlamResult:
    """Estimate poses, static objects as landmarks, and tracks of moving objects.

    Args:
        recording: with odometry and boxes without identities; landmarks with identities may be there, too.
        space: settings of the estimator.
        track: settings of the tracker.
        prior_map: must be None: boxes have no identities in a map.
        progress: told after every frame.

    Raises:
        ConfigError: a map is given.
        NumericalError: no finite optimum.
    """
    if prior_map is not None:
        problem = "boxes without identity cannot be found in a map that is fixed"
        raise ConfigError(problem, field="prior_map", hint="leave it out, or enter the session into a living map")
    taken = take_in_traffic(recording, space, track)
    result, followed = conclude_in_traffic(taken, taken.intake, solve_in_traffic(taken, progress), track)
    return with_stays(result, taken, followed, track)


@dataclass(frozen=True, slots=True)
class TrafficIntake:
    """A recording in traffic as input of the solver.

    Attributes:
        recording: with a frame for every pose; its other detections are left out.
        rows: (M,) of these in the recording that was given.
        driven: (F, 7) poses by the odometry, from the first frame.
        stays: of static objects, one row per box.
        gauge: systematic errors.
        known: the first identity that is no landmark of the recording: stay `k` has `known + k`.
        used: (K,) rows of the detections that have an identity for the solver.
        standing: the recording with these only, without errors that repeat themselves.
        intake: of that.
        located: the solution of landmarks with identities alone, where these locate the robot; else None, and
            static boxes do.
        boxes: of these beside landmarks that locate the robot; None without any.
    """

    recording: SpatialRecording
    rows: IntArray
    driven: FloatArray
    stays: Stood
    gauge: Gauge
    known: int
    used: IntArray
    standing: SpatialRecording
    intake: SpatialIntake
    located: SpatialSolved | None = None
    boxes: SpatialProblem | None = None


def take_in_traffic(recording: SpatialRecording, space: SpaceConfig, track: TrackConfig) -> TrafficIntake:
    """Return the static objects of a recording with systematic errors removed; arguments as of `run_in_traffic`."""
    recording, rows = _whole(recording)
    assert recording.odometry is not None
    driven_s, pose = recording.odometry.stamp_s, recording.odometry.pose_world_robot
    driven = se3.interpolate(driven_s, pose, recording.frames.stamp_s)
    driven = se3.between(driven[0], driven)
    # the prior of the ranges' scale is what kind and data sheet of the sensors state
    sigma = max(scale_between(recording.sensors, space, space.traffic.sigma_scale)[0], 1e-6)
    space = space.model_copy(update={"traffic": space.traffic.model_copy(update={"sigma_scale": sigma})})
    if is_located(recording, space.traffic):
        return _take_beside_landmarks(recording, rows, driven, space, track)
    return _take_recording(recording, rows, driven, *_settle(recording, driven, space, track), space)


def is_located(recording: SpatialRecording, settings: TrafficConfig) -> bool:
    """Return whether landmarks with identities, on no known body, locate the robot for most of the time."""
    seen, stamp_s = recording.detections, recording.frames.stamp_s
    named = (seen.landmark_id != UNKNOWN) & ~np.isfinite(seen.size_m).all(axis=1)
    named &= ~np.isin(seen.landmark_id, recording.objects[:, 0])
    times = np.unique(seen.landmark_id[named], return_counts=True)[1]
    if np.count_nonzero(times > 1) < FEWEST:
        return False
    seen_s, beside_s = np.unique(stamp_s[seen.frame[named]]), settings.beside_s
    near = np.searchsorted(seen_s, stamp_s + beside_s, side="right") > np.searchsorted(seen_s, stamp_s - beside_s)
    return bool(np.mean(near) > MOSTLY)


def _take_beside_landmarks(
    recording: SpatialRecording, rows: IntArray, driven: FloatArray, space: SpaceConfig, track: TrackConfig
) -> TrafficIntake:
    """The recording as the solver takes it where landmarks locate the robot, with their solution."""
    boxes, given = boxes_of(recording), recording.detections
    others = rows_of(given, np.setdiff1d(np.arange(len(given)), boxes))
    named = with_rests(prepare_space(recording, space), recording, track.still)
    remarks = usable_detections(recording, ())[2], usable_detections(replace(recording, detections=others), ())[2]
    named = replace(named, warnings=(*remarks[1], *named.warnings[len(remarks[0]) :]))  # boxes are not left out
    solved = solve_space(named, None)
    optimum = solved.optimum
    path = bridge(named.frames, optimum.smoother.problem, optimum.estimate, optimum.noise)
    path = se3.interpolate(recording.frames.stamp_s[named.frames.row], path, recording.frames.stamp_s)
    stays, gauge = _settle(recording, path, space, track, bends=False)
    known, range_m = _first_free(recording), np.linalg.norm(given.position_sensor_m[boxes], axis=1)
    identity, variance = np.full(len(given), UNKNOWN), given.covariance_sensor_m2.copy()
    identity[boxes] = np.where(stays.stay == UNKNOWN, UNKNOWN, known + stays.stay)
    sigma_m = track.still.sigma_m + track.still.sigma_share * range_m
    variance[boxes] = sigma_m[:, None, None] ** 2 * np.eye(3)
    position, rotation = given.position_sensor_m.copy(), given.rotation.copy()
    position[boxes] *= gauge.range_scale
    rotation[boxes] = np.nan  # as of boxes alone
    seen = replace(
        given, landmark_id=identity, position_sensor_m=position, rotation=rotation, covariance_sensor_m2=variance
    )
    intake, at_rest = named, None
    if (identity != UNKNOWN).any():
        beside = prepare_space(replace(recording, detections=seen), space, fewest=0)
        at_rest = _share_alike(beside.problem, track.still)
        intake = _join_boxes(named, replace(beside, problem=at_rest))
    seen = replace(seen, landmark_id=np.where(identity == UNKNOWN, given.landmark_id, identity))
    standing = replace(recording, detections=seen, warnings=())
    everything = np.arange(len(given))
    return TrafficIntake(recording, rows, driven, stays, gauge, known, everything, standing, intake, solved, at_rest)


def _share_alike(problem: SpatialProblem, settings: StillConfig) -> SpatialProblem:
    """The problem with boxes whose errors are alike for a while counted once in that time."""
    stamp_s, share = problem.seen_s, np.ones(len(problem.place))
    for one in np.unique(problem.place):
        mine = np.flatnonzero(problem.place == one)
        share[mine] = min(1.0, max(1.0, np.ptp(stamp_s[mine]) / max(settings.alike_s, 1e-6)) / len(mine))
    return replace(problem, share=share)


def _join_boxes(named: SpatialIntake, beside: SpatialIntake) -> SpatialIntake:
    """The input of landmarks with static boxes behind them, of the same frames."""
    problem, order = _with_places_of(named.problem, beside.problem)
    count = len(beside.landmark_id)
    bodies = np.append(named.bodies, np.full(count, UNKNOWN)) if len(named.bodies) else named.bodies
    return replace(
        named,
        problem=problem,
        used=np.append(named.used, beside.used)[order],
        landmark_id=np.append(named.landmark_id, beside.landmark_id),
        boxes=np.append(named.boxes, beside.boxes),
        bodies=bodies,
    )


def _with_places_of(problem: SpatialProblem, other: SpatialProblem) -> tuple[SpatialProblem, IntArray]:
    """The problem with places and detections of another one of the same poses, at noise levels that are known; and the
    order of all detections.
    """
    order = np.argsort(np.append(problem.pose_row, other.pose_row), kind="stable")
    shifted = replace(other, place=other.place + len(problem.oriented))
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(problem, name), getattr(shifted, name)])[order] for name in problem.COLUMNS
    }
    symmetries = Symmetries(problem.symmetries.kinds, np.append(problem.symmetries.of, other.symmetries.of))
    joined = replace(
        problem, **columns, oriented=np.append(problem.oriented, other.oriented), symmetries=symmetries,
        estimate_noise=False,
    )  # fmt: skip
    return joined, order


def _with_boxes(solved: SpatialSolved, boxes: SpatialProblem, first_box: int) -> SpatialSolved:
    """The solution of landmarks with static boxes, rows from `first_box` on, whose errors change none of its levels."""
    optimum, (fitted, _) = solved.optimum, solved.optimum.last
    begun = first_places(boxes, optimum.estimate.pose)
    estimate = replace(optimum.estimate, place=np.vstack([optimum.estimate.place, begun.place]))
    smoother = SpatialSmoother(_with_places_of(fitted.problem, boxes)[0], estimate.pose)
    estimate, now = smoother.optimum(estimate, optimum.noise, heavy=False)
    counted = SpatialSmoother(_with_places_of(optimum.smoother.problem, boxes)[0], estimate.pose)
    levels = optimum.noise if optimum.sober is None else optimum.sober
    found = replace(
        optimum, estimate=estimate, smoother=counted, now=counted.linearised(estimate, levels, heavy=False),
        fitted=(smoother, now),
    )  # fmt: skip
    count = len(boxes.oriented)
    identity = np.append(solved.identity, first_box + np.arange(count))
    return replace(solved, optimum=found, identity=identity, number=np.append(solved.number, np.ones(count, dtype=int)))


def _take_recording(
    recording: SpatialRecording, rows: IntArray, driven: FloatArray, stays: Stood, gauge: Gauge, space: SpaceConfig
) -> TrafficIntake:
    """The recording as the solver takes it, with the errors taken off that repeat themselves."""
    identity, known = recording.detections.landmark_id.copy(), _first_free(recording)
    identity[boxes_of(recording)] = np.where(stays.stay == UNKNOWN, UNKNOWN, known + stays.stay)
    standing_only = _standing_only(recording, driven, gauge, identity)
    intake = prepare_space(standing_only, space, fewest=0)
    # the scale between ranges and odometry was taken off
    intake = replace(intake, problem=replace(intake.problem, steady=True, scale_sigma=0.0, ranges_share=0.0))
    used = np.flatnonzero(identity != UNKNOWN)
    return TrafficIntake(recording, rows, driven, stays, gauge, known, used, standing_only, intake)


def rescale(taken: TrafficIntake, factor: float) -> TrafficIntake:
    """Return the same with all lengths scaled to a map: odometry and ranges alike."""
    ranges, driven = factor * taken.gauge.range_scale, factor * taken.gauge.odometry_scale
    gauge = taken.gauge._replace(stated=ranges, scale=1.0 / driven - 1.0)
    space = taken.intake.problem.settings
    return _take_recording(taken.recording, taken.rows, taken.driven, taken.stays, gauge, space)


def solve_in_traffic(taken: TrafficIntake, progress: Progress | None = None) -> SpatialSolved:
    """Return the solution of the static objects alone, with drifting odometry if that explains them far better.

    The errors of boxes are alike for seconds, and things that creep are taken for such that stand: both look like an
    odometry that wanders a little. So good odometry is believed, until things agree that it is not.

    Raises:
        NumericalError: no finite optimum.
    """
    if taken.located is not None:
        if taken.boxes is None:
            return taken.located
        return _with_boxes(taken.located, taken.boxes, int(np.searchsorted(taken.intake.landmark_id, taken.known)))
    solved = solve_space(taken.intake, None, progress=progress)
    optimum, problem = solved.optimum, solved.optimum.smoother.problem
    if len(np.unique(problem.place)) < problem.settings.traffic.witnesses:
        return solved
    noise = replace(optimum.noise, translation=WANDERS[0], rotation=WANDERS[1])
    other = converge(replace(problem, steady=False), optimum.estimate, noise, heavy_rounds=0)
    better = optimum.noise.position > problem.settings.traffic.better_by * other.noise.position
    return replace(solved, optimum=other) if better else solved


def conclude_in_traffic(
    taken: TrafficIntake, intake: SpatialIntake, solved: SpatialSolved, track: TrackConfig
) -> tuple[SlamResult, TrackResult | None]:
    """Return poses and static objects, with rows of detections of `taken.recording`; and tracks along these poses."""
    result = conclude_in_space(taken.standing, intake, solved)
    followed = follow_boxes(taken.recording, result.trajectory.pose_world_robot, taken.gauge, track)
    alone = se3.compose(result.trajectory.pose_world_robot[0], taken.driven)
    return replace(
        result,
        innovations=replace(result.innovations, detection=taken.used[result.innovations.detection]),
        dead_reckoning=replace(result.dead_reckoning, pose_world_robot=alone),
        parameters=(*result.parameters, *_parameters(taken.gauge, intake.problem.settings.traffic)),
        followed=followed,
    ), followed


def _whole(recording: SpatialRecording) -> tuple[SpatialRecording, IntArray]:
    """The frames while there is odometry, with those of which only a pose tells: nothing was seen in them; and rows of
    the detections in these.
    """
    assert recording.odometry is not None
    driven_s, given, stamps = recording.odometry.stamp_s, recording.detections, recording.frames.stamp_s
    inside = (stamps >= driven_s[0] - 1e-3) & (stamps <= driven_s[-1] + 1e-3)
    kept = inside[given.frame]
    counts = np.bincount(given.frame, minlength=len(stamps))
    stamp_s, counts = with_empty_frames(stamps[inside], counts[inside], driven_s)
    seen = replace(rows_of(given, kept), frame=np.repeat(np.arange(len(stamp_s)), counts))
    whole = replace(recording, frames=Frames(stamp_s), detections=seen)
    return whole, np.flatnonzero(kept)


def _settle(
    recording: SpatialRecording, driven: FloatArray, space: SpaceConfig, track: TrackConfig, *, bends: bool = True
) -> tuple[Stood, Gauge]:
    """Return static objects and systematic errors, alternated until the errors no longer change; `bends` is whether the
    path may have one.
    """
    rows, stamps, gauge = boxes_of(recording), recording.frames.stamp_s, Gauge.before(space)
    mount, frame = mounts_of(recording)[rows], recording.detections.frame[rows]
    seen = se3.transform(mount, recording.detections.position_sensor_m[rows])
    for _ in range(ROUNDS):
        followed = follow_boxes(recording, gauge.applied(driven), gauge, track)
        stands = _stands(recording, followed)
        if followed is None:
            break
        # in the first round every track may be static
        thing = stands.stay if gauge.things else long_enough(stamps[frame], followed.track_of_detection, track.still)
        on = np.flatnonzero(thing != UNKNOWN)
        found = gauge_of(driven, stamps[frame[on]], frame[on], seen[on], mount[on, :3], thing[on], space, track.still)
        found = found if bends else found._replace(bend=0.0)
        change = abs(found.scale - gauge.scale) / found.scale_sigma + abs(found.bend - gauge.bend) / found.bend_sigma
        gauge = found
        if change < SETTLED:
            break
    return stands, gauge


def _first_free(recording: SpatialRecording) -> int:
    """The first identity above those of landmarks."""
    return int(recording.detections.landmark_id.max(initial=UNKNOWN)) + 1


def follow_boxes(recording: SpatialRecording, pose: FloatArray, gauge: Gauge, track: TrackConfig) -> TrackResult | None:
    """Return the tracks of the boxes, with the robot at poses (F, 7)."""
    table, poses = (
        box_table(recording, gauge.range_scale),
        Poses(recording.frames.stamp_s, pose, Path(recording.source)),
    )
    try:
        return run_track(in_world(table, poses), track)
    except DataError:  # nothing was seen often enough to be an object
        return None


def _stands(recording: SpatialRecording, followed: TrackResult | None) -> Stood:
    """Return the static boxes; none where nothing is tracked."""
    if followed is not None and followed.stood is not None:
        return followed.stood
    count, none = len(boxes_of(recording)), np.zeros(0)
    return Stood(np.full(count, UNKNOWN), np.full(count, np.nan), {}, none.astype(np.int64), none, none, none)


def _standing_only(
    recording: SpatialRecording, driven: FloatArray, gauge: Gauge, identity: IntArray
) -> SpatialRecording:
    """Return the input of the solver: detections with an identity (M,), without systematic errors."""
    assert recording.odometry is not None
    rows, given = boxes_of(recording), recording.detections
    rotation, position = given.rotation.copy(), given.position_sensor_m.copy()
    rotation[rows] = np.nan  # the heading of a box is no better than a few degrees, and the wrong way now and then
    position[rows] *= gauge.range_scale
    told = replace(given, landmark_id=identity, rotation=rotation, position_sensor_m=position)
    path = replace(
        recording.odometry,
        stamp_s=recording.frames.stamp_s,
        pose_world_robot=gauge.applied(driven),
        variance=np.full((len(driven), 6), np.nan),
    )
    return replace(recording, odometry=path, detections=rows_of(told, identity != UNKNOWN), warnings=())


def with_stays(
    result: SlamResult, taken: TrafficIntake, followed: TrackResult | None, track: TrackConfig
) -> SlamResult:
    """Return the result with static objects under the ids of their tracks.

    Args:
        result: landmarks of ids from `taken.known` on are stays.
        taken: by which these were chosen.
        followed: the tracks along the estimated poses.
        track: settings of the tracker.
    """
    stays, known, tilt_rad = taken.stays, taken.known, taken.intake.problem.settings.traffic.tilt_rad
    landmarks, of = result.landmarks, stays.track
    if followed is not None:  # the track that most boxes of each stay are of
        most = most_of(stays.stay, followed.track_of_detection, len(of))
        of = np.where(most == UNKNOWN, of, most)
    identities, names = distinguish(known + of, times_of(of), {})
    stay = landmarks.landmark_id - known
    ours = np.flatnonzero((stay >= 0) & (stay < len(identities)))
    stay, new = stay[ours], landmarks.landmark_id.copy()
    new[ours] = identities[stay]
    p_exists = landmarks.p_exists.copy()
    p_exists[ours] = stays.p_stay[stay]
    told = replace(landmarks, landmark_id=new, p_exists=p_exists, names={**landmarks.names, **names})
    if followed is not None and len(ours):
        told = _add_headings(told, ours, of[stay], followed, tilt_rad)
    renamed = dict(zip(landmarks.landmark_id.tolist(), new.tolist(), strict=True))
    asked = np.array([renamed.get(one, one) for one in result.innovations.landmark_id.tolist()], dtype=np.int64)
    return replace(
        result,
        landmarks=rows_of(told, np.argsort(new, kind="stable")),
        innovations=replace(result.innovations, landmark_id=asked, detection=taken.rows[result.innovations.detection]),
        changes=(*result.changes, *_changes(stays, identities, names, track.still.when_s)),
    )


def _add_headings(
    landmarks: Landmarks, ours: IntArray, track: IntArray, followed: TrackResult, tilt_rad: float
) -> Landmarks:
    """Landmarks with the heading and the belief that their tracks had when they were seen there last."""
    count, tracks = len(landmarks), followed.tracks
    rotation = np.full((count, 4), np.nan) if landmarks.rotation is None else landmarks.rotation.copy()
    turned = np.full((count, 3, 3), np.nan)
    if landmarks.rotation_covariance is not None:
        turned[:] = landmarks.rotation_covariance
    p_exists = landmarks.p_exists.copy()
    first, last = (np.searchsorted(tracks.track_id, track, side=side) for side in ("left", "right"))
    for row, begin, end in zip(ours.tolist(), first.tolist(), last.tolist(), strict=True):
        if begin == end:
            continue
        seen = int(np.searchsorted(tracks.stamp_s[begin:end], landmarks.last_seen_s[row] + 1e-6))
        at = begin + max(seen - 1, 0)
        p_exists[row] *= tracks.p_exists[at]
        half = 0.5 * tracks.box[at, 3]
        rotation[row] = 0.0, 0.0, np.sin(half), np.cos(half)
        turned[row] = np.diag([tilt_rad**2, tilt_rad**2, tracks.box_variance[at, 3]])
    return replace(landmarks, p_exists=p_exists, rotation=rotation, rotation_covariance=turned)


def _parameters(gauge: Gauge, settings: TrafficConfig) -> tuple[ParameterEstimate, ...]:
    """Return the systematic errors of odometry and detector."""
    if not gauge.things:
        return ()
    given, usual = gauge.stated is not None, settings.sigma_scale
    ranges, driven = (0.0, gauge.scale_sigma) if given else (gauge.scale_sigma, 0.0)
    return (
        ParameterEstimate(
            "range_scale", gauge.range_scale, ranges, 1.0, settings.sigma_scale, "1", fixed=given,
            meaning="factor on ranges of boxes, relative to the odometry",
        ),
        ParameterEstimate(
            "odometry_scale", gauge.odometry_scale, driven, 1.0, usual if given else float("nan"), "1", fixed=not given,
            meaning="factor on the odometry's way",
        ),
        ParameterEstimate(
            "odometry_bend_radpm", gauge.bend, gauge.bend_sigma, 0.0, settings.sigma_bend, "rad/m",
            meaning="missing rotation of the odometry per metre",
        ),
    )  # fmt: skip


def _changes(standing: Stood, identities: IntArray, names: Mapping[int, str], when_s: float) -> tuple[MapChange, ...]:
    """Return arrivals and departures in view."""
    found = []
    for stay, identity in enumerate(identities.tolist()):
        hits = int(np.count_nonzero(standing.stay == stay))
        for kind, when in ((ChangeKind.APPEARED, standing.since_s), (ChangeKind.VANISHED, standing.until_s)):
            if np.isfinite(when[stay]):
                span, p = (float(when[stay] - when_s), float(when[stay] + when_s)), float(standing.p_stay[stay])
                n_hits = hits if kind is ChangeKind.APPEARED else 0
                change = MapChange((identity,), kind, *span, (np.nan,) * 3, 0.0, p, n_hits)
                found.append(change.named(names))
    return tuple(found)
