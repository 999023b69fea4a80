"""A yard with forklifts that carry tags: some drive and stop while the robot is there, some are parked; people walk by.

Tags on the walls stay. Those on a forklift move as one body, which is stated (`Recording.objects`). With `standing`
nothing but the robot moves, and all else is the same: what it sees is worth what it would be worth without motion.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from evermap.config import SlamConfig
from evermap.errors import ConfigError
from evermap.geometry import se3
from evermap.geometry.group import accumulate
from evermap.slam.plane import in_its_space
from evermap.types import (
    MASK_ID,
    UNKNOWN,
    BoolArray,
    FloatArray,
    Frames,
    IntArray,
    Landmarks,
    Recording,
    SpatialDetections,
    SpatialOdometry,
    SpatialRecording,
    SpatialSensor,
    Trajectory,
    is_in_space,
)
from evermap_studies.worlds.parking import upright

STEP_S, DAY_S, HOUR_S = 0.2, 86_400.0, 3600.0
LENGTH_M, WIDTH_M = 34.0, 22.0
"""Of the yard."""
LANE_M = 3.5
"""From the walls to where the robot drives."""
ROBOT_MPS, SENSOR_HEIGHT_M = 1.2, 0.8
FORKLIFT_M = 2.4, 1.2, 2.0
FORKLIFT_MPS, FORKLIFT_MPS2 = 1.5, 0.7
BOX_M, BOX_RAD, BOX_SHARE = 0.08, 0.05, 0.05
"""Noise of a box: of its position along the floor, its heading, and its size, as a share of it."""
PERSON_M = 0.3
"""Radius of one who walks."""
FACING = 0.25
"""Cosine between a line of sight and what a tag faces, at least."""


@dataclass(frozen=True, slots=True)
class YardConfig:
    """What is in a yard, and what the robot sees of it.

    Attributes:
        days: of drives.
        drives_per_day: from eight in the morning on, an hour apart.
        moving: forklifts that drive and stop while the robot is there.
        parked: forklifts that stand while it is, elsewhere in every drive.
        standing: whether nothing but the robot moves, also from drive to drive.
        wall_tags: tags on the walls.
        people: who walk, and stand in the way of lines of sight.
        oriented: whether tags are seen with their orientation; else as points.
        stated: whether `Recording.objects` says which tags are on one forklift.
        boxed: whether a detector reports boxes around forklifts, without identity.
        masked: which numbers the masks of forklifts have: those of a tracker ('tracked'), or of each 'image'; None
            where there are no masks.
        walls_masked: whether the walls are a mask, too.
        wrong_masks: share of the looks at a tag in which it is taken to lie where another one in view does.
        drive_s: how long a drive takes.
        reach_m, half_view_rad: how far the robot sees, and to either side.
        sigma_m, sigma_share, sigma_rad: noise of a tag's position at no range and as a share of it, and of its
            orientation.
        p_detect: of a tag in view.
        drift_m, drift_rad: noise of the odometry, for the square root of a second.
        scale: of the odometry.
    """

    days: int = 1
    drives_per_day: int = 1
    moving: int = 4
    parked: int = 2
    standing: bool = False
    wall_tags: int = 24
    people: int = 4
    oriented: bool = True
    stated: bool = True
    boxed: bool = False
    masked: Literal["tracked", "image"] | None = None
    walls_masked: bool = False
    wrong_masks: float = 0.05
    drive_s: float = 90.0
    reach_m: float = 10.0
    half_view_rad: float = 1.3
    sigma_m: float = 0.01
    sigma_share: float = 0.005
    sigma_rad: float = 0.02
    p_detect: float = 0.9
    drift_m: float = 0.02
    drift_rad: float = 0.01
    scale: float = 1.005

    def __post_init__(self) -> None:
        for name, least in (("days", 1), ("drives_per_day", 1), ("moving", 0), ("parked", 0), ("people", 0)):
            if getattr(self, name) < least:
                raise ConfigError(f"must be at least {least}, not {getattr(self, name)}", field=name)
        if self.wall_tags < 4:
            raise ConfigError(f"needs 4, one on each wall, not {self.wall_tags}", field="wall_tags")

    def starts_s(self) -> list[float]:
        """Return when each drive begins, in seconds from midnight before the first."""
        return [day * DAY_S + (8 + k) * HOUR_S for day in range(self.days) for k in range(self.drives_per_day)]


class Forklift(NamedTuple):
    """A body with tags: the oval that it drives on, (x, y, half length, half width, heading), and tags (T, 7) on it."""

    oval: FloatArray
    tag: FloatArray


class YardDrive(NamedTuple):
    """A drive with its truth.

    Attributes:
        recording: what the robot reads.
        body: (B, F, 3) places of forklifts at each frame.
        moves: (B, F) whether each drives.
        tag: (T, F, 7) poses of tags at each frame.
        body_of_tag: (T,) forklift that each tag is on, -1 on the walls; the identity of a tag is its row.
    """

    recording: SpatialRecording
    body: FloatArray
    moves: BoolArray
    tag: FloatArray
    body_of_tag: IntArray


def simulate_yard(config: YardConfig | None = None, seed: int = 0) -> list[YardDrive]:
    """Return drives through a yard, in order of time; the same seed gives the same yard."""
    config = config or YardConfig()
    rng = np.random.default_rng(seed)
    walls, forklifts = _tags_on_walls(config.wall_tags, rng), _forklifts(config, rng)
    on = [np.full(len(walls), -1), *(np.full(len(one.tag), k) for k, one in enumerate(forklifts))]
    body_of_tag = np.concatenate(on).astype(np.int64)
    drives = []
    for k, start_s in enumerate(config.starts_s()):
        of_drive = 0 if config.standing else k
        body, moves = _driven(forklifts, config, np.random.default_rng([seed, 1, of_drive]))
        tag = np.concatenate(
            [
                np.repeat(walls[:, None], body.shape[1], axis=1),
                *(se3.compose(upright(way)[None], one.tag[:, None]) for one, way in zip(forklifts, body, strict=True)),
            ]
        )
        recording = _record(tag, body_of_tag, body, config, start_s, np.random.default_rng([seed, 2, k]))
        if config.boxed:
            recording = _with_boxes(recording, body, config, np.random.default_rng([seed, 4, k]))
        if config.masked is not None:
            recording = _with_masks(recording, body_of_tag, config, np.random.default_rng([seed, 5, k]))
        drives.append(YardDrive(recording, body, moves, tag, body_of_tag))
    return drives


def _tags_on_walls(count: int, rng: np.random.Generator) -> FloatArray:
    """(T, 7) tags that face inwards, at even distances along the walls."""
    along = (np.arange(count) + rng.uniform(0.2, 0.8, count)) / count * 2.0 * (LENGTH_M + WIDTH_M)
    corners = np.cumsum([0.0, LENGTH_M, WIDTH_M, LENGTH_M, WIDTH_M])
    wall = np.searchsorted(corners, along, side="right") - 1
    begin = np.array([[0.0, 0.0], [LENGTH_M, 0.0], [LENGTH_M, WIDTH_M], [0.0, WIDTH_M]])[wall]
    heading = np.asarray(0.5 * np.pi * wall, dtype=np.float64)
    at = begin + (along - corners[wall])[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    height_m = rng.uniform(0.8, 2.2, count)
    return _facing(np.column_stack([at, height_m]), heading + 0.5 * np.pi)


def _facing(at: FloatArray, heading: FloatArray) -> FloatArray:
    """Poses (T, 7) of tags at (T, 3), whose z axis points along a heading (T,) and y axis down."""
    found = se3.compose(upright(np.column_stack([at[:, :2], heading])), [0.0, 0.0, 0.0, -0.5, 0.5, -0.5, 0.5])
    found[:, 2] = at[:, 2]
    return found


def _forklifts(config: YardConfig, rng: np.random.Generator) -> list[Forklift]:
    """Forklifts with two to four tags each, in the middle of the yard, beside each other."""
    count, found = config.moving + config.parked, list[Forklift]()
    inner = 2.0 * LANE_M
    for k in range(count):
        middle = inner + (LENGTH_M - 2.0 * inner) * (k + 0.5) / count, 0.5 * WIDTH_M + rng.uniform(-1.5, 1.5)
        oval = np.array([*middle, rng.uniform(2.5, 4.0), rng.uniform(1.5, 2.5), rng.uniform(0.0, 2.0 * np.pi)])
        length, width, height = FORKLIFT_M
        sides = [(0.5 * length, 0.0, 0.0), (0.0, 0.5 * width, 0.5 * np.pi), (-0.5 * length, 0.0, np.pi)]
        sides = [*sides, (0.0, -0.5 * width, 1.5 * np.pi)]
        chosen = rng.permutation(4)[: rng.integers(2, 5)]
        at = np.array([[x, y, rng.uniform(0.3, 0.9) * height] for x, y, _ in (sides[row] for row in chosen)])
        at[:, :2] += rng.uniform(-0.3, 0.3, (len(at), 2)) * (np.abs(at[:, :2]) < 0.1)
        found.append(Forklift(oval, _facing(at, np.array([sides[row][2] for row in chosen]))))
    return found


def _driven(forklifts: list[Forklift], config: YardConfig, rng: np.random.Generator) -> tuple[FloatArray, BoolArray]:
    """(B, F, 3) places of forklifts at each frame, and (B, F) whether they drive."""
    n = round(config.drive_s / STEP_S)
    found, moves = np.zeros((len(forklifts), n, 3)), np.zeros((len(forklifts), n), dtype=np.bool_)
    for k, one in enumerate(forklifts):
        x, y, long, wide, heading = one.oval
        phase = rng.uniform(0.0, 2.0 * np.pi)
        speed = _stop_and_go(n, rng)
        if config.standing or k >= config.moving:
            speed[:] = 0.0
        moves[k] = speed > 0.0
        place = np.zeros(3)
        for row in range(n):
            ahead = np.array([-long * np.sin(phase), wide * np.cos(phase)])
            cos, sin = np.cos(heading), np.sin(heading)
            turn = np.array([[cos, -sin], [sin, cos]])
            place[:2] = [x, y] + turn @ [long * np.cos(phase), wide * np.sin(phase)]
            place[2] = np.arctan2(*(turn @ ahead)[::-1])
            found[k, row] = place
            phase += speed[row] * STEP_S / float(np.linalg.norm(ahead))
    return found, moves


def _stop_and_go(n: int, rng: np.random.Generator) -> FloatArray:
    """(n,) speeds of one that drives for a while and stops for a while."""
    wanted, row, drives = np.zeros(n), 0, bool(rng.random() < 0.7)
    while row < n:
        lasts = round(rng.uniform(8.0, 25.0) / STEP_S) if drives else round(rng.uniform(6.0, 15.0) / STEP_S)
        wanted[row : row + lasts] = rng.uniform(0.5, 1.0) * FORKLIFT_MPS if drives else 0.0
        row, drives = row + lasts, not drives
    speed, now = np.zeros(n), float(wanted[0])
    for row in range(n):
        now += float(np.clip(wanted[row] - now, -FORKLIFT_MPS2 * STEP_S, FORKLIFT_MPS2 * STEP_S))
        speed[row] = now
    return speed


def _robot(config: YardConfig) -> FloatArray:
    """(F, 3) places of the robot at each frame: round the yard, along the walls, with rounded corners."""
    radius = 2.0
    long, wide = LENGTH_M - 2.0 * (LANE_M + radius), WIDTH_M - 2.0 * (LANE_M + radius)
    parts = np.array([long, 0.5 * np.pi * radius, wide, 0.5 * np.pi * radius] * 2)
    begin = np.append(0.0, np.cumsum(parts))
    n = round(config.drive_s / STEP_S)
    found, heading, at = np.zeros((n, 3)), np.zeros(9), np.zeros((9, 2))
    at[0] = LANE_M + radius, LANE_M
    for k in range(8):
        ahead = np.array([np.cos(heading[k]), np.sin(heading[k])])
        left = np.array([-ahead[1], ahead[0]])
        at[k + 1] = at[k] + (radius * (ahead + left) if k % 2 else parts[k] * ahead)
        heading[k + 1] = heading[k] + (0.5 * np.pi if k % 2 else 0.0)
    for row, way in enumerate((ROBOT_MPS * STEP_S * np.arange(n)) % begin[-1]):
        k = int(np.searchsorted(begin, way, side="right")) - 1
        rest = way - begin[k]
        ahead = np.array([np.cos(heading[k]), np.sin(heading[k])])
        left = np.array([-ahead[1], ahead[0]])
        turned = rest / radius if k % 2 else 0.0
        off = radius * (np.sin(turned) * ahead + (1.0 - np.cos(turned)) * left) if k % 2 else rest * ahead
        found[row] = [*(at[k] + off), heading[k] + turned]
    return found


def _record(
    tag: FloatArray,
    body_of_tag: IntArray,
    body: FloatArray,
    config: YardConfig,
    start_s: float,
    rng: np.random.Generator,
) -> SpatialRecording:
    """What the robot reads in one drive."""
    pose = upright(_robot(config))
    stamp_s = start_s + STEP_S * np.arange(len(pose), dtype=np.float64)
    eye = pose + [0.0, 0.0, SENSOR_HEIGHT_M, 0.0, 0.0, 0.0, 0.0]
    seen = _in_view(eye, tag, body, _people(config, len(pose), rng), config)
    seen &= rng.uniform(size=seen.shape) < config.p_detect
    frame, row = np.nonzero(seen.T)
    local = se3.between(eye[frame], tag[row, frame])
    sigma_m = config.sigma_m + config.sigma_share * np.linalg.norm(local[:, :3], axis=1)
    noise = rng.normal(size=(len(local), 6)) * np.column_stack([*[sigma_m] * 3, *[np.full(len(local), 1.0)] * 3])
    noise[:, 3:] *= config.sigma_rad
    local[:, :3] += noise[:, :3]
    turned = se3.retract(local, np.hstack([0.0 * noise[:, :3], noise[:, 3:]]))
    count, unsaid = len(row), np.full(len(row), np.nan)
    detections = SpatialDetections(
        frame=frame,
        sensor=np.zeros(count, dtype=np.int64),
        landmark_id=row.astype(np.int64),
        position_sensor_m=local[:, :3],
        rotation=turned[:, 3:] if config.oriented else np.full((count, 4), np.nan),
        covariance_sensor_m2=(sigma_m**2)[:, None, None] * np.eye(3),
        sigma_rad=np.full(count, config.sigma_rad) if config.oriented else unsaid,
        corner_px=np.full((count, 4, 2), np.nan),
        tag_size_m=unsaid,
        size_m=np.full((count, 3), np.nan),
        class_id=np.zeros(count, dtype=np.int64),
        score=unsaid,
        source_line=2 + np.arange(count),
    )
    carried = np.flatnonzero((body_of_tag >= 0) & config.stated)
    return Recording(
        name=f"yard {start_s:.0f}",
        odometry=SpatialOdometry(stamp_s, _odometry(pose, config, rng), np.full((len(stamp_s), 6), np.nan), z_up=True),
        frames=Frames(stamp_s),
        detections=detections,
        sensors=(SpatialSensor(mount_robot_sensor=(0.0, 0.0, SENSOR_HEIGHT_M, 0.0, 0.0, 0.0, 1.0)),),
        truth=Trajectory(stamp_s, pose, np.zeros((len(pose), 6, 6)), frame="truth"),
        true_landmarks=Landmarks.in_space(np.arange(len(tag)), tag[:, -1, :3], rotation=tag[:, -1, 3:]),
        objects=np.column_stack([carried, body_of_tag[carried]]),
        class_names=("tag",),
    )


def _with_boxes(
    recording: SpatialRecording, body: FloatArray, config: YardConfig, rng: np.random.Generator
) -> SpatialRecording:
    """The recording with boxes (length, width, height) of what is near and ahead, behind the tags of each frame."""
    assert recording.truth is not None
    given, truth = recording.detections, recording.truth.pose_world_robot
    eye = truth + [0.0, 0.0, SENSOR_HEIGHT_M, 0.0, 0.0, 0.0, 0.0]
    middle = upright(body)
    middle[..., 2] = 0.5 * FORKLIFT_M[2]
    local = se3.between(eye[None], middle)
    range_m = np.linalg.norm(local[..., :3], axis=-1)
    seen = (range_m < config.reach_m) & (np.abs(np.arctan2(local[..., 1], local[..., 0])) < config.half_view_rad)
    seen &= rng.uniform(size=seen.shape) < config.p_detect
    frame, one = np.nonzero(seen.T)
    local, count = local[one, frame], len(frame)
    local[:, :3] += rng.normal(size=(count, 3)) * [BOX_M, BOX_M, 0.5 * BOX_M]
    turn = np.zeros((count, 6))
    turn[:, 5] = BOX_RAD * rng.normal(size=count)
    order = np.argsort(np.concatenate([given.frame, frame]), kind="stable")
    unsaid = np.full(count, np.nan)
    boxes = SpatialDetections(
        frame=frame,
        sensor=np.zeros(count, dtype=np.int64),
        landmark_id=np.full(count, UNKNOWN),
        position_sensor_m=local[:, :3],
        rotation=se3.retract(local, turn)[:, 3:],
        covariance_sensor_m2=np.full((count, 3, 3), np.nan),
        sigma_rad=unsaid,
        corner_px=np.full((count, 4, 2), np.nan),
        tag_size_m=unsaid,
        size_m=np.array(FORKLIFT_M) * np.exp(BOX_SHARE * rng.normal(size=(count, 3))),
        class_id=np.ones(count, dtype=np.int64),
        score=unsaid,
        source_line=2 + len(given) + np.arange(count),
    )
    both: dict[str, Any] = {
        column.name: np.concatenate([getattr(given, column.name), getattr(boxes, column.name)])[order]
        for column in fields(given)
        if isinstance(getattr(boxes, column.name), np.ndarray)
    }
    return replace(recording, detections=replace(given, **both), class_names=("tag", "forklift"))


def _with_masks(
    recording: SpatialRecording, body_of_tag: IntArray, config: YardConfig, rng: np.random.Generator
) -> SpatialRecording:
    """The recording with the number of the mask that each tag lies in, nan for none."""
    seen = recording.detections
    named = np.flatnonzero(seen.landmark_id != UNKNOWN)
    thing, frame = body_of_tag[seen.landmark_id[named]], seen.frame[named]
    first, last = np.searchsorted(frame, frame), np.searchsorted(frame, frame, side="right")
    other = thing[first + np.floor(rng.uniform(size=len(frame)) * (last - first)).astype(np.int64)]
    thing = np.where(rng.uniform(size=len(frame)) < config.wrong_masks, other, thing)
    number = np.tile(np.arange(thing.max() + 2), (len(recording.frames), 1))
    if config.masked == "image":
        number = rng.permuted(number, axis=1)
    mask = np.full((len(seen), 1), np.nan)
    mask[named, 0] = np.where((thing < 0) & (not config.walls_masked), np.nan, number[frame, thing])
    return replace(recording, detections=replace(seen, features=mask, feature_names=(MASK_ID,)))


def _in_view(eye: FloatArray, tag: FloatArray, body: FloatArray, people: FloatArray, config: YardConfig) -> BoolArray:
    """(T, F) tags that are near, ahead, face the robot, and are behind neither a forklift nor a person."""
    local = se3.transform(se3.inverse(eye)[None], tag[..., :3])
    range_m = np.linalg.norm(local, axis=-1)
    off = eye[None, :, :3] - tag[..., :3]
    facing = (off * se3.rotation_of(tag)[..., 2]).sum(axis=-1) / range_m
    seen = (range_m < config.reach_m) & (facing > FACING)
    seen &= np.abs(np.arctan2(local[..., 1], local[..., 0])) < config.half_view_rad
    for things, half_m in ((body, 0.5 * FORKLIFT_M[1]), (people, PERSON_M)):
        for one in things:
            ahead = one[None, :, :2] - eye[None, :, :2]
            along = (tag[..., :2] - eye[None, :, :2]) / np.maximum(range_m, 1e-9)[..., None]
            near = (ahead * along).sum(axis=-1)
            across = np.abs(ahead[..., 0] * along[..., 1] - ahead[..., 1] * along[..., 0])
            own = np.linalg.norm(tag[..., :2] - one[None, :, :2], axis=-1) < 0.6 * FORKLIFT_M[0]
            seen &= ~((near > 0.0) & (near < range_m - half_m) & (across < half_m) & ~own)
    return np.asarray(seen)


def _people(config: YardConfig, n: int, rng: np.random.Generator) -> FloatArray:
    """(C, F, 2) people who walk to and fro between two places."""
    found = np.zeros((config.people, n, 2))
    for one in found:
        ends = rng.uniform([2.0, 2.0], [LENGTH_M - 2.0, WIDTH_M - 2.0], (2, 2))
        length = float(np.linalg.norm(ends[1] - ends[0]))
        way = (1.2 * STEP_S * np.arange(n) + rng.uniform(0.0, length)) / max(length, 1.0)
        share = np.zeros(n) if config.standing else np.abs((way + 1.0) % 2.0 - 1.0)
        one[:] = ends[0] + share[:, None] * (ends[1] - ends[0])
    return found


def _odometry(pose: FloatArray, config: YardConfig, rng: np.random.Generator) -> FloatArray:
    """(F, 7) poses by the odometry, from the identity."""
    step = se3.between(pose[:-1], pose[1:])
    step[:, :3] *= config.scale
    root = np.sqrt(STEP_S)
    by = np.array([config.drift_m, config.drift_m, 0.0, 0.0, 0.0, config.drift_rad]) * root
    return accumulate(se3.retract(step, by * rng.normal(size=(len(step), 6))))


def flatten(recording: SpatialRecording) -> Recording:
    """Return a drive in the plane: ranges and bearings of its tags, with what is stated of forklifts."""
    found = in_its_space(replace(recording, objects=recording.objects[:0]), SlamConfig(plane=True))
    assert not is_in_space(found)
    return replace(found, objects=recording.objects)
