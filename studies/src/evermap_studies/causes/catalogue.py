"""The worlds: each a robot, with or without a map, and one thing that is wrong; by groups."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from evermap.geometry import se3
from evermap_studies.causes import mistakes as wrong
from evermap_studies.causes.drives import MAKES, Drive, Event, Make
from evermap_studies.causes.mistakes import Mistake

GROUPS = ("table", "sound", "causes", "mistakes", "attacks")
MANY = 20
"""Seeds of what matters most."""
NEVER = -math.inf

Choice = Callable[[Drive, np.random.Generator], tuple[Event, ...]]
"""Which landmarks move, of a drive in which none does."""


@dataclass(frozen=True, slots=True)
class World:
    """A robot, and what is wrong.

    Attributes:
        name: unique.
        group: one of `GROUPS`.
        make: the robot.
        in_map: whether it has a map.
        cause: key of `answers.ANSWERS`.
        also: that of a second cause, which has to be named, too; '' where there is one.
        mistake: what is wrong; without moves the drive before it is the oracle's.
        events: landmarks that move.
        seeds: how many.
        values: of the cause, any of them; empty where it has none.
        within: how near, as a share, or `within_s` for delays.
        bound_m: error of poses at most, instead of 1.5 times the oracle's.
        quick: one of the few that stand for all.
    """

    name: str
    group: str
    make: Make
    in_map: bool
    cause: str
    mistake: Mistake = wrong.nothing
    events: Choice | None = None
    seeds: int = 1
    values: tuple[float, ...] = ()
    within: float = 0.05
    bound_m: float | None = None
    quick: bool = False
    also: str = ""


@dataclass(slots=True)
class _List:
    group: str
    worlds: list[World] = field(default_factory=list)

    def add(
        self,
        makes: str,
        label: str,
        cause: str,
        mistake: Mistake = wrong.nothing,
        events: Choice | None = None,
        maps: Sequence[bool] = (True, False),
        make: Mapping[str, Any] | None = None,
        quick: str = "",
        **rest: Any,
    ) -> None:
        """Add a world for each of the makes, with and without a map; `quick` are makes and a sign: 'laser+ poses-'."""
        for name in makes.split():
            robot = MAKES[name.replace("_", " ")]
            if make:
                robot = replace(robot, **make)
            for in_map in maps:
                full = f"{name.replace('_', ' ')} {'in a map' if in_map else 'alone'}: {label}"
                fast = f"{name}{'+' if in_map else '-'}" in quick.split()
                self.worlds.append(World(full, self.group, robot, in_map, cause, mistake, events, quick=fast, **rest))


def catalogue() -> tuple[World, ...]:
    """Return all worlds."""
    worlds = [*_table(), *_sound(), *_causes(), *_mistakes(), *_attacks()]
    names = [one.name for one in worlds]
    assert len(set(names)) == len(names), sorted({one for one in names if names.count(one) > 1})
    return tuple(worlds)


MAP, ALONE = (True,), (False,)


def _table() -> list[World]:
    """The situations that were measured in reports of users, and their bounds."""
    some = _List("table")
    for sigma, bound_m in ((0.03, 0.02), (0.1, 0.03), (0.3, 0.06)):
        for scale in (1.01, 1.02, 1.03):
            some.add(
                "poses", f"odometry {scale - 1:.0%} wrong, noise {sigma:g}", "noise",
                wrong.odometer(scale, scale), maps=MAP, seeds=10, bound_m=bound_m,
                make={
                    "odometry_hz": 50.0,
                    "frame_hz": 10.0,
                    "odometry_sigma": (sigma, sigma, sigma),
                    "range_max_m": 4.5,
                },
                quick="poses+" if (sigma, scale) in ((0.3, 1.01), (0.03, 1.01)) else "",
            )  # fmt: skip
    some.add(
        "corners",
        "tags printed in another size",
        "tag size",
        wrong.sized(1.083),
        seeds=MANY,
        values=(1.083, 1 / 1.083, 0.1651, 0.1651 * 1.083, 0.083),
        within=0.005,
        quick="corners+",
    )
    some.add(
        "corners poses",
        "camera 0.12 s late",
        "delay",
        wrong.late(0.12),
        seeds=MANY,
        values=(0.12, -0.12),
        within=0.01 / 0.12,
        quick="corners+ corners-",
    )
    some.add(
        "corners poses laser",
        "one moved at half time",
        "change",
        wrong.identities_stay,
        wrong.moves(1, 0.5),
        seeds=MANY,
        quick="corners+ laser+ poses-",
    )
    some.add(
        "uwb",
        "ranges 6.9 % long",
        "range scale",
        wrong.readings(1.069),
        seeds=MANY,
        values=(1.069, 1 / 1.069, 0.069),
        within=0.01,
        quick="uwb+ uwb-",
    )
    some.add(
        "laser corners uwb",
        "sign of turning",
        "turn sign",
        wrong.odometer(turn=-1.0),
        seeds=MANY,
        quick="laser- corners+",
    )
    some.add(
        "corners poses laser uwb",
        "map mirrored",
        "map mirror",
        wrong.map_mirrored(),
        maps=MAP,
        seeds=MANY,
        quick="corners+ laser+",
    )
    some.add(
        "corners poses",
        "axes of the camera forgotten",
        "axes",
        wrong.mounts(wrong.body_axes),
        seeds=MANY,
        quick="corners-",
    )
    some.add("visual", "fx and fy swapped", "lens", wrong.swapped_focal, seeds=MANY, quick="visual+")
    some.add(
        "corners",
        "lens without its distortion",
        "lens",
        wrong.lens(distortion=(), distortion_model="pinhole"),
        seeds=MANY,
        quick="corners+",
    )
    some.add(
        "corners poses",
        "another edition of the map",
        "change",
        wrong.map_edition(0.005, 0.073),
        maps=MAP,
        seeds=MANY,
        quick="corners+",
    )
    some.add(
        "corners poses laser", "map of a common shift", "", wrong.map_frame(0.05, -0.03, 0.0), maps=MAP, seeds=MANY
    )
    some.add("orchard", "trees without identities", "", seeds=MANY, bound_m=0.05, quick="orchard-")
    some.add("uwb", "the anchors are left behind", "", make={"site": "anchors behind", "range_max_m": 9.0}, seeds=MANY)
    some.add(
        "laser corners poses",
        "map without an identity in common",
        "other numbers",
        wrong.map_without_common_ids,
        maps=MAP,
        quick="corners+",
    )
    return some.worlds


def _sound() -> list[World]:
    """Nothing is wrong."""
    some = _List("sound")
    some.add(
        "laser uwb poses corners two_kinds visual stereo beacons",
        "nothing wrong",
        "",
        seeds=10,
        quick="laser+ laser- corners+ poses+ stereo- uwb-",
    )
    some.add("laser corners", "the robot stands", "", make={"speed_mps": 0.0, "sideways": False}, seeds=3)
    some.add("carried", "nothing wrong", "", seeds=10)
    some.add(
        "laser poses corners stereo",
        "map in another frame",
        "",
        wrong.map_frame(3.0, -8.0, 2.1),
        maps=MAP,
        seeds=5,
        quick="corners+",
    )
    some.add("laser", "errors that last two seconds", "", wrong.lasting_errors((0.03, 0.006), 2.0), seeds=5)
    some.add("corners", "errors that last two seconds", "", wrong.lasting_errors((0.3,) * 8, 2.0), seeds=5)
    some.add("laser poses corners", "odometry with much noise", "", wrong.noisier(0.2, 0.1), seeds=5)
    some.add("laser poses corners", "odometry that drifts", "", wrong.noisier(0.03, 0.01, 5.0), seeds=5)
    return some.worlds


def _causes() -> list[World]:
    """Every cause in the plane and in space, with a map and without."""
    some = _List("causes")
    some.add(
        "laser uwb poses corners stereo beacons",
        "one moved before",
        "change",
        wrong.identities_stay,
        wrong.moves(1),
        maps=MAP,
        seeds=MANY,
        quick="laser+ corners+",
    )
    some.add(
        "laser poses corners",
        "four moved before",
        "change",
        wrong.identities_stay,
        wrong.moves(4),
        maps=MAP,
        seeds=MANY,
    )
    some.add(
        "laser corners stereo",
        "one moved by 0.25 m before",
        "change",
        wrong.identities_stay,
        wrong.moves(1, shift_m=0.25),
        maps=MAP,
        seeds=5,
    )
    some.add(
        "poses corners",
        "two turned by 25 deg before",
        "change",
        wrong.identities_stay,
        wrong.moves(2, shift_m=0.0, turn_rad=0.44),
        maps=MAP,
        seeds=5,
    )
    some.add(
        "uwb stereo beacons visual",
        "one moved at half time",
        "change",
        wrong.identities_stay,
        wrong.moves(1, 0.5),
        seeds=5,
    )
    some.add("laser corners poses", "three moved at 0.4", "change", wrong.identities_stay, wrong.moves(3, 0.4), seeds=5)
    some.add(
        "laser corners poses stereo",
        "two vanished before",
        "change",
        wrong.identities_stay,
        wrong.vanishes(2),
        maps=MAP,
        seeds=5,
        quick="laser+",
    )
    some.add(
        "laser corners poses",
        "two exchanged before",
        "change",
        wrong.identities_stay,
        wrong.exchanges(),
        maps=MAP,
        seeds=MANY,
        quick="corners+",
    )
    some.add(
        "laser corners poses",
        "two exchanged at half time",
        "change",
        wrong.identities_stay,
        wrong.exchanges(0.5),
        seeds=5,
    )
    some.add("laser corners poses", "two carry one identity", "wrong identity", wrong.doubled, seeds=5)
    some.add(
        "laser corners poses", "5 % of identities misread", "misread", wrong.misread(0.05), seeds=5, quick="laser-"
    )
    some.add("laser corners", "3 % strangers", "misread", wrong.misread(0.03, strangers=True), seeds=5)
    for share in (0.05, 0.1, -0.1):
        some.add(
            "laser corners poses visual",
            f"odometer {share:+.0%}",
            "odometer scale",
            wrong.odometer(1.0 + share),
            seeds=3,
            values=(1.0 + share, 1.0 / (1.0 + share), share, -share),
            quick="laser+ corners-" if share == 0.1 else "",
        )
    some.add(
        "laser corners poses uwb",
        "turning +8 %",
        "turn scale",
        wrong.odometer(turn=1.08),
        seeds=3,
        values=(1.08, 1 / 1.08, 0.08),
        quick="laser-",
    )
    some.add(
        "laser corners poses uwb",
        "gyro biased by 0.02 rad/s",
        "odometry bias",
        wrong.odometer(bias=(0.0, 0.0, 0.02)),
        seeds=5,
        values=(0.02, -0.02),
    )
    some.add("laser", "ranges 5 % long", "range scale", wrong.readings(1.05), seeds=5, values=(1.05, 1 / 1.05, 0.05))
    some.add("poses", "positions 6 % far", "range scale", wrong.readings(1.06), seeds=5, values=(1.06, 1 / 1.06, 0.06))
    some.add("stereo", "baseline 6 % long", "range scale", wrong.baseline(1.06), seeds=5, values=(1.06, 1 / 1.06, 0.06))
    some.add("laser uwb", "ranges 0.3 m long", "range bias", wrong.readings(add_m=0.3), seeds=5, values=(0.3, -0.3))
    some.add(
        "uwb",
        "one anchor's ranges 0.4 m long",
        "range bias of one",
        wrong.bias_of_one(0.4),
        seeds=5,
        values=(0.4, -0.4),
        within=0.15,
    )
    some.add(
        "corners",
        "one tag of another size",
        "size of one",
        wrong.sized(1.3, "one"),
        seeds=5,
        quick="corners+",
        values=(1.3, 1 / 1.3, 0.1651, 0.1651 * 1.3),
        within=0.02,
    )
    some.add(
        "two_kinds",
        "one kind of another size",
        "size of a kind",
        wrong.sized(1.25, "kind"),
        seeds=5,
        quick="two_kinds-",
        values=(1.25, 1 / 1.25, 0.1651, 0.1651 * 1.25),
        within=0.02,
    )
    some.add(
        "laser uwb stereo visual",
        "sensor 0.2 s late",
        "delay",
        wrong.late(0.2),
        seeds=5,
        values=(0.2, -0.2),
        within=0.1,
    )
    some.add(
        "corners poses",
        "one of two cameras 0.15 s late",
        "delay",
        wrong.late(0.15, 1),
        seeds=5,
        values=(0.15, -0.15),
        within=0.1,
        quick="corners-",
    )
    some.add(
        "laser corners", "sensor 0.15 s early", "delay", wrong.late(-0.15), seeds=3, values=(0.15, -0.15), within=0.1
    )
    some.add(
        "laser corners poses",
        "mount yawed by 8 deg",
        "mount",
        wrong.mounted(yaw=0.14),
        seeds=5,
        values=(0.14, -0.14, 8.0, -8.0),
    )
    some.add(
        "laser corners poses",
        "mount 0.3 m off",
        "mount",
        wrong.mounted(x_m=0.3),
        seeds=5,
        values=(0.3, -0.3),
        within=0.1,
    )
    some.add("corners poses", "mounts pitched by 10 deg", "mount", wrong.mounted(pitch=0.17), seeds=5)
    some.add("corners", "focal length 5 % off", "lens", wrong.lens(intrinsics=(945.0, 945.0, 640.0, 400.0)), seeds=5)
    some.add(
        "laser corners poses uwb",
        "odometry jumps by 1 m",
        "jump",
        wrong.jumped(0.5, (0.9, 0.0, 0.6)),
        seeds=5,
        quick="laser+ corners-",
    )
    some.add("laser corners poses", "the robot is carried away", "jump", wrong.kidnapped(0.5, (1.5, 0.0, 0.8)), seeds=5)
    some.add("visual stereo corners", "odometry begins anew", "jump", wrong.restarted(0.5), seeds=5)
    some.add(
        "laser corners poses uwb",
        "odometry stands still for 8 s",
        "silence",
        wrong.silent(0.4, 8.0),
        seeds=5,
        quick="corners+",
    )
    some.add("laser corners", "odometry without rows for 8 s", "silence", wrong.silent(0.4, 8.0, rows=True), seeds=5)
    some.add(
        "laser uwb corners poses stereo",
        "map of another site",
        "map site",
        wrong.map_of_another_site,
        maps=MAP,
        seeds=MANY,
        quick="laser+",
    )
    some.add(
        "laser uwb corners poses stereo",
        "map 6 % too large",
        "map scale",
        wrong.map_scaled(1.06),
        maps=MAP,
        seeds=5,
        values=(1.06, 1 / 1.06, 0.06),
    )
    some.add("laser corners", "half of the map mirrored", "map part", wrong.map_mirrored(half=True), maps=MAP, seeds=5)
    return some.worlds


def _mistakes() -> list[World]:
    """Mistakes of units, axes, signs, mounts and clocks."""
    some = _List("mistakes")
    add = some.add
    degrees = 180.0 / math.pi
    for unit, factor in (("mm", 1e3), ("cm", 100.0), ("feet", 1 / 0.3048), ("inches", 1 / 0.0254)):
        add("laser", f"ranges in {unit}", "length unit", wrong.readings(factor), maps=ALONE)
        add("poses", f"positions in {unit}", "length unit", wrong.readings(factor), maps=ALONE)
    add("uwb", "ranges in cm", "length unit", wrong.readings(100.0), maps=ALONE)
    add("uwb", "ranges there and back", "length unit", wrong.readings(2.0))
    add("laser", "bearings in degrees", "angle unit", wrong.readings(sign=degrees), maps=ALONE)
    add("laser", "bearings clockwise", "bearing sign", wrong.readings(sign=-1.0))
    add("laser", "bearings from the left", "bearing axis", wrong.readings(turn_rad=math.pi / 2))
    add("laser", "bearings of a compass", "bearing axis", wrong.readings(sign=-1.0, turn_rad=math.pi / 2), maps=ALONE)
    add("laser", "sensor looks back", "forward sign", wrong.readings(turn_rad=math.pi))
    add("laser", "turn rates in degrees", "angle unit", wrong.odometer(turn=degrees), maps=ALONE)
    for unit, factor in (("km/h", 3.6), ("mm/s", 1e3), ("ft/s", 1 / 0.3048), ("mph", 2.23694)):
        add("laser", f"speeds in {unit}", "length unit", wrong.odometer(factor), maps=ALONE)
    add("uwb", "speeds in mm/s", "length unit", wrong.odometer(1e3), maps=ALONE)
    add(
        "laser corners uwb",
        "forward with the wrong sign",
        "forward sign",
        wrong.odometer(-1.0, lateral=1.0),
        maps=ALONE,
    )
    add("corners", "odometry in mm", "length unit", wrong.odometer(1e3), maps=ALONE)
    add("visual", "odometry in inches", "length unit", wrong.odometer(1 / 0.0254), maps=ALONE)
    add("corners poses", "lateral with the wrong sign", "odometry axes", wrong.odometer(lateral=-1.0))
    add("corners", "forward and lateral exchanged", "odometry axes", wrong.sideways)
    add(
        "visual",
        "odometry of the camera's axes",
        "odometry axes",
        wrong.odometry_poses(lambda pose: np.asarray(se3.compose(pose, se3.turn([-0.5, 0.5, -0.5, 0.5])))),
    )
    add(
        "visual",
        "odometry's quaternion scalar first",
        "odometry axes",
        wrong.odometry_poses(lambda pose: pose[:, [0, 1, 2, 6, 3, 4, 5]]),
    )
    add(
        "visual stereo",
        "odometry's poses inverted",
        "odometry axes",
        wrong.odometry_poses(lambda pose: np.asarray(se3.inverse(pose))),
    )
    for inch, factor in (
        ("with the white border", 10 / 8),
        ("with the quiet zone", 10 / 6),
        ("in inches", 1 / 0.0254),
        ("in mm", 1e3),
    ):
        add(
            "corners",
            f"size of tags {inch}",
            "tag size",
            wrong.sized(factor),
            maps=(True, False) if factor < 2 else ALONE,
            values=(factor, 1 / factor, 0.1651, 0.1651 * factor),
            within=0.005,
        )
    add("visual", "size of tags halved", "tag size", wrong.sized(0.5), values=(0.5, 2.0, 0.1651, 0.0826), within=0.01)
    add("corners", "calibration of another resolution", "resolution", wrong.half_image)
    add("corners", "k1 with the wrong sign", "lens", wrong.lens(distortion=(0.24, 0.06, 0.0004, -0.0003)))
    add(
        "corners",
        "a fisheye's model",
        "lens",
        wrong.lens(distortion_model="equidistant", distortion=(-0.24, 0.06, 0.0, 0.0)),
    )
    add("corners", "centre of the image off by 60 px", "lens", wrong.lens(intrinsics=(900.0, 900.0, 700.0, 400.0)))
    add("corners", "corners clockwise", "corner order", wrong.corner_order((1, 0, 3, 2)))
    add("corners", "corners from the upper left", "corner order", wrong.corner_order((2, 3, 0, 1)), maps=MAP)
    add("corners", "pixels from below", "corner order", wrong.upside_down, maps=ALONE)
    add("corners poses", "mounts of the two cameras exchanged", "mount", wrong.exchanged_cameras)
    add("corners", "pitch with the wrong sign", "mount", wrong.mounts(wrong.tilted_down))
    add("corners", "mounts inverted", "mount", wrong.mounts(lambda mount: np.asarray(se3.inverse(mount))))
    add("poses", "mounts inverted", "mount", wrong.mounts(lambda mount: np.asarray(se3.inverse(mount))), maps=ALONE)
    add("laser corners", "mount turned by 30 deg", "mount", wrong.mounted(yaw=math.pi / 6))
    add("corners", "mount turned by 90 deg", "mount", wrong.mounted(yaw=math.pi / 2), maps=ALONE)
    add("laser", "mount 1 m off", "mount", wrong.mounted(x_m=1.0), maps=ALONE)
    add("poses", "poses of the camera in the tags", "pose convention", wrong.inverted)
    add("poses", "quaternions scalar first", "pose convention", wrong.scalar_first)
    add("poses", "y of the camera up", "pose convention", wrong.mirrored_axis(1))
    add("poses", "axes of a robot, not of a camera", "axes", wrong.other_axes([0.5, -0.5, 0.5, 0.5]))
    add("stereo", "baseline in cm", "baseline", wrong.baseline(100.0), maps=ALONE)
    add("stereo", "baseline halved", "baseline", wrong.baseline(0.5))
    add("laser corners poses", "sensor's clock 3 s late", "clock", wrong.late(3.0), maps=ALONE, values=(3.0, -3.0))
    add("stereo visual", "sensor's clock 2 s early", "clock", wrong.late(-2.0), values=(2.0, -2.0), maps=ALONE)
    add("uwb", "sensor's clock 1.5 s late", "clock", wrong.late(1.5), values=(1.5, -1.5))
    add("corners", "map in inches", "map scale", wrong.map_scaled(1 / 0.0254), maps=MAP)
    add("laser", "map in mm", "map scale", wrong.map_scaled(1e3), maps=MAP)
    add("uwb", "map in feet", "map scale", wrong.map_scaled(1 / 0.3048), maps=MAP)
    add("laser", "map with x and y exchanged", "map axes", wrong.map_axes((1, 0)), maps=MAP)
    add("corners", "map with y up", "map axes", wrong.map_axes((0, 2, 1)), maps=MAP)
    add(
        "corners poses",
        "map of tags with x out of them",
        "map axes",
        wrong.map_turned_tags([0.5, 0.5, 0.5, 0.5]),
        maps=MAP,
    )
    return some.worlds


def _attacks() -> list[World]:
    """What is harsher: two causes at once, and what nobody thought of."""
    some = _List("attacks")
    add = some.add
    add(
        "corners",
        "late and of another size",
        "delay",
        wrong.both(wrong.late(0.15), wrong.sized(1.1)),
        seeds=3,
        also="tag size",
    )
    add(
        "corners laser",
        "late, and one moved before",
        "change",
        wrong.both(wrong.identities_stay, wrong.late(0.15)),
        wrong.moves(1),
        maps=MAP,
        seeds=3,
        also="delay",
    )
    add(
        "corners",
        "of another size, and two exchanged",
        "change",
        wrong.both(wrong.identities_stay, wrong.sized(1.08)),
        wrong.exchanges(),
        maps=MAP,
        seeds=3,
        also="tag size",
    )
    add(
        "laser",
        "odometer 10 % and ranges 5 % long",
        "odometer scale",
        wrong.both(wrong.odometer(1.1), wrong.readings(1.05)),
        seeds=3,
    )
    add(
        "laser corners poses",
        "half of the landmarks moved alike",
        "change",
        wrong.identities_stay,
        _half_moved,
        maps=MAP,
        seeds=3,
    )
    add("laser corners poses", "clock drifts by 0.5 %", "clock", wrong.late(0.0, drift=0.005), seeds=3)
    add("laser corners poses", "stamped on arrival", "clock", wrong.jittered(0.08), seeds=3)
    add("corners poses", "a tag on the robot itself", "wrong identity", wrong.on_robot(), seeds=3)
    add(
        "laser corners poses",
        "a landmark that is carried about",
        "carried",
        wrong.identities_stay,
        wrong.wandering(0.4),
        seeds=3,
    )
    add("laser corners", "one wheel slips by 5 %", "wheel", wrong.slips(0.05), seeds=3)
    add("laser corners poses", "sensor turned by 180 deg", "mount", wrong.mounted(yaw=math.pi), seeds=3)
    add("laser corners", "identities off by one", "other numbers", wrong.renumbered(1), maps=MAP, seeds=3)
    add("laser corners", "map in feet", "map scale", wrong.map_scaled(1 / 0.3048), maps=MAP, seeds=3)
    # in the plane this is a right map of bearings that are clockwise: one cause
    add(
        "laser",
        "sign of turning, in a mirrored map",
        "bearing sign",
        wrong.both(wrong.odometer(turn=-1.0), wrong.map_mirrored(1)),
        maps=MAP,
        seeds=3,
    )
    add(
        "corners poses",
        "sign of turning, in a mirrored map",
        "turn sign",
        wrong.both(wrong.odometer(turn=-1.0), wrong.map_mirrored(1)),
        maps=MAP,
        seeds=3,
        also="map mirror",
    )
    add(
        "laser",
        "bearings clockwise and turning, too",
        "bearing sign",
        wrong.both(wrong.readings(sign=-1.0), wrong.odometer(turn=-1.0)),
        seeds=3,
    )
    add("laser corners poses", "a third of identities misread", "misread", wrong.misread(0.33), seeds=3)
    add(
        "laser corners",
        "robot carried away in silence",
        "jump",
        wrong.both(wrong.silent(0.5, 5.0), wrong.kidnapped(0.5, (1.5, 0.0, 0.8))),
        seeds=3,
    )
    add("laser corners", "odometry without any motion", "anything", wrong.silent(0.0, 1e6), seeds=3)
    add("laser corners", "odometry of another drive", "anything", _of_another_drive, seeds=3)
    add(
        "laser corners poses",
        "map of a site in which one corner is this one",
        "map site",
        _mostly_another,
        maps=MAP,
        seeds=3,
    )
    return some.worlds


def _half_moved(drive: Drive, rng: np.random.Generator) -> tuple[Event, ...]:
    """Every second landmark is moved by the same displacement: who can tell which half stands?"""
    assert drive.site is not None
    shift, rows = np.array([0.6, 0.35, 0.0, 0.0, 0.0, 0.0, 0.0]), np.arange(0, len(drive.site.pose), 2)
    keep = rows[rng.random(len(rows)) < 0.8]
    return tuple(Event(int(row), NEVER, drive.site.pose[row] + shift) for row in keep)


def _of_another_drive(drive: Drive, rng: np.random.Generator) -> Drive:
    """The odometry's file is that of another day."""
    order = np.roll(np.arange(len(drive.twist)), int(rng.integers(200, 600)))
    return replace(drive, twist=drive.twist[order][::-1])


def _mostly_another(drive: Drive, rng: np.random.Generator) -> Drive:
    """Four landmarks of the map are right; all others stand anywhere."""
    assert drive.places is not None
    right = rng.choice(len(drive.places), 4, replace=False)
    given = wrong.map_of_another_site(drive, rng)
    assert given.places is not None
    position = given.places.position_m.copy()
    position[right] = drive.places.position_m[right]
    return replace(given, places=replace(given.places, position_m=position))
