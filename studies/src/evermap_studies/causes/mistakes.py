"""What can be wrong with a drive: each mistake takes a drive that is right and returns what evermap is given.

The same drive before the mistake is what an oracle solves, who knows the cause.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from evermap.geometry import se2, se3
from evermap.types import FloatArray, IntArray, Landmarks
from evermap_studies.causes.drives import NEXT, OPTICAL, PLANAR, Drive, Event, Reading
from evermap_studies.causes.sites import SITES

Mistake = Callable[[Drive, np.random.Generator], Drive]
"""Makes a mistake; what is random about it is drawn from the generator."""


def nothing(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
    """Return the drive as it is."""
    return drive


def both(*mistakes: Mistake) -> Mistake:
    """Make several mistakes, one after the other."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:
        for one in mistakes:
            drive = one(drive, rng)
        return drive

    return make


# --- landmarks that move ------------------------------------------------------------------------------------------


def most_seen(drive: Drive, at_s: float, least: int = 5) -> IntArray:
    """Return rows of the site's landmarks that were seen before and after an instant, most often first."""
    assert drive.site is not None
    before, after = (
        np.bincount(drive.landmark[half] % NEXT, minlength=NEXT)
        for half in (drive.stamp_s < at_s, drive.stamp_s >= at_s)
    )
    enough = np.minimum(before if np.isfinite(at_s) else after, after)[drive.site.landmark_id]
    order = np.argsort(-enough, kind="stable")
    return order[enough[order] >= least]


def moved(drive: Drive, row: int, shift_m: float, turn_rad: float, rng: np.random.Generator) -> FloatArray:
    """Return where a landmark is after it was moved along its wall, or anywhere if it is a point, and turned."""
    assert drive.site is not None
    pose = drive.site.pose[row].copy()
    way = rng.uniform(0.0, 2 * math.pi)
    side = np.array([math.cos(way), math.sin(way), 0.0])
    if not math.isnan(drive.site.size_m[row]):
        side = se3.rotation_of(pose)[:, 0] * (1.0 if way < math.pi else -1.0)
    pose[:3] += shift_m * side
    turned = se3.compose(se3.from_angles([0.0, 0.0, turn_rad]), se3.turn(pose[3:]))
    pose[3:] = turned[3:]
    return se3.normalise_poses(pose)


def moves(count: int, at_share: float = -math.inf, shift_m: float = 0.9, turn_rad: float = 0.0) -> Any:
    """Move landmarks, before the session or at a share of its time."""

    def choose(drive: Drive, rng: np.random.Generator) -> tuple[Event, ...]:
        at_s = at_share if at_share == -math.inf else float(at_share * drive.odometry_s[-1])
        rows = rng.permutation(most_seen(drive, at_s)[: 2 * count])[:count].tolist()
        return tuple(Event(row, at_s, moved(drive, row, shift_m, turn_rad, rng)) for row in rows)

    return choose


def vanishes(count: int, at_share: float = -math.inf) -> Any:
    """Take landmarks away."""

    def choose(drive: Drive, rng: np.random.Generator) -> tuple[Event, ...]:
        at_s = at_share if at_share == -math.inf else float(at_share * drive.odometry_s[-1])
        rows = rng.permutation(most_seen(drive, at_s)[: 2 * count])[:count].tolist()
        return tuple(Event(row, at_s, None) for row in rows)

    return choose


def exchanges(at_share: float = -math.inf) -> Any:
    """Two landmarks exchange their places."""

    def choose(drive: Drive, rng: np.random.Generator) -> tuple[Event, ...]:
        assert drive.site is not None
        at_s = at_share if at_share == -math.inf else float(at_share * drive.odometry_s[-1])
        one, other = rng.permutation(most_seen(drive, at_s)[:6])[:2].tolist()
        return Event(one, at_s, drive.site.pose[other]), Event(other, at_s, drive.site.pose[one])

    return choose


def identities_stay(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
    """Give a landmark that moved the identity that it had."""
    return replace(drive, landmark=drive.landmark % NEXT)


# --- identities ---------------------------------------------------------------------------------------------------


def misread(share: float, *, strangers: bool = False) -> Mistake:
    """A share of the readings has the identity of another landmark, or of none."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:
        wrong = rng.random(len(drive.landmark)) < share
        ids = np.unique(drive.landmark)
        drawn = rng.integers(500, 587, len(wrong)) if strangers else rng.choice(ids, len(wrong))
        given = replace(drive, landmark=np.where(wrong, drawn, drive.landmark))
        sizes = {int(one): max(drive.tag_size_m.values()) for one in np.unique(drawn)}
        return replace(given, tag_size_m={**sizes, **drive.tag_size_m})

    return make


def doubled(drive: Drive, rng: np.random.Generator) -> Drive:
    """Two landmarks carry the identity of one: the printer was asked twice."""
    rows = most_seen(drive, float(drive.odometry_s[-1]) / 2)[:6]
    one, other = (rng.permutation(rows)[:2] + 1).tolist()
    given = replace(drive, landmark=np.where(drive.landmark == other, one, drive.landmark))
    if drive.places is None:
        return given
    return replace(given, places=drive.places[drive.places.landmark_id != other])


def renumbered(by: int) -> Mistake:
    """All identities are shifted: the map counts from another number."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
        size = {one + by: size_m for one, size_m in drive.tag_size_m.items()}
        return replace(drive, landmark=drive.landmark + by, tag_size_m={**drive.tag_size_m, **size})

    return make


# --- scales, units, signs, axes -----------------------------------------------------------------------------------


def readings(length: float = 1.0, add_m: float = 0.0, sign: float = 1.0, turn_rad: float = 0.0) -> Mistake:
    """Ranges times a factor and longer; bearings times a factor, then turned."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
        if drive.reading not in (*PLANAR, Reading.POSES):
            raise ValueError(f"{drive.reading} are no lengths")
        value = drive.value.copy()
        if drive.reading is Reading.POSES:
            value[:, :3] *= length
            return replace(drive, value=value)
        value[:, 0] = length * value[:, 0] + add_m
        if value.shape[1] == 2:
            value[:, 1] = sign * value[:, 1] + turn_rad
            value[:, 1] = se2.wrap(value[:, 1]) if abs(sign) == 1.0 else value[:, 1]
        given = replace(drive, value=value)
        return given.stated(range_max_m=max(length, 1.0) * drive.sensors[0].range_max_m) if length > 2.0 else given

    return make


def bias_of_one(add_m: float) -> Mistake:
    """Make all ranges of one landmark that is seen often longer."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:
        one = int(rng.choice(most_seen(drive, float(drive.odometry_s[-1]) / 2)) + 1)
        value = drive.value.copy()
        value[drive.landmark == one, 0] += add_m
        return replace(drive, value=value)

    return make


def odometer(
    forward: float = 1.0, turn: float = 1.0, lateral: float | None = None, bias: Sequence[float] = (0.0, 0.0, 0.0)
) -> Mistake:
    """Velocities times factors, the lateral one as the forward one if it is not given, plus biases."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
        side = forward if lateral is None else lateral
        up = forward if drive.is_planar or abs(forward) != 1.0 else 1.0
        twist = drive.twist * [forward, side, up, 1.0, 1.0, turn]
        twist[:, [0, 1, 5]] += bias
        return replace(drive, twist=twist)

    return make


def sideways(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
    """Exchange forward and lateral velocities."""
    return replace(drive, twist=drive.twist[:, [1, 0, 2, 3, 4, 5]])


def slips(share: float) -> Mistake:
    """One wheel turns a share more than it drives: forward half of it, and the turn with it."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
        twist = drive.twist.copy()
        twist[:, 5] += share * twist[:, 0] / 0.5
        twist[:, 0] *= 1.0 + 0.5 * share
        return replace(drive, twist=twist)

    return make


def other_axes(rotation: Sequence[float]) -> Mistake:
    """Readings in a frame that is turned by a quaternion against that of the stated mount."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
        turned = se3.compose(se3.turn(rotation), drive.value)
        return replace(drive, value=turned)

    return make


def mirrored_axis(axis: int) -> Mistake:
    """One coordinate of poses has the wrong sign; orientations are left."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
        value = drive.value.copy()
        value[:, axis] *= -1.0
        return replace(drive, value=value)

    return make


def inverted(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
    """Poses of the camera in the tags instead of tags in the camera."""
    return replace(drive, value=se3.inverse(drive.value))


def scalar_first(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
    """Quaternions w, x, y, z in columns that hold x, y, z, w."""
    return replace(drive, value=drive.value[:, [0, 1, 2, 6, 3, 4, 5]])


def corner_order(order: Sequence[int]) -> Mistake:
    """Corners in another order."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
        value = drive.value.reshape(-1, 4, 2)[:, list(order)].reshape(-1, 8)
        return replace(drive, value=value)

    return make


def upside_down(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
    """Rows of pixels counted from below."""
    value = drive.value.copy()
    value[:, 1::2] = 800.0 - value[:, 1::2]
    return replace(drive, value=value)


def half_image(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
    """Detected in an image of half the width, with the calibration of the whole one."""
    return replace(drive, value=0.5 * drive.value)


# --- statements about the sensor ----------------------------------------------------------------------------------


def mounted(
    x_m: float = 0.0, y_m: float = 0.0, z_m: float = 0.0, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0
) -> Mistake:
    """State mounts that are moved and turned in the robot's frame."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
        turn = se3.from_angles([roll, pitch, yaw])
        found = []
        for one in drive.sensors:
            mount = np.array(one.mount_robot_sensor)
            turned = se3.compose(turn, se3.turn(mount[3:]))
            mount = np.concatenate([mount[:3] + [x_m, y_m, z_m], turned[3:]])
            found.append(replace(one, mount_robot_sensor=tuple(mount.tolist())))
        return replace(drive, sensors=tuple(found))

    return make


def mounts(change: Callable[[FloatArray], FloatArray]) -> Mistake:
    """State mounts (7,) as a function of the right ones."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
        found = [
            replace(one, mount_robot_sensor=tuple(change(np.array(one.mount_robot_sensor)).tolist()))
            for one in drive.sensors
        ]
        return replace(drive, sensors=tuple(found))

    return make


def body_axes(mount: FloatArray) -> FloatArray:
    """Return a mount whose optical axes were forgotten: x ahead, y left, z up."""
    return np.concatenate([mount[:3], se3.compose(se3.turn(mount[3:]), se3.inverse(OPTICAL))[3:]])


def tilted_down(mount: FloatArray) -> FloatArray:
    """Return a mount whose pitch has the wrong sign."""
    flat = np.array([1.0, 1.0, -1.0])
    turn = se3.rotation_of(se3.turn(body_axes(mount)[3:]))
    yaw = math.atan2(turn[1, 0], turn[0, 0])
    pitch = math.asin(float(np.clip((turn @ [1.0, 0.0, 0.0] * flat)[2], -1.0, 1.0)))
    return np.concatenate([mount[:3], se3.compose(se3.from_angles([0.0, -pitch, yaw]), OPTICAL)[3:]])


def exchanged_cameras(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
    """State the mount of each of two cameras for the other one."""
    one, other = drive.sensors
    pair = (
        replace(one, mount_robot_sensor=other.mount_robot_sensor),
        replace(other, mount_robot_sensor=one.mount_robot_sensor),
    )
    return replace(drive, sensors=pair)


def sized(factor: float, ids: str = "all") -> Mistake:
    """State sizes of tags times a factor: of all, of one that is seen often, of every one of the smaller kind."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:
        size = dict(drive.tag_size_m)
        chosen = set(size)
        if ids == "one":
            chosen = {int(rng.choice(most_seen(drive, float(drive.odometry_s[-1]) / 2, 3)[:5]) + 1)}
        elif ids == "kind":
            chosen = {one for one, size_m in size.items() if size_m < 0.2}
        return replace(
            drive, tag_size_m={one: size_m * (factor if one in chosen else 1.0) for one, size_m in size.items()}
        )

    return make


def lens(**stated: Any) -> Mistake:
    """State other intrinsics or another distortion."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
        return drive.stated(**stated)

    return make


def swapped_focal(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
    """State fx for fy and the reverse."""
    found = []
    for one in drive.sensors:
        assert one.intrinsics is not None
        fx, fy, cx, cy = one.intrinsics
        found.append(replace(one, intrinsics=(fy, fx, cx, cy)))
    return replace(drive, sensors=tuple(found))


def baseline(factor: float) -> Mistake:
    """State a baseline times a factor."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
        return replace(drive, baseline_m=factor * drive.baseline_m)

    return make


# --- clocks -------------------------------------------------------------------------------------------------------


def late(by_s: float, sensor: int | None = None, drift: float = 0.0) -> Mistake:
    """Stamp frames late, those of one sensor or of all, by ever more if their clock drifts."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
        mine = np.ones(len(drive.frame_s), np.bool_) if sensor is None else drive.frame_sensor == sensor
        stamp_s = np.where(mine, drive.frame_s * (1.0 + drift) + by_s, drive.frame_s)
        return replace(drive, frame_s=stamp_s)

    return make


def jittered(sigma_s: float) -> Mistake:
    """Stamp frames when they arrive: late at random."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:
        return replace(drive, frame_s=np.sort(drive.frame_s + rng.exponential(sigma_s, len(drive.frame_s))))

    return make


# --- odometry that breaks -----------------------------------------------------------------------------------------


def _rows(drive: Drive, share: float, long_s: float) -> slice:
    start = int(np.searchsorted(drive.odometry_s, share * drive.odometry_s[-1]))
    return slice(start, int(np.searchsorted(drive.odometry_s, drive.odometry_s[start] + long_s)))


def silent(share: float, long_s: float, *, rows: bool = False) -> Mistake:
    """The odometry says nothing, or that the robot stands, from a share of the time on."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
        part = _rows(drive, share, long_s)
        if rows:
            keep = np.ones(len(drive.odometry_s), np.bool_)
            keep[part] = False
            return replace(drive, odometry_s=drive.odometry_s[keep], twist=drive.twist[keep])
        twist = drive.twist.copy()
        twist[part] = 0.0
        return replace(drive, twist=twist)

    return make


def jumped(share: float, shift: Sequence[float]) -> Mistake:
    """The odometry jumps once, by (forward, lateral, turn)."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
        twist, row = drive.twist.copy(), _rows(drive, share, 1.0).start
        twist[row, [0, 1, 5]] += np.array(shift) / (drive.odometry_s[row + 1] - drive.odometry_s[row])
        return replace(drive, twist=twist)

    return make


def restarted(share: float) -> Mistake:
    """The odometry's poses begin anew at the origin."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
        pose = _odometry_pose(drive)
        row = _rows(drive, share, 1.0).start
        pose[row:] = se3.between(pose[row], pose[row:])
        return replace(drive, odometry_pose=pose)

    return make


def kidnapped(share: float, shift: Sequence[float]) -> Mistake:
    """The robot was lifted and set down elsewhere, which no odometry tells: the opposite of a jump."""
    return jumped(share, [-one for one in shift])


def _odometry_pose(drive: Drive) -> FloatArray:
    from evermap.io.spatial import integrated
    from evermap.types import Clock

    if drive.odometry_pose is not None:
        return drive.odometry_pose.copy()
    return integrated(drive.odometry_s, drive.twist, Clock.RECORDING).pose_world_robot.copy()


def odometry_poses(change: Callable[[FloatArray], FloatArray]) -> Mistake:
    """Give poses (N, 7) of the odometry as a function of the right ones."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
        return replace(drive, odometry_pose=change(_odometry_pose(drive)))

    return make


def noisier(forward: float, turn: float, lasting_s: float = 0.0) -> Mistake:
    """Add noise to the velocities, white or lasting; the oracle has less."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:
        noise = rng.normal(size=(len(drive.twist), 3)) * [forward, forward, turn]
        if lasting_s:
            noise = _lasting(noise, float(np.median(np.diff(drive.odometry_s))) / lasting_s)
        twist = drive.twist.copy()
        twist[:, [0, 1, 5]] += noise
        return replace(drive, twist=twist)

    return make


def lasting_errors(sigma: Sequence[float], lasting_s: float) -> Mistake:
    """Add errors to the readings that last for seconds, landmark by landmark."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:
        step_s = 0.05
        count = int(drive.frame_s[-1] / step_s) + 2
        value, width = drive.value.copy(), len(sigma)
        for one in np.unique(drive.landmark):
            error = _lasting(rng.normal(size=(count, width)), step_s / lasting_s) * sigma
            mine = drive.landmark == one
            value[mine, :width] += error[(drive.stamp_s[mine] / step_s).astype(np.int64)]
        return replace(drive, value=value)

    return make


def _lasting(white: FloatArray, share: float) -> FloatArray:
    keep, slow = math.exp(-share), white.copy()
    for row in range(1, len(white)):
        slow[row] = keep * slow[row - 1] + math.sqrt(1.0 - keep**2) * white[row]
    return slow


# --- the map ------------------------------------------------------------------------------------------------------


def _placed(drive: Drive, change: Callable[[FloatArray], FloatArray], turn: FloatArray | None = None) -> Drive:
    """Return the drive with the positions of its map changed, and its orientations turned."""
    assert drive.places is not None
    places = drive.places
    rotation = places.rotation
    if rotation is not None and turn is not None:
        rotation = se3.compose(turn, se3.turn(rotation))[:, 3:]
    position = change(places.position_m)
    return replace(drive, places=replace(places, position_m=position, rotation=rotation), moved_frame=True)


def map_frame(x_m: float, y_m: float, turn_rad: float) -> Mistake:
    """Give the map in another frame, which is no mistake."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
        pose = se3.from_plane([x_m, y_m, turn_rad])

        def change(position: FloatArray) -> FloatArray:
            if position.shape[1] == 2:
                return se2.transform([x_m, y_m, turn_rad], position)
            return se3.transform(pose, position)

        return _placed(drive, change, se3.turn(pose[3:]))

    return make


def map_scaled(factor: float) -> Mistake:
    """Give the map in another unit, or drawn to another scale."""
    return lambda drive, rng: _placed(drive, lambda position: factor * position)  # noqa: ARG005 (a Mistake)


def map_mirrored(axis: int = 0, *, half: bool = False) -> Mistake:
    """Give the map as seen in a mirror, all of it or the half with the greater coordinates."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
        assert drive.places is not None
        position = drive.places.position_m.copy()
        middle = position[:, axis].mean() if not half else float(np.quantile(position[:, axis], 0.75))
        chosen = position[:, axis] > position[:, axis].mean() if half else np.ones(len(position), np.bool_)
        position[chosen, axis] = 2.0 * middle - position[chosen, axis]
        rotation = drive.places.rotation
        if rotation is not None:
            flip = np.array([1.0, -1.0, -1.0, 1.0] if axis == 0 else [-1.0, 1.0, -1.0, 1.0])
            rotation = np.where(chosen[:, None], rotation * flip, rotation)
        return replace(drive, places=replace(drive.places, position_m=position, rotation=rotation), moved_frame=True)

    return make


def map_axes(order: Sequence[int]) -> Mistake:
    """Give the map with its axes in another order; orientations stay."""
    return lambda drive, rng: _placed(drive, lambda position: position[:, list(order)])  # noqa: ARG005 (a Mistake)


def map_turned_tags(rotation: Sequence[float]) -> Mistake:
    """Give the orientations of the map in another convention for the axes of a tag."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
        assert drive.places is not None
        assert drive.places.rotation is not None
        turned = se3.compose(se3.turn(drive.places.rotation), se3.turn(rotation))[:, 3:]
        return replace(drive, places=replace(drive.places, rotation=turned))

    return make


def map_of_another_site(drive: Drive, rng: np.random.Generator) -> Drive:
    """Give the map of another place whose landmarks have the same identities."""
    assert drive.places is not None
    assert drive.site is not None
    site = SITES[drive.name](rng)
    _, mine, theirs = np.intersect1d(drive.places.landmark_id, site.landmark_id, return_indices=True)
    mixed = rng.permutation(theirs)
    places = drive.places[mine]
    rotation = None if places.rotation is None else site.pose[mixed, 3:]
    position = site.pose[mixed, : places.position_m.shape[1]]
    return replace(drive, places=replace(places, position_m=position, rotation=rotation), moved_frame=True)


def map_without_common_ids(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
    """Give a map of which no identity is ever seen."""
    assert drive.places is not None
    return replace(drive, places=replace(drive.places, landmark_id=drive.places.landmark_id + 300))


def map_edition(shift_m: float, own_m: float) -> Mistake:
    """Give another edition of the map: all places shifted alike, two by more, as between two fields of one season."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:
        assert drive.places is not None
        position = drive.places.position_m.copy()
        position[:, 0] += shift_m
        chosen = rng.choice(len(position), 2, replace=False)
        position[chosen, 1] += own_m
        return replace(drive, places=replace(drive.places, position_m=position), moved_frame=True)

    return make


def map_lists(places: Callable[[Landmarks], Landmarks]) -> Mistake:
    """Give a map that is a function of the right one."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:  # noqa: ARG001 (a Mistake)
        assert drive.places is not None
        return replace(drive, places=places(drive.places))

    return make


def on_robot(identity: int = 400) -> Mistake:
    """A tag on the robot itself is in every frame."""

    def make(drive: Drive, rng: np.random.Generator) -> Drive:
        frames = np.unique(drive.frame)
        value = np.repeat(drive.value[:1], len(frames), axis=0)
        value = value + rng.normal(0.0, 0.2 if drive.reading is Reading.CORNERS else 0.003, value.shape)
        if drive.reading is Reading.POSES:
            value[:, 3:] /= np.linalg.norm(value[:, 3:], axis=1, keepdims=True)
        return replace(
            drive,
            frame=np.concatenate([drive.frame, frames]),
            landmark=np.concatenate([drive.landmark, np.full(len(frames), identity)]),
            value=np.concatenate([drive.value, value]),
            tag_size_m={**drive.tag_size_m, identity: max(drive.tag_size_m.values())},
        )

    return make


def wandering(speed_mps: float) -> Any:
    """A person carries a landmark about: it moves a little every two seconds, all the time."""

    def choose(drive: Drive, rng: np.random.Generator) -> tuple[Event, ...]:
        row, events = int(most_seen(drive, float(drive.odometry_s[-1]) / 2)[0]), []
        assert drive.site is not None
        pose = drive.site.pose[row].copy()
        for at_s in np.arange(2.0, drive.odometry_s[-1], 2.0):
            pose = pose.copy()
            pose[:2] += rng.normal(0.0, 2.0 * speed_mps / math.sqrt(2.0), 2)
            events.append(Event(row, float(at_s), pose))
        return tuple(events)

    return choose
