"""Results of the estimator in space, as plain arrays with the recording's ids and stamps, in metres."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from evermap.estimate.measurement import frame_of
from evermap.estimate.sparse.elimination import Spread
from evermap.geometry import se3
from evermap.slam.calibration import OF_SCALE
from evermap.slam.intake import most_of
from evermap.slam.result import add_scale_error, count_sightings, show_together
from evermap.slam.space.bodies import BodyMove, shifts_of
from evermap.slam.space.bridge import bridge, bridge_covariance
from evermap.slam.space.intake import SpatialIntake, start_noise
from evermap.slam.space.linearise import (
    ACROSS,
    ALONG,
    CORNERS,
    MOUNT,
    ORIENTATION,
    PIXEL,
    POSE,
    ROTATION,
    STATES,
    TRANSLATION,
)
from evermap.slam.space.moved_within import MovedWithin
from evermap.slam.space.problem import SpatialNoise, SpatialProblem
from evermap.slam.space.range_errors import consider_range_errors
from evermap.slam.space.smoother import SpatialLinear
from evermap.slam.space.solve import SpatialSolved
from evermap.slam.space.up import Movement, decide_up
from evermap.types import (
    BoolArray,
    ChangeKind,
    FloatArray,
    Innovations,
    IntArray,
    Landmarks,
    MapChange,
    Misses,
    ParameterEstimate,
    SlamResult,
    SpatialRecording,
    Trajectory,
    Up,
    landmark_id_of,
)

OF_MOUNT = "correction of the sensor's stated mount, in the sensor's axes"
DELAY = "seconds by which the sensor's stamps are late"
SCALE = "true distances over those of the odometry, by the sizes of tags or by the given map"
DIVIDED = (
    "true distances over those of the odometry, or ranges over true distances: only their product shows; divided by "
    "`kind`, sigma_scale and sigma_odometer_scale of sensor.toml"
)
_LEVELS = {
    TRANSLATION: ("sigma_odometry_m", "m/sqrt(s)", "noise of the odometry's translation"),
    ROTATION: ("sigma_odometry_rad", "rad/sqrt(s)", "noise of the odometry's rotation"),
    ACROSS: ("direction_noise_factor", "1", "noise of positions across the line of sight over what is stated or usual"),
    ALONG: ("range_noise_factor", "1", "noise of ranges over what is stated or usual"),
    ORIENTATION: ("orientation_noise_factor", "1", "noise of detected orientations over what is stated"),
    PIXEL: ("sigma_corner_px", "px", "noise of tag corners in the image"),
}


@dataclass(frozen=True, slots=True)
class _Told:
    """A solved recording with what several tables need of it."""

    recording: SpatialRecording
    intake: SpatialIntake
    solved: SpatialSolved
    problem: SpatialProblem
    spread: Spread
    frame: str
    stamp_s: FloatArray
    placed: BoolArray
    of_ranges: FloatArray
    up: Up = field(default_factory=Up)

    def add_range_errors(self, covariance: FloatArray, variable: IntArray) -> FloatArray:
        """Return covariances (K, d, d) of variables (K,) with what errors that all ranges share add to them."""
        begin = self.solved.optimum.smoother.structure.system.tree.begin[variable]
        own = self.of_ranges[begin[:, None] + np.arange(covariance.shape[-1])]
        return np.asarray(covariance + own @ np.swapaxes(own, 1, 2))


def conclude_in_space(
    recording: SpatialRecording, intake: SpatialIntake, solved: SpatialSolved, scratch: str = "first_pose"
) -> SlamResult:
    """Return trajectory and map, and differences to a given map; without one, `scratch` is what the frame is."""
    optimum, problem = solved.optimum, solved.optimum.smoother.problem
    frame = "prior_map" if len(problem.prior.place) else frame_of(problem.measurements, scratch)
    found, placed = located(problem, optimum.now)
    placed &= ~solved.left
    spread = optimum.smoother.spread(optimum.now)
    of_ranges = consider_range_errors(optimum)
    told = _Told(recording, intake, solved, problem, spread, frame, intake.start_s + problem.stamp_s, placed, of_ranges)
    motion = Movement.of(told.stamp_s, problem, optimum.estimate, recording.sensors, found, placed)
    up, disagree = decide_up(motion, recording.odometry, recording.measurements, problem.settings.up)
    told = replace(told, up=up)
    identities, names = identities_of(intake, solved)
    called = [names.get(one, str(one)) for one in identities.tolist()]
    warnings, inlier = [*intake.warnings, *disagree], problem.settings.inlier
    used = problem.place[optimum.now.weight > inlier]
    left_out = [called[k] for k in np.setdiff1d(used, np.flatnonzero(placed | solved.left))]
    if left_out:
        warnings.append(f"landmarks left out, since nothing connects them to the others: {', '.join(left_out)}")
    if not found.all():
        warnings.append(f"{int((~found).sum())} frames in which the robot could not be located left out")
    seen = np.bincount(problem.place, optimum.now.weight, minlength=len(identities)) > inlier
    twice = [called[k] for k in np.flatnonzero((solved.number > 1) & seen & placed)]
    if twice:
        warnings.append(f"identities on several landmarks, distinguished by their places: {', '.join(twice)}")
    return SlamResult(
        trajectory=_trajectory(told, found),
        online=_online(told),
        landmarks=_landmarks(told, identities, names),
        parameters=_parameters(told),
        innovations=_innovations(told, identities),
        misses=Misses.empty(),
        step_s=solved.step_s,
        dead_reckoning=_dead_reckoning(told),
        warnings=tuple(warnings),
        changes=_changes(told, identities, names),
        gone=Landmarks.in_space([], np.zeros((0, 3)), clock=recording.clock),
    )


def _trajectory(told: _Told, found: BoolArray) -> Trajectory:
    """Return the poses of all frames, or of those that are found among (N,), with what is not known of the metre."""
    frames, problem, optimum = told.intake.frames, told.problem, told.solved.optimum
    # the mean is that of the fit, the covariance counts errors that last
    pose = bridge(frames, problem, optimum.estimate, optimum.noise)
    noise, weight = optimum.sober or optimum.noise, optimum.now.odometry_weight
    covariance = bridge_covariance(frames, problem, optimum.estimate, noise, weight, told.spread)
    covariance = told.add_range_errors(covariance, frames.before)
    covariance = add_scale_error(covariance, -se3.inverse(pose)[:, :3], _find_undivided(told))
    of = slice(None) if problem.driven else found
    return _path(told, pose, covariance, of)


def _online(told: _Told) -> Trajectory:
    """Return the newest pose of each frame as it was known then, and roughly how far off that may be."""
    rough = np.repeat(told.solved.online_spread**2, 3, axis=1)[:, :, None] * np.eye(6)
    return _path(told, told.solved.online_pose, rough)


def numbered(name: str | int, number: int) -> str:
    """Return what the landmark with this number is called, of those that carry one identity: '7#2'."""
    return f"{name}#{number}"


def identities_of(intake: SpatialIntake, solved: SpatialSolved) -> tuple[IntArray, dict[int, str]]:
    """Return `distinguish` ids (P,) of places, and the names of all."""
    return distinguish(intake.landmark_id[solved.identity], solved.number, intake.names)


def distinguish(landmark_id: IntArray, number: IntArray, names: Mapping[int, str]) -> tuple[IntArray, dict[int, str]]:
    """Return ids of which none is there twice, and names with those of the new ones.

    Args:
        landmark_id: (P,) the second of two with the id 7 is called '7#2'.
        number: (P,) which of those with its id each is, from 1.
        names: texts behind ids.
    """
    found, names = landmark_id.copy(), dict(names)
    for row in np.flatnonzero(number > 1).tolist():
        own = int(found[row])
        name = numbered(names.get(own, own), int(number[row]))
        found[row] = landmark_id_of(name)
        names[int(found[row])] = name
    return found, names


def located(problem: SpatialProblem, now: SpatialLinear) -> tuple[BoolArray, BoolArray]:
    """Return (N,) poses and (P,) places that are located relative to the map or to each other.

    That is by odometry, or by detections that are no outliers. Without odometry these tie frames to landmarks, and
    what is tied to neither the map nor to most that was seen may be anywhere.
    """
    n, count = len(problem.stamp_s), len(problem.oriented)
    if problem.driven:
        return np.ones(n, dtype=np.bool_), np.ones(count, dtype=np.bool_)
    good = now.weight > problem.settings.inlier
    soon = np.flatnonzero(np.diff(problem.stamp_s) <= problem.settings.tied_s)
    two = [tied for tied in problem.measurements if tied.kind.ties != "pose"]
    one = np.concatenate([problem.pose_row[good], soon, *(tied.row for tied in two)])
    others = (tied.other + (n if tied.kind.ties == "pose_place" else 0) for tied in two)
    other = np.concatenate([n + problem.place[good], soon + 1, *others])
    graph = csr_array((np.ones(len(one)), (one, other)), shape=(n + count, n + count))
    part = connected_components(graph, directed=False)[1]
    stands = problem.prior.place[problem.prior.weight > problem.settings.inlier]
    known = part[n + stands] if len(stands) else np.bincount(part[problem.pose_row[good]], minlength=1).argmax()
    tied = np.isin(part, known)
    seen = np.bincount(problem.pose_row, now.weight, minlength=n) > problem.settings.inlier
    return seen & tied[:n], tied[n:]


def _landmarks(told: _Told, identities: IntArray, names: Mapping[int, str]) -> Landmarks:
    optimum, recording, problem = told.solved.optimum, told.recording, told.problem
    place = optimum.estimate.place
    count, n = len(place), len(problem.stamp_s)
    used = optimum.now.weight > problem.settings.inlier
    seen_s = told.stamp_s[problem.pose_row[used]]
    hits, first, last = count_sightings(count, problem.place[used], seen_s, problem.measurements, told.stamp_s)
    covariance, turned = np.zeros((count, 3, 3)), np.full((count, 3, 3), np.nan)
    points, turns = np.flatnonzero(~problem.oriented), np.flatnonzero(problem.oriented)
    covariance[points] = told.add_range_errors(told.spread.of(n + points, 3), n + points)
    own, axes = told.add_range_errors(told.spread.of(n + turns, 6), n + turns), se3.rotation_of(place[turns])
    covariance[turns] = axes @ own[:, :3, :3] @ np.swapaxes(axes, 1, 2)  # a twist's translation is in the own axes
    turned[turns] = own[:, 3:, 3:]
    covariance = add_scale_error(covariance, place[:, :3], _find_undivided(told))
    order = np.argsort(identities, kind="stable")
    order = order[(hits[order] > 0) & told.placed[order]]
    oriented = bool(problem.oriented.any())
    rotation = np.where(problem.oriented[:, None], place[:, 3:], np.nan)
    return Landmarks(
        landmark_id=identities[order],
        position_m=place[order, :3],
        covariance_m2=covariance[order],
        class_id=most_of(problem.place, recording.detections.class_id[told.intake.used], count)[order],
        p_exists=np.ones(len(order)),
        n_hits=hits[order],
        n_misses=np.zeros(len(order), dtype=np.int64),
        first_seen_s=first[order],
        last_seen_s=last[order],
        class_names=recording.class_names,
        frame=told.frame,
        clock=recording.clock,
        names=names,
        rotation=rotation[order] if oriented else None,
        rotation_covariance=turned[order] if oriented else None,
        size_m=_sizes(told, count)[order] if np.isfinite(recording.detections.size_m).any() else None,
        up=told.up,
    )


def _sizes(told: _Told, count: int) -> FloatArray:
    """(P, 3) median sizes of boxes."""
    size, place = told.recording.detections.size_m[told.intake.used], told.problem.place
    found = np.full((count, 3), np.nan)
    for row in range(count):
        own = size[(place == row) & np.isfinite(size[:, 0])]
        if len(own):
            found[row] = np.median(own, axis=0)
    return found


def _parameters(told: _Told) -> tuple[ParameterEstimate, ...]:
    optimum, problem = told.solved.optimum, told.problem
    started = start_noise(problem.settings, driven=problem.driven)
    found = noise_parameters(
        _over_usual(optimum.noise, problem), started, problem.kind, problem.ray, driven=problem.driven
    )
    border = optimum.smoother.factorised(optimum.now).border_covariance()
    *of_sensors, of_scale = np.sqrt(np.diag(border))
    sigma = np.reshape(of_sensors, (-1, STATES))
    for row, sensor in enumerate(told.recording.sensors):
        found += mount_parameters(
            sensor.name, optimum.estimate.state[row, :MOUNT], sigma[row], problem.mount_sigma[row]
        )
        if (delays := told.solved.delays) is not None:
            value, spread = float(optimum.estimate.delay_s[row]), float(delays.sigma_s[row])
            prior, name, p_needed = (
                problem.settings.delay_sigma_s,
                f"{sensor.name}_delay_s",
                float(delays.p_needed[row]),
            )
            found.append(ParameterEstimate(name, value, spread, 0.0, prior, "s", meaning=DELAY, p_needed=p_needed))
    if problem.scale_sigma > 0.0:
        found += _scales(told, float(of_scale))
    return tuple(found)


def _over_usual(noise: SpatialNoise, problem: SpatialProblem) -> SpatialNoise:
    """Return levels over what is stated, or is usual where nothing is: those by which all positions together would be
    worth as much as with the noise by range that was learned.
    """
    free = np.isfinite(problem.usual_m)
    if not free.any():
        return noise
    own = problem.kind != CORNERS
    sigma_m = problem.sigma_position_m[own]
    usual_m = np.where(free[own], problem.usual_m[own], sigma_m)
    across, along = np.sqrt(np.sum(usual_m**-2, axis=0) / np.sum(sigma_m**-2, axis=0)).tolist()
    return replace(noise, across=across * noise.across, along=along * noise.along)


def noise_parameters(
    noise: SpatialNoise, started: SpatialNoise, kind: IntArray, ray: BoolArray, *, driven: bool
) -> list[ParameterEstimate]:
    """Return the noise levels of what there is: detections (M,) of kinds, some of them `ray` only, and odometry.

    Their prior means are the levels that they `started` from.
    """
    has = {
        TRANSLATION: driven,
        ROTATION: driven,
        ACROSS: bool((kind != CORNERS).any()),
        ALONG: bool(((kind != CORNERS) & ~ray).any()),
        ORIENTATION: bool((kind == POSE).any()),
        PIXEL: bool((kind == CORNERS).any()),
    }
    return [
        ParameterEstimate(
            name, float(noise.levels[row]), 0.0, float(started.levels[row]), np.nan, unit, meaning=meaning
        )
        for row, (name, unit, meaning) in _LEVELS.items()
        if has[row]
    ]


def mount_parameters(name: str, value: FloatArray, sigma: FloatArray, prior: FloatArray) -> list[ParameterEstimate]:
    """Return what is estimated of the mount of a sensor: twists (6,), their standard deviations, and those before."""
    parts = [*((f"mount_{axis}_m", "m") for axis in "xyz"), *((f"mount_r{axis}_rad", "rad") for axis in "xyz")]
    return [
        ParameterEstimate(
            f"{name}_{part}", float(value[k]), float(sigma[k]), 0.0, float(prior[k]), unit, meaning=OF_MOUNT
        )
        for k, (part, unit) in enumerate(parts)
        if prior[k] > 0.0
    ]


def _find_undivided(told: _Told) -> float:
    """Return the standard deviation of all lengths that remains where only ranges and odometer say what a metre is, of
    directions alone the odometer, and without odometry the ranges, of which only a data sheet does.
    """
    problem, before = told.problem, told.intake.problem.scale_sigma
    if len(problem.prior.place) or problem.measurements:
        return 0.0
    if not problem.driven:
        stated = [one.sigma_scale for one in told.recording.sensors if one.sigma_scale is not None]
        return min(stated, default=0.0)
    if problem.ray.all() and told.recording.sensors[0].sigma_odometer_scale is None:
        return problem.settings.scale_sigma
    return float(before * np.sqrt(problem.ranges_share * (1.0 - problem.ranges_share)))


def _scales(told: _Told, sigma: float) -> list[ParameterEstimate]:
    """Return the scales of odometry and ranges; `sigma` is of the logarithm of what they show together."""
    problem, share = told.problem, told.problem.ranges_share
    before = told.intake.problem.scale_sigma or told.intake.scale_in_map  # it was averaged since
    odometer, ranges = before * np.sqrt(1.0 - share), before * np.sqrt(share)
    undivided = _find_undivided(told)
    scale = float(np.exp(problem.odometry_log + told.solved.optimum.estimate.log_scale))
    if share == 0.0:
        return [ParameterEstimate("odometry_scale", scale, scale * sigma, 1.0, odometer, "", meaning=SCALE)]
    of_odometer = float(scale * np.hypot((1.0 - share) * sigma, undivided))
    of_ranges = float(np.hypot(share * sigma, undivided))
    reads = float(np.exp(problem.ranges_log))
    evident = abs(np.log(scale * reads)) > 2.0 * sigma
    both = ("odometry_scale", scale, of_odometer, odometer), ("range_scale", reads, reads * of_ranges, ranges)
    pairs = show_together(both[0][0], scale * reads, both[1][0], scale * reads, OF_SCALE, bool(evident))
    return [
        ParameterEstimate(name, value, own, 1.0, prior, "", meaning=DIVIDED, **pairs[name])
        for name, value, own, prior in both
    ]


def _innovations(told: _Told, identities: IntArray) -> Innovations:
    """Return the NIS of all detections, each as if it had not been used."""
    optimum = told.solved.optimum
    smoother, now = optimum.last  # residuals are those of the fit, whatever the covariances count
    spread = told.spread if optimum.fitted is None else smoother.spread(now)
    problem = smoother.problem
    return Innovations(
        stamp_s=told.stamp_s[problem.pose_row],
        detection=told.intake.used,
        landmark_id=identities[problem.place],
        nis=smoother.find_nis(now, spread),
        p_inlier=np.clip(now.weight, 0.0, 1.0),
        dof=problem.dof,
    )


def _dead_reckoning(told: _Told) -> Trajectory:
    """Odometry alone from the first pose; nothing without."""
    first = told.solved.optimum.estimate.pose[:1]
    count = len(told.intake.frames.row) if told.problem.driven else 0
    return _path(told, se3.compose(first, told.intake.frames.driven), np.zeros((count, 6, 6)), slice(count))


def _path(told: _Told, pose: FloatArray, covariance: FloatArray, of: BoolArray | slice = slice(None)) -> Trajectory:
    """Poses of some of the frames."""
    stamp_s = told.intake.start_s + told.intake.frames.stamp_s
    return Trajectory(stamp_s[of], pose[of], covariance[of], frame=told.frame, clock=told.recording.clock)


def _change_within(told: _Told, move: MovedWithin, identities: IntArray) -> MapChange:
    """A move during the session."""
    problem, optimum = told.problem, told.solved.optimum
    before, after = optimum.estimate.place[[move.before, move.after]]
    turned = bool(problem.oriented[move.after])
    used = (optimum.now.weight > problem.settings.inlier) & (problem.place == move.after)
    start_s = told.intake.start_s
    return MapChange(
        landmark_ids=(int(identities[move.after]),),
        kind=ChangeKind.MOVED,
        stamp_from_s=start_s + move.between_s[0],
        stamp_to_s=start_s + move.between_s[1],
        displacement_m=tuple((after - before)[:3].tolist()),
        rotation_rad=float(problem.symmetries[np.array([move.after])].angle_between(before[None], after[None])[0])
        if turned
        else 0.0,
        probability=move.probability,
        n_hits=int(np.count_nonzero(used)),
    )


def _change_of_body(told: _Told, move: BodyMove, identities: IntArray) -> MapChange:
    """A move of a body during the session, of all landmarks on it."""
    problem, place = told.problem, told.solved.optimum.estimate.place
    stands = move.after != move.before
    shift, turn_rad = shifts_of(move, place, problem.oriented)
    known = shift[np.isfinite(shift[:, 0])]
    used = (told.solved.optimum.now.weight > problem.settings.inlier) & np.isin(problem.place, move.after[stands])
    start_s = told.intake.start_s
    return MapChange(
        landmark_ids=tuple(np.sort(identities[move.before]).tolist()),
        kind=ChangeKind.MOVED,
        stamp_from_s=start_s + move.between_s[0],
        stamp_to_s=start_s + move.between_s[1],
        displacement_m=tuple(known.mean(axis=0).tolist()) if len(known) else (np.nan,) * 3,
        rotation_rad=turn_rad,
        probability=1.0,
        n_hits=int(np.count_nonzero(used)),
    )


def _changes(told: _Told, identities: IntArray, names: Mapping[int, str]) -> tuple[MapChange, ...]:
    """Return landmarks that moved during the session, and relative to the given map, the most certain first."""
    found = told.solved.from_map
    problem, optimum = told.problem, told.solved.optimum
    used = optimum.now.weight > problem.settings.inlier
    changes = [_change_within(told, move, identities).named(names) for move in told.solved.moves]
    changes += [_change_of_body(told, move, identities).named(names) for move in told.solved.bodies]
    if found is None:
        return tuple(changes)
    together = [group for group in found.groups if len(group.members) > 1]
    for group in sorted(together, key=lambda group: -group.probability):
        places = problem.prior.place[group.members]
        shift = (optimum.estimate.place[places, :3] - problem.prior.pose[group.members, :3]).mean(axis=0)
        changes.append(
            MapChange(
                landmark_ids=tuple(np.sort(identities[places]).tolist()),
                kind=ChangeKind.ROTATED if group.turns else ChangeKind.MOVED,
                stamp_from_s=float("nan"),
                stamp_to_s=float(told.stamp_s[0]),
                displacement_m=tuple(shift.tolist()),
                rotation_rad=float(np.linalg.norm(group.motion[3:])),
                probability=group.probability,
                n_hits=int(np.count_nonzero(used & np.isin(problem.place, places))),
            ).named(names)
        )
    in_group = np.isin(np.arange(len(found.p_stands)), [k for group in together for k in group.members.tolist()])
    for k in np.argsort(found.p_stands, kind="stable"):
        if in_group[k]:
            continue
        if 1.0 - found.p_stands[k] < problem.settings.map.p_told:
            break
        place = int(problem.prior.place[k])
        identity = int(identities[place])
        shift = optimum.estimate.place[place, :3] - problem.prior.pose[k, :3]
        turn = float(np.linalg.norm(found.off[k, 3:])) if problem.oriented[place] else 0.0
        changes.append(
            MapChange(
                landmark_ids=(identity,),
                kind=ChangeKind.MOVED,
                stamp_from_s=float("nan"),
                stamp_to_s=float(told.stamp_s[0]),
                displacement_m=tuple(shift.tolist()),
                rotation_rad=turn,
                probability=float(1.0 - found.p_stands[k]),
                n_hits=int(np.count_nonzero(used & (problem.place == place))),
            ).named(names)
        )
    return tuple(changes)
