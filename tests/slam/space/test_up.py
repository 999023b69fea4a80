"""Where up is: right within its uncertainty for what moves on a floor, and unknown for all that does not tell it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evermap import read_recording, run_session, run_slam
from evermap.config import Config, UpConfig, with_overrides
from evermap.geometry import se3
from evermap.geometry.upright import move_map
from evermap.metrics.summary import compare_with_truth
from evermap.slam.space.up import Movement, decide_up, plane_axis, turn_axis
from evermap.types import UNKNOWN, Measurements, SlamResult, SpatialOdometry, SpatialRecording, Up

from .halls import hall
from .rigs import AHEAD, Rig

COUNT, STEP_S = 600, 0.125


def wander(random: np.random.Generator, sigma: float, lasts_s: float, columns: int) -> np.ndarray:
    """(N, columns) of a first-order process: errors that last."""
    keep = np.exp(-STEP_S / lasts_s)
    found = [random.normal(0.0, sigma, columns)]
    for _ in range(COUNT - 1):
        found.append(keep * found[-1] + np.sqrt(1.0 - keep**2) * sigma * random.normal(size=columns))
    return np.array(found)


class World:
    """Something that moves, in a map with axes anywhere, on a floor that is level to 3 %.

    Attributes:
        up, normal: (3,) in the map, of gravity and of the floor.
        stamp_s: (N,); pose: (N, 7) of the robot in the map, x ahead, z up.
        level: the same poses over a level floor.
    """

    def __init__(self, seed: int, kind: str) -> None:
        self.random = random = np.random.default_rng(seed)
        at, body = getattr(self, f"_{kind}")()
        axes = Rotation.random(rng=seed)
        floor = axes * Rotation.from_rotvec(np.append(random.normal(0.0, 0.03, 2), 0.0))
        self.up, self.normal = axes.apply([0.0, 0.0, 1.0]), floor.apply([0.0, 0.0, 1.0])
        self.stamp_s = STEP_S * np.arange(COUNT)
        self.pose = np.column_stack([floor.apply(at), (floor * body).as_quat()])
        self.level = np.column_stack([at, body.as_quat()])

    def _walk(self) -> tuple[np.ndarray, Rotation]:
        t, (a, b, c, d) = STEP_S * np.arange(COUNT), self.random.uniform(0.0, 6.28, 4)
        x = 4.0 * np.sin(0.2 * t + a) + 2.0 * np.sin(0.33 * t + b)
        y = 3.0 * np.sin(0.17 * t + c) + 2.0 * np.sin(0.41 * t + d)
        heading = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
        height, sway = wander(self.random, 0.06, 1.5, 1), wander(self.random, 0.08, 1.5, 2)
        return np.column_stack([x, y, height]), Rotation.from_euler("ZYX", np.column_stack([heading, sway]))

    def _wheels(self) -> tuple[np.ndarray, Rotation]:
        at, body = self._walk()
        heading = body.as_euler("ZYX")[:, 0]
        return at * [0.05, 0.05, 0.0], Rotation.from_euler("Z", heading[:, None])

    def _wave(self) -> tuple[np.ndarray, Rotation]:
        return wander(self.random, 0.25, 1.5, 3) * [1.0, 1.0, 0.3], Rotation.from_rotvec(
            wander(self.random, 0.5, 1.0, 3)
        )

    def _line(self) -> tuple[np.ndarray, Rotation]:
        across, height = wander(self.random, 0.03, 3.0, 1), wander(self.random, 0.005, 1.0, 1)
        body = np.column_stack([wander(self.random, 0.02, 2.0, 1), wander(self.random, 0.01, 1.0, 2)])
        return np.column_stack([0.5 * STEP_S * np.arange(COUNT), across, height]), Rotation.from_euler("ZYX", body)

    def _facade(self) -> tuple[np.ndarray, Rotation]:
        at = wander(self.random, 6.0, 8.0, 3) * [1.0, 0.03, 0.8]
        return at, Rotation.from_euler("ZYX", wander(self.random, 0.1, 2.0, 3))

    def _volume(self) -> tuple[np.ndarray, Rotation]:
        return wander(self.random, 5.0, 8.0, 3) * [1.0, 1.0, 0.6], Rotation.from_euler(
            "ZYX", wander(self.random, 0.2, 2.0, 3)
        )

    def _stand(self) -> tuple[np.ndarray, Rotation]:
        return wander(self.random, 0.002, 1.0, 3), Rotation.from_rotvec(wander(self.random, 0.002, 1.0, 3))

    def _ramp(self) -> tuple[np.ndarray, Rotation]:
        """There and back between two halls, one of them 2 m higher, over 20 m of ramp."""
        at, body = self._walk()
        higher = np.sin(0.08 * STEP_S * np.arange(COUNT)) > 0.0
        return at + np.outer(higher, [20.0, 0.0, 2.0]), body

    def movement(
        self, mount: Rotation | None = None, tags_up: np.ndarray | None = None, *, is_camera: bool = False
    ) -> Movement:
        """As a sensor has it that looks along x with z up, mounted on the robot."""
        pose = self.pose.copy()
        if mount is not None:
            pose[:, 3:] = (Rotation.from_quat(pose[:, 3:]) * mount).as_quat()
        upright = se3.rotation_of(pose)[:, :, 2].mean(axis=0)
        tags_up = np.zeros((0, 3)) if tags_up is None else tags_up
        return Movement(self.stamp_s, pose, upright, tags_up, is_camera)

    def odometry(self, *, z_up: bool = True, offset: Rotation | None = None) -> SpatialOdometry:
        """Exact, over the level floor, in a frame that is `offset`."""
        pose = self.level if offset is None else se3.compose(np.append(np.zeros(3), offset.as_quat()), self.level)
        return SpatialOdometry(self.stamp_s, pose, np.full((COUNT, 6), np.nan), z_up=z_up)

    def gravity(self, sigma: float, *, bias: float = 0.0) -> Measurements:
        """Specific forces that sway with the walk."""
        read = se3.rotation_of(self.pose).transpose(0, 2, 1) @ self.up * 9.81
        read = read + wander(self.random, 9.81 * sigma, 0.5, 3) + 9.81 * bias * self.random.normal(size=3)
        names = ("ax_mps2", "ay_mps2", "az_mps2")
        return Measurements("gravity", self.stamp_s, dict(zip(names, read.T, strict=True)), np.full(COUNT, UNKNOWN))


def angle(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other))


def nees(found: list[tuple[Up, np.ndarray]]) -> float:
    """Mean squared error of two tilts over their variance."""
    return float(np.mean([(angle(up.direction, true) / up.sigma_rad) ** 2 / 2.0 for up, true in found]))


def test_what_is_carried_on_a_floor_tells_up_within_its_uncertainty() -> None:
    worlds = [World(seed, "walk") for seed in range(40)]
    found = [(decide_up(world.movement())[0], world.up) for world in worlds]
    assert all(up.is_known and up.source == "plane of motion" for up, _ in found)
    assert 0.6 < nees(found) < 1.6
    axes = [(plane_axis(world.pose[:, :3]), turn_axis(world.pose), world.normal) for world in worlds]
    for each in range(2):
        signed = [
            (Up(np.sign(axis[each].direction @ normal) * axis[each].direction, axis[each].sigma_rad), normal)
            for axis in axes
            for normal in axis[2:]
        ]
        assert 0.5 < nees(signed) < 2.0  # of the floor itself, without its slope


def test_an_accelerometer_and_a_level_odometry_tell_it_better() -> None:
    by_imu, by_tf = [], []
    for seed in range(20):
        world = World(seed, "walk")
        by_imu.append((decide_up(world.movement(), None, (world.gravity(0.2, bias=0.01),))[0], world.up))
        by_tf.append((decide_up(world.movement(), world.odometry())[0], world.up))
    assert all(up.source.startswith("imu") for up, _ in by_imu)
    assert all(up.source.startswith("tf") for up, _ in by_tf)
    assert 0.4 < nees(by_imu) < 1.8
    assert 0.4 < nees(by_tf) < 1.8
    assert np.median([up.sigma_rad for up, _ in by_imu]) < 0.02  # the floor's slope is 0.03


@pytest.mark.parametrize("kind", ["wave", "line", "facade", "volume", "stand"])
def test_what_tells_nothing_leaves_it_unknown(kind: str) -> None:
    for seed in range(10):
        assert not decide_up(World(seed, kind).movement())[0].is_known


@pytest.mark.parametrize("kind", ["wave", "line", "facade", "volume", "stand"])
def test_an_accelerometer_tells_it_however_the_robot_moves(kind: str) -> None:
    for seed in range(10):
        world = World(seed, kind)
        up, remarks = decide_up(world.movement(), None, (world.gravity(0.05),))
        assert up.is_known
        assert angle(up.direction, world.up) < 4.0 * up.sigma_rad
        assert not remarks


def test_wheels_tell_it_by_their_turns_alone() -> None:
    """In half a metre, where no plane of motion shows; and in an odometry whose axes are those of a camera."""
    found = []
    for seed in range(20):
        world = World(seed, "wheels")
        assert not np.isfinite(plane_axis(world.pose[:, :3]).sigma_rad)
        up, _ = decide_up(world.movement(), world.odometry(z_up=False, offset=AHEAD))
        assert up.source == "odometry"
        found.append((up, world.up))
    assert 0.4 < nees(found) < 1.8


def test_a_ramp_between_two_halls_is_within_the_uncertainty() -> None:
    for seed in range(10):
        world = World(seed, "ramp")
        up, _ = decide_up(world.movement())
        assert not up.is_known or angle(up.direction, world.up) < 3.0 * up.sigma_rad


def test_a_camera_may_be_upside_down() -> None:
    """Of one alone only the axis is known; tags that hang upright tell the sign, unless they contradict it."""
    world = World(0, "walk")
    over = Rotation.from_euler("x", np.pi)
    upright = np.tile(world.up, (12, 1))
    up, (remark,) = decide_up(world.movement(is_camera=True))
    assert not up.is_known
    assert "or its opposite" in remark
    assert decide_up(world.movement(None, upright, is_camera=True))[0].is_known
    assert not decide_up(world.movement(over, upright, is_camera=True))[0].is_known
    assert not decide_up(world.movement(over, upright))[0].is_known
    read = world.gravity(0.05)
    turned = {name: sign * column for sign, (name, column) in zip((1, -1, -1), read.columns.items(), strict=True)}
    told, _ = decide_up(world.movement(over, upright, is_camera=True), None, (replace(read, columns=turned),))
    assert angle(told.direction, world.up) < 0.1  # what was measured decides


def test_an_odometry_in_the_frame_of_a_camera_is_no_tf() -> None:
    """Its z is ahead; the sensors say so."""
    world = World(0, "line")
    assert not decide_up(world.movement(), world.odometry(offset=AHEAD.inv()))[0].is_known


def test_sources_that_contradict_each_other_are_told() -> None:
    world = World(0, "walk")
    leaning = replace(world.odometry(), pose_world_robot=se3.compose(se3.exp([0, 0, 0, 0.6, 0, 0]), world.level))
    up, remarks = decide_up(world.movement(), leaning, (world.gravity(0.05),))
    assert angle(up.direction, world.up) < 0.05
    assert any("up by tf is 3" in remark and "off that by imu" in remark for remark in remarks)


def test_what_is_stated_is_believed() -> None:
    up, _ = decide_up(World(0, "walk").movement(), None, (), UpConfig(direction=(0.0, -2.0, 0.0)))
    np.testing.assert_array_equal(up.direction, [0.0, -1.0, 0.0])
    assert up.source == "stated"


def on_robot(recording: SpatialRecording, mount: Rotation) -> SpatialRecording:
    """The same camera on a robot with x ahead and z up, where it is mounted so."""
    pose = np.append(np.zeros(3), mount.as_quat())
    truth = se3.compose(recording.truth.pose_world_robot, se3.inverse(pose))
    sensors = (replace(recording.sensors[0], mount_robot_sensor=tuple(pose.tolist())),)
    return replace(recording, sensors=sensors, truth=replace(recording.truth, pose_world_robot=truth))


def true_up(recording: SpatialRecording, result: SlamResult) -> np.ndarray:
    """(3,) in the map, by the alignment of its poses with the true ones, of which z is up."""
    pose = compare_with_truth(recording, result).poses.pose_truth_estimate
    return se3.rotation_of(pose).T @ [0.0, 0.0, 1.0]


@pytest.mark.slow
def test_a_rig_says_where_up_is_in_its_map() -> None:
    """From detections to the map, which is in the frame of the first pose."""
    recording = on_robot(Rig(0, seconds=30.0, turns=2, gaps=1).walk(), AHEAD)
    result = run_slam(recording)
    up, true = result.landmarks.up, true_up(recording, result)
    assert up.is_known
    assert up.source == "plane of motion"
    assert angle(up.direction, true) < 3.0 * up.sigma_rad


def test_a_camera_alone_says_that_it_is_no_robot() -> None:
    """Of its map, with z ahead, a mask for Nav2 would be a vertical section."""
    recording = Rig(0, seconds=30.0, turns=2, gaps=1).walk()
    result = run_slam(recording)
    assert not result.landmarks.up.is_known
    remark = next(one for one in result.warnings if one.startswith("up is along"))
    axis = np.array([float(part) for part in remark[remark.index("(") + 1 : remark.index(")")].split(",")])
    assert abs(axis @ true_up(recording, result)) > np.cos(0.1)


def test_a_setting_states_it() -> None:
    config = with_overrides(Config(), ["slam.space.up.direction=[0,-1,0]"])
    assert run_slam(Rig(1, seconds=15.0, turns=1, gaps=0).walk(), config).landmarks.up.source == "stated"


def test_a_map_keeps_it_over_sessions() -> None:
    first = on_robot(Rig(3, seconds=30.0, turns=2, gaps=1).walk(), AHEAD)
    mapped = run_session(first)
    known = mapped.living.up
    assert known.is_known
    assert mapped.slam.landmarks.up is known
    after = run_session(replace(first, name="again", frames=replace(first.frames, stamp_s=first.frames.stamp_s + 1e4),
                                truth=None), mapped.living)  # fmt: skip
    assert after.found
    assert angle(after.living.up.direction, known.direction) < known.sigma_rad
    assert after.living.up.sigma_rad <= known.sigma_rad
    assert after.living.up.sigma_rad >= 0.03  # the slope of the floor is the same in both


def test_a_drive_with_gravity_has_z_up() -> None:
    recording = hall(3, n_points=40, n_frames=200, drift=0.05)
    stamp_s = recording.frames.stamp_s
    read = se3.rotation_of(recording.truth.pose_world_robot)[:, 2] * 9.81
    columns = dict(zip(("ax_mps2", "ay_mps2", "az_mps2"), read.T, strict=True))
    table = Measurements("gravity", stamp_s, columns, np.full(len(stamp_s), UNKNOWN))
    up = run_slam(replace(recording, measurements=(table,))).landmarks.up
    assert up.source.startswith("imu")
    assert angle(up.direction, np.array([0.0, 0.0, 1.0])) < 2.0 * up.sigma_rad


@pytest.mark.slow
@pytest.mark.data
def test_the_hall_of_tags_is_level(shared_data: Path) -> None:
    recording = read_recording(shared_data / "tagslam" / "test_13")
    result = run_slam(recording)
    up = result.landmarks.up
    assert up.is_known
    assert angle(up.direction, true_up(recording, result)) < 3.0 * up.sigma_rad


@pytest.mark.slow
@pytest.mark.data
def test_a_camera_around_objects_on_a_table_leaves_up_unknown(shared_data: Path) -> None:
    assert not run_slam(read_recording(shared_data / "ycbv" / "0014")).landmarks.up.is_known


def test_gravity_bends_no_map_whose_z_is_not_up() -> None:
    """A map that is 2 degrees off level, from a drive without an accelerometer; the next drive has one."""

    recording = hall(3, n_points=40, n_frames=200, drift=0.05)
    read = se3.rotation_of(recording.truth.pose_world_robot)[:, 2] * 9.81
    columns = dict(zip(("ax_mps2", "ay_mps2", "az_mps2"), read.T, strict=True))
    table = Measurements("gravity", recording.frames.stamp_s, columns, np.full(len(read), UNKNOWN))
    leans = se3.exp(np.array([0.0, 0.0, 0.0, 0.035, 0.0, 0.0]))
    tilted = move_map(recording.true_landmarks.as_prior(0.01), leans)
    plain, measured = (
        run_slam(recording, prior_map=tilted),
        run_slam(replace(recording, measurements=(table,)), prior_map=tilted),
    )
    assert any("'gravity' left out in the map" in line for line in measured.warnings)
    np.testing.assert_array_equal(measured.trajectory.pose_world_robot, plain.trajectory.pose_world_robot)
    level = replace(recording.true_landmarks.as_prior(0.01), up=Up(np.array([0.0, 0.0, 1.0]), 0.01, "stated"))
    used = run_slam(replace(recording, measurements=(table,)), prior_map=level)
    assert not any("left out in the map" in line for line in used.warnings)
