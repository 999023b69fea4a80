"""How the building changes: every object alternates between stays and absences; events are where stays meet.

A `Stay` is one spell of an object at one pose. The list of stays is the whole truth about change; events, landmark
positions at any time and lifetimes are read off it. The world stands still while the robot patrols: what would
happen during a session happens at its end.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from evermap.geometry import se2
from evermap.types import FloatArray
from evermap_studies.sim.building import Circles, Placer, SceneObject, attach_landmarks
from evermap_studies.sim.config import DAY_S, BuildingConfig

Pose = tuple[float, float, float]


class EventKind(StrEnum):
    """What happened to an object."""

    APPEARED = "appeared"
    """It had never been there."""
    VANISHED = "vanished"
    MOVED = "moved"
    RETURNED = "returned"
    """It had vanished before; its displacement says whether to the same place."""
    OPENED = "opened"
    CLOSED = "closed"


@dataclass(frozen=True, slots=True)
class Stay:
    """One spell of an object at one pose, from `start_s` (inclusive) to `end_s` (exclusive).

    Attributes:
        end_s: also where it lies after the last session (the true lifetime, uncensored); inf = for ever.
        pose: (x, y, theta) of the object in the world.
        is_open: of a door, whether it is open.
    """

    object_id: int
    start_s: float
    end_s: float
    pose: Pose
    is_open: bool = False


@dataclass(frozen=True, slots=True)
class ChangeEvent:
    """One true change.

    Attributes:
        stamp_s: when, seconds since 1970 UTC.
        object_id, landmark_ids: what.
        class_name: class of the object.
        kind: what happened.
        displacement_m: largest distance of one of its landmarks from where it was last; 0 for appeared and vanished.
        pose_before, pose_after: poses of the object; None where it was or is not there.
    """

    stamp_s: float
    object_id: int
    landmark_ids: tuple[int, ...]
    class_name: str
    kind: EventKind
    displacement_m: float
    pose_before: Pose | None
    pose_after: Pose | None


@dataclass(frozen=True, slots=True)
class Timeline:
    """The time in which things change.

    Attributes:
        start_s, end_s: from midnight of day 0 to the end of the last session.
        sessions_s: (S, 2) start and end of each session, ascending.
    """

    start_s: float
    end_s: float
    sessions_s: FloatArray

    def defer(self, stamp_s: float) -> float:
        """Return the stamp itself, or the end of the session that it falls in."""
        row = int(np.searchsorted(self.sessions_s[:, 0], stamp_s, side="right")) - 1
        return max(stamp_s, float(self.sessions_s[row, 1])) if row >= 0 else stamp_s


def live(
    objects: list[SceneObject], config: BuildingConfig, placer: Placer, timeline: Timeline, seed: np.random.SeedSequence
) -> tuple[list[SceneObject], list[Stay]]:
    """Simulate the history of a building from its objects on day 0.

    Every object draws from its own random stream, so its history does not depend on how many others there are.

    Returns:
        All objects (newcomers after those of day 0, with the next ids) and all stays, by object, then by time.
    """
    arrival_seed, history_seed = seed.spawn(2)
    newcomers = _arrivals(objects, config, placer, timeline, np.random.default_rng(arrival_seed))
    everyone = objects + [item for item, _ in newcomers]
    arrival_s = dict.fromkeys((item.object_id for item in objects), timeline.start_s)
    arrival_s |= {item.object_id: stamp_s for item, stamp_s in newcomers}
    floor = [item for item in everyone if item.kind.mount != "wall"]
    done: list[tuple[SceneObject, Stay]] = []
    stays: list[Stay] = []
    for item, child in zip(everyone, history_seed.spawn(len(everyone)), strict=True):
        rng = np.random.default_rng(child)
        if item.kind.stay is None or config.change_rate == 0.0:
            history = [Stay(item.object_id, arrival_s[item.object_id], math.inf, item.home)]
        elif item.kind.mount == "hinge":
            history = _swing(item, config.change_rate, timeline, rng)
        else:
            homes = [(other, other.home) for other in floor if other is not item]
            history = _roam(item, arrival_s[item.object_id], config.change_rate, placer, timeline, rng, homes, done)
        if item.kind.mount == "floor":
            done += [(item, stay) for stay in history]
        stays += history
    return everyone, stays


def _arrivals(
    objects: list[SceneObject], config: BuildingConfig, placer: Placer, timeline: Timeline, rng: np.random.Generator
) -> list[tuple[SceneObject, float]]:
    """Newcomers with their arrival stamps, in order of arrival."""
    span_s = timeline.end_s - timeline.start_s
    due: list[tuple[float, int]] = []
    for row, kind in enumerate(config.classes):
        count = int(rng.poisson(kind.arrivals_per_day * config.change_rate * span_s / DAY_S))
        due += [(timeline.start_s + float(share) * span_s, row) for share in rng.random(count)]
    taken = Circles()
    for item in objects:
        if item.kind.mount != "wall":
            taken.add(item.home, item.radius_m)
    rooms = list(range(len(placer.plan.rooms)))
    next_landmark = sum(len(item.landmark_ids) for item in objects)
    newcomers: list[tuple[SceneObject, float]] = []
    for stamp_s, row in sorted(due):
        kind = config.classes[row]
        pose = placer.anywhere(kind, rooms, taken, rng)
        if pose is None:
            continue  # a full building takes no more
        offset = attach_landmarks(kind, rng)
        ids = tuple(range(next_landmark, next_landmark + len(offset)))
        next_landmark += len(offset)
        item = SceneObject(len(objects) + len(newcomers), kind, row, ids, offset, pose)
        taken.add(pose, item.radius_m)
        newcomers.append((item, timeline.defer(stamp_s)))
    return newcomers


def _swing(item: SceneObject, rate: float, timeline: Timeline, rng: np.random.Generator) -> list[Stay]:
    """A door: alternates between its two positions for ever, closed or open at first."""
    assert item.kind.stay is not None
    x, y, closed = item.home
    poses: tuple[Pose, Pose] = (item.home, (x, y, float(se2.wrap(closed + item.open_turn_rad))))
    is_open = False
    start_s = timeline.start_s
    history: list[Stay] = []
    while start_s < timeline.end_s:
        end_s = timeline.defer(start_s + item.kind.stay.sample_s(rng) / rate)
        history.append(Stay(item.object_id, start_s, end_s, poses[is_open], is_open))
        start_s, is_open = end_s, not is_open
    return history


def _roam(
    item: SceneObject,
    arrival_s: float,
    rate: float,
    placer: Placer,
    timeline: Timeline,
    rng: np.random.Generator,
    homes: list[tuple[SceneObject, Pose]],
    done: list[tuple[SceneObject, Stay]],
) -> list[Stay]:
    """An object on the floor: stays, is moved, vanishes, returns."""
    kind = item.kind
    assert kind.stay is not None
    start_s, pose = arrival_s, item.home
    history: list[Stay] = []
    while start_s < timeline.end_s:
        end_s = timeline.defer(start_s + kind.stay.sample_s(rng) / rate)
        history.append(Stay(item.object_id, start_s, end_s, pose))
        if rng.random() < kind.p_vanish:
            if rng.random() >= kind.p_return:
                break
            start_s = timeline.defer(end_s + kind.absence.sample_s(rng))
            if rng.random() >= kind.p_same_place:
                pose = _new_place(item, pose, start_s, placer, rng, homes, done, p_nudge=0.0)
        else:
            start_s = end_s
            pose = _new_place(item, pose, start_s, placer, rng, homes, done, p_nudge=kind.p_nudge)
    return history


def _new_place(
    item: SceneObject,
    pose: Pose,
    stamp_s: float,
    placer: Placer,
    rng: np.random.Generator,
    homes: list[tuple[SceneObject, Pose]],
    done: list[tuple[SceneObject, Stay]],
    *,
    p_nudge: float,
) -> Pose:
    """Another pose for an object, free of what stands there from `stamp_s` on."""
    kind, rooms = item.kind, list(range(len(placer.plan.rooms)))
    occupied = Circles()  # homes stay reserved: their owners may return
    for other, place in [*homes, *((other, stay.pose) for other, stay in done if stay.end_s > stamp_s)]:
        occupied.add(place, other.radius_m)
    room = placer.plan.room_of(np.array(pose[:2]))
    u = rng.random()
    for taken in (occupied, Circles()):  # a crowded building stacks things
        if u < p_nudge:
            found = placer.nearby(kind, pose, taken, rng)
        elif u < p_nudge + kind.p_other_room and len(rooms) > 1:
            found = placer.anywhere(kind, [row for row in rooms if row != room], taken, rng)
        else:
            found = placer.anywhere(kind, [room], taken, rng)
        found = found or placer.anywhere(kind, rooms, taken, rng)
        if found is not None:
            return found
    return pose


def events_of(objects: Sequence[SceneObject], stays: Sequence[Stay], timeline: Timeline) -> tuple[ChangeEvent, ...]:
    """Return all changes between the start and the end of the timeline, in order of time."""
    events: list[ChangeEvent] = []

    def add(stamp_s: float, item: SceneObject, kind: EventKind, before: Stay | None, after: Stay | None) -> None:
        if not timeline.start_s < stamp_s < timeline.end_s:
            return
        shift = 0.0
        if before is not None and after is not None:
            gap = item.landmarks_at(after.pose) - item.landmarks_at(before.pose)
            shift = float(np.linalg.norm(gap, axis=1).max())
        events.append(
            ChangeEvent(
                stamp_s, item.object_id, item.landmark_ids, item.kind.name, kind, shift,
                None if before is None or kind is EventKind.RETURNED else before.pose,
                None if after is None else after.pose,
            )
        )  # fmt: skip

    by_object: dict[int, list[Stay]] = {}
    for stay in stays:
        by_object.setdefault(stay.object_id, []).append(stay)
    for item in objects:
        previous: Stay | None = None
        for stay in by_object.get(item.object_id, []):
            if previous is None:
                add(stay.start_s, item, EventKind.APPEARED, None, stay)
            elif previous.end_s < stay.start_s:
                add(previous.end_s, item, EventKind.VANISHED, previous, None)
                add(stay.start_s, item, EventKind.RETURNED, previous, stay)
            elif item.kind.mount == "hinge":
                add(stay.start_s, item, EventKind.OPENED if stay.is_open else EventKind.CLOSED, previous, stay)
            elif stay.pose != previous.pose:
                add(stay.start_s, item, EventKind.MOVED, previous, stay)
            previous = stay
        if previous is not None:
            add(previous.end_s, item, EventKind.VANISHED, previous, None)
    return tuple(sorted(events, key=lambda event: (event.stamp_s, event.object_id)))
