"""A street over days: cars that park and leave, some while the robot drives by; all boxes without identity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from evermap.errors import ConfigError
from evermap.geometry import se3
from evermap.geometry.rigid import rigid
from evermap.survival import Exponential, LifetimePrior, LogNormal
from evermap.types import (
    UNKNOWN,
    BoolArray,
    FloatArray,
    Frames,
    IntArray,
    Recording,
    SpatialDetections,
    SpatialOdometry,
    SpatialRecording,
    SpatialSensor,
    Trajectory,
)

STEP_S, SPEED_MPS, REACH_M, DAY_S = 0.1, 8.0, 45.0, 86_400.0
CAR, VAN = "Car", "Van"
SIZES_M = {CAR: (4.2, 1.7, 1.5), VAN: (5.4, 2.0, 2.3)}
SIZE_SPREAD_M = (0.4, 0.08, 0.1)
LEAVING_MPS2 = 1.5
STAYS = LogNormal.from_half_life(36.0 * 3600.0, 1.0), Exponential.from_half_life(6.0 * 3600.0)
"""Of cars, which stand for days, and of vans, which are gone in the evening."""
AT_SLOT_M = 3.0
"""Farthest that what stands in a slot is from its middle."""
EMPTY = Exponential.from_half_life(8.0 * 3600.0)


class Spell(NamedTuple):
    """A car that stood in a slot, from when until when; it came and left along the street."""

    slot: int
    from_s: float
    until_s: float
    size_m: tuple[float, ...]
    class_id: int = 0


class Faults(NamedTuple):
    """What is wrong with a drive.

    Attributes:
        p_detect: of a box in view.
        p_false: of a wrong box, each frame.
        bend, scale: of the odometry, rad/m and as a factor.
        white_m, white_rad: of each of its steps.
        lasting_m: error that a box has a drive long.
        noise_m: in each frame.
        partial: by how much the length of a far box is too short, as a share.
        flipped: share of headings that are the wrong way round.
        odd: share of boxes that are seen with the size of any car, a drive long.
    """

    p_detect: float = 0.9
    p_false: float = 0.2
    bend: float = 2e-4
    scale: float = 1.003
    white_m: float = 0.005
    white_rad: float = 2e-4
    lasting_m: float = 0.08
    noise_m: float = 0.06
    partial: float = 0.1
    flipped: float = 0.05
    odd: float = 0.0


USUAL = Faults()


class Parking(NamedTuple):
    """A street with slots (S, 3) along a path (N, 3), one point each step; all spells, and names of classes."""

    path: FloatArray
    slot: FloatArray
    spells: list[Spell]
    class_names: tuple[str, ...] = (CAR,)

    @classmethod
    def of(
        cls, seed: int, *, n_slots: int = 36, metres: float = 320.0, class_names: tuple[str, ...] = (CAR,)
    ) -> Parking:
        """Return a street along an S, with no cars yet."""
        rng = np.random.default_rng(seed)
        n = round(metres / (SPEED_MPS * STEP_S))
        heading = 0.6 * np.sin(2.0 * np.pi * np.arange(n) / n)
        step = SPEED_MPS * STEP_S * np.column_stack([np.cos(heading), np.sin(heading)])
        path = np.column_stack([np.vstack([np.zeros(2), np.cumsum(step, axis=0)[:-1]]), heading])
        beside = np.linspace(14, n - 4, n_slots // 2).astype(int)
        slot = []
        for side in (-1.0, 1.0):
            at = np.clip(beside + rng.integers(-2, 3, len(beside)), 0, n - 1)
            normal = np.column_stack([-np.sin(heading[at]), np.cos(heading[at])])
            aside = side * (5.0 + rng.uniform(-0.4, 0.8, len(at)))
            slot.append(
                np.column_stack([path[at, :2] + aside[:, None] * normal, heading[at] + rng.normal(0, 0.04, len(at))])
            )
        return cls(path, np.concatenate(slot), [], class_names)

    def park(self, rng: np.random.Generator, slot: int, from_s: float, until_s: float, class_id: int = 0) -> None:
        """Let a car stand in a slot."""
        size = rng.normal(SIZES_M[self.class_names[class_id]], SIZE_SPREAD_M)
        self.spells.append(Spell(slot, from_s, until_s, tuple(size.tolist()), class_id))

    def standing(self, stamp_s: float) -> set[int]:
        """Return the slots that are taken."""
        return {one.slot for one in self.spells if one.from_s <= stamp_s < one.until_s}

    def find_passed(self, part: tuple[float, float] = (0.0, 1.0), *, back: bool = False) -> set[int]:
        """Return the slots that a drive along a part of the path passes, `back` or forth."""
        n, beside = len(self.path), self.beside
        before, beyond = (-25, -12) if back else (12, 25)
        low, high = part[0] * n + before, part[1] * n + beyond
        return set(np.flatnonzero((beside >= low) & (beside < high)).tolist())

    @property
    def beside(self) -> IntArray:
        """(S,) the point of the path that is nearest to each slot."""
        return np.asarray(np.linalg.norm(self.slot[:, None, :2] - self.path[None, :, :2], axis=2).argmin(axis=1))

    def find_slots(self, position_m: FloatArray) -> IntArray:
        """Return the slots (N,) of what a map has at positions (N, 2), -1 for none.

        The first drive begins where the street does, and its odometry has drifted: all are aligned as a whole.
        """
        at = position_m
        for reach_m in (5.0, 3.5, AT_SLOT_M):
            away = np.linalg.norm(at[:, None] - self.slot[None, :, :2], axis=2)
            near = away.min(axis=1) < reach_m
            x, y, turn = rigid(at[near], self.slot[away.argmin(axis=1)[near], :2])
            at = at @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) + np.array([x, y])
        away = np.linalg.norm(at[:, None] - self.slot[None, :, :2], axis=2)
        return np.where(away.min(axis=1) < AT_SLOT_M, away.argmin(axis=1), UNKNOWN)

    def drive(
        self,
        seed: int,
        start_s: float,
        part: tuple[float, float] = (0.0, 1.0),
        faults: Faults = USUAL,
        origin: FloatArray | None = None,
        moving: int = 3,
        back: bool = False,
        aside_m: float = 0.0,
    ) -> SpatialRecording:
        """Return a drive along a part of the street, as an odometry and a detector of boxes see it.

        Args:
            seed: of its noise.
            start_s: when it begins.
            part: from where to where, as shares of the path.
            faults: what is wrong with it.
            origin: (7,) pose of the street in the frame of the odometry; None for that of the first pose.
            moving: cars that drive, too.
            back: from the end to the beginning.
            aside_m: how far left of the path, as the street is drawn.
        """
        rng = np.random.default_rng(seed)
        n = len(self.path)
        path = self.path[int(part[0] * n) : int(part[1] * n)].copy()
        path[:, :2] += aside_m * np.column_stack([-np.sin(path[:, 2]), np.cos(path[:, 2])])
        path = path[::-1] + [0.0, 0.0, np.pi] if back else path
        stamp_s = start_s + np.arange(len(path), dtype=np.float64) * STEP_S
        pose = upright(path)
        boxes, size, errors, class_id = self._around(rng, path, stamp_s, moving, faults)
        if faults.odd > 0.0:
            odd = np.flatnonzero(rng.uniform(size=len(size)) < faults.odd)
            usual_m = np.array([SIZES_M[self.class_names[one]] for one in class_id[odd].tolist()]).reshape(-1, 3)
            size[odd] = rng.normal(usual_m, SIZE_SPREAD_M)
        detections = _seen(rng, pose, boxes, size, class_id, errors, faults)
        odometry = _drifted(rng, pose, faults)
        odometry = se3.compose(se3.inverse(odometry[0]), odometry) if origin is None else se3.compose(origin, odometry)
        return Recording(
            name=f"drive {start_s:.0f}",
            odometry=SpatialOdometry(stamp_s, odometry, np.full((len(stamp_s), 6), np.nan)),
            frames=Frames(stamp_s),
            detections=detections,
            sensors=(SpatialSensor(),),
            truth=Trajectory(stamp_s, pose, np.zeros((len(pose), 6, 6)), frame="truth"),
            class_names=self.class_names,
        )

    def _around(
        self, rng: np.random.Generator, path: FloatArray, stamp_s: FloatArray, moving: int, faults: Faults
    ) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
        """Boxes (C, F, 3), nan where they are not there, sizes (C, 3), errors (C, 3) that last, and classes (C,)."""
        found, sizes = [], []
        for one in self.spells:
            place = self.slot[one.slot]
            way = np.tile(place, (len(stamp_s), 1))
            left, before = np.maximum(stamp_s - one.until_s, 0.0), np.maximum(one.from_s - stamp_s, 0.0)
            along = 0.5 * LEAVING_MPS2 * (left**2 - before**2)
            way[:, :2] += along[:, None] * [np.cos(place[2]), np.sin(place[2])]
            way[(left > 8.0) | (before > 8.0)] = np.nan
            found.append(way)
            sizes.append(one.size_m)
        normal = np.column_stack([-np.sin(path[:, 2]), np.cos(path[:, 2])])
        for k in range(moving):
            way = np.full((len(path), 3), np.nan)
            begin, by = (15 + 9 * k, 1) if k % 2 else (len(path) - 1 - 40 * k, -1)
            at = begin + by * np.arange(len(path))
            there = (at >= 0) & (at < len(path))
            way[there, :2] = path[at[there], :2] + (0.5 if by > 0 else 2.5) * normal[at[there]]
            way[there, 2] = path[at[there], 2] + (0.0 if by > 0 else np.pi)
            found.append(way)
            sizes.append(tuple(rng.normal(SIZES_M[CAR], SIZE_SPREAD_M).tolist()))
        class_id = np.zeros(len(found), dtype=np.int64)
        class_id[: len(self.spells)] = [one.class_id for one in self.spells]
        errors = rng.normal(0.0, faults.lasting_m, (len(found), 3))
        return np.array(found).reshape(-1, len(path), 3), np.array(sizes).reshape(-1, 3), errors, class_id


def upright(place: FloatArray) -> FloatArray:
    """Return poses (..., 7) at x, y and heading."""
    half, nothing = 0.5 * place[..., 2], np.zeros(place.shape[:-1])
    columns = [place[..., 0], place[..., 1], nothing, nothing, nothing, np.sin(half), np.cos(half)]
    return np.stack(columns, axis=-1)


def _drifted(rng: np.random.Generator, pose: FloatArray, faults: Faults) -> FloatArray:
    step = se3.between(pose[:-1], pose[1:])
    turn = rng.normal(0.0, [faults.white_m] * 2 + [0.0] * 3 + [faults.white_rad], (len(step), 6))
    turn[:, 5] += faults.bend * np.linalg.norm(step[:, :3], axis=1)
    step[:, :3] *= faults.scale
    found = [pose[0]]
    for one in se3.retract(step, turn):
        found.append(se3.compose(found[-1], one))
    return np.array(found)


def _shaded(local: FloatArray, seen: BoolArray) -> BoolArray:
    """Boxes (C, F) of which the middle is behind a nearer one."""
    range_m, bearing = np.hypot(local[..., 0], local[..., 1]), np.arctan2(local[..., 1], local[..., 0])
    nearer = range_m[:, None] > range_m[None] + 2.0
    covers = np.abs(bearing[:, None] - bearing[None]) < np.arctan2(1.2, range_m)[None]
    return np.asarray((nearer & covers & seen[None]).any(axis=1))


def _seen(
    rng: np.random.Generator,
    pose: FloatArray,
    boxes: FloatArray,
    size: FloatArray,
    class_id: IntArray,
    errors: FloatArray,
    faults: Faults,
) -> SpatialDetections:
    """What is in view, and wrong boxes."""
    with np.errstate(invalid="ignore"):
        local = se3.compose(se3.inverse(pose)[None], upright(boxes))
        reach = np.linalg.norm(local[..., :3], axis=-1)
        view = (reach < REACH_M) & (local[..., 0] > 2.0) & (np.abs(local[..., 1]) < 1.2 * local[..., 0])
        view &= ~_shaded(local, view)
    seen = view & (rng.uniform(size=view.shape) < faults.p_detect)
    frame, of = np.nonzero(seen.T)
    at = local[of, frame]
    range_m = reach[of, frame]
    at[:, :3] += errors[of] + rng.normal(0.0, faults.noise_m, (len(at), 3)) * (1.0 + range_m / 30.0)[:, None]
    sizes = size[of] * (1.0 + 0.03 * rng.normal(size=(len(of), 3)))
    sizes[:, 0] *= 1.0 - faults.partial * (range_m > 25.0)
    wrong = np.flatnonzero(rng.uniform(size=len(pose)) < faults.p_false)
    strange = np.column_stack([rng.uniform(5.0, 40.0, len(wrong)), rng.uniform(-12.0, 12.0, len(wrong)), 0.0 * wrong])
    turned = rng.uniform(size=len(at)) < faults.flipped
    at[turned] = se3.compose(at[turned], upright(np.array([0.0, 0.0, np.pi])))
    at = np.vstack([at, upright(np.column_stack([strange[:, :2], rng.uniform(-3, 3, len(wrong))]))])
    frame = np.concatenate([frame, wrong])
    sizes = np.vstack([sizes, np.tile(SIZES_M[CAR], (len(wrong), 1))])
    classes = np.concatenate([class_id[of], np.zeros(len(wrong), dtype=np.int64)])
    score = np.concatenate([rng.normal(8.0, 1.0, len(of)), rng.normal(2.0, 1.5, len(wrong))])
    return _table(np.argsort(frame, kind="stable"), frame, at, sizes, classes, score)


def _table(
    order: IntArray, frame: IntArray, at: FloatArray, size: FloatArray, class_id: IntArray, score: FloatArray
) -> SpatialDetections:
    count = len(order)
    unsaid = np.full(count, np.nan)
    return SpatialDetections(
        frame=frame[order],
        sensor=np.zeros(count, dtype=np.int64),
        landmark_id=np.full(count, UNKNOWN),
        position_sensor_m=at[order, :3],
        rotation=at[order, 3:],
        covariance_sensor_m2=np.full((count, 3, 3), np.nan),
        sigma_rad=unsaid,
        corner_px=np.full((count, 4, 2), np.nan),
        tag_size_m=unsaid,
        size_m=size[order],
        class_id=class_id[order],
        score=score[order],
        source_line=2 + np.arange(count),
    )


@dataclass(frozen=True, slots=True)
class StreetConfig:
    """How cars come and go, and when the robot drives by.

    Attributes:
        days: of drives.
        drives_per_day: at even times from eight in the morning to eight in the evening.
        n_slots: places to park, on both sides.
        van_share: share of vans among those that park.
        stays: how long cars and vans park.
        empty: how long a slot is empty.
        moving: cars that drive along in each drive.
        faults: of odometry and detector.
    """

    days: int = 3
    drives_per_day: int = 1
    n_slots: int = 36
    van_share: float = 0.3
    stays: tuple[LifetimePrior, LifetimePrior] = STAYS
    empty: LifetimePrior = EMPTY
    moving: int = 3
    faults: Faults = USUAL

    def __post_init__(self) -> None:
        for name, least in (("days", 1), ("drives_per_day", 1), ("n_slots", 2), ("moving", 0)):
            if getattr(self, name) < least:
                raise ConfigError(f"must be at least {least}, not {getattr(self, name)}", field=name)
        if not 0.0 <= self.van_share <= 1.0:
            raise ConfigError(f"must lie in [0, 1], not {self.van_share}", field="van_share")

    def starts_s(self) -> list[float]:
        """Return when each drive begins, in seconds from midnight before the first."""
        hours = np.linspace(8.0, 20.0, self.drives_per_day + 1)[:-1] + 6.0 / self.drives_per_day
        return [day * DAY_S + hour * 3600.0 for day in range(self.days) for hour in hours.tolist()]


class StreetRun(NamedTuple):
    """A street with all its spells, and the drives along it, in order of time."""

    street: Parking
    drives: list[SpatialRecording]


def simulate_street(config: StreetConfig | None = None, seed: int = 0) -> StreetRun:
    """Return drives along a street on which cars and vans come and go; the same seed gives the same street.

    Slots are full and empty in turn, from a week before the first drive on, so that ages are what they are in the long
    run. Where a car leaves or comes during a drive, it is seen to do so.
    """
    config = config or StreetConfig()
    rng = np.random.default_rng(seed)
    street = Parking.of(seed, n_slots=config.n_slots, class_names=(CAR, VAN))
    end_s = config.days * DAY_S
    for slot in range(len(street.slot)):
        now_s = -7.0 * DAY_S - float(config.empty.quantile(rng.random()))
        while now_s < end_s:
            now_s += float(config.empty.quantile(rng.random()))
            class_id = int(rng.random() < config.van_share)
            until_s = now_s + float(config.stays[class_id].quantile(rng.random()))
            street.park(rng, slot, now_s, until_s, class_id)
            now_s = until_s
    drives = [
        street.drive(1000 * seed + k, start_s, faults=config.faults, moving=config.moving)
        for k, start_s in enumerate(config.starts_s())
    ]
    return StreetRun(street, drives)
