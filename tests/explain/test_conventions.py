"""Other conventions of poses, corners and maps: named by the readings, or by the shape of the map, and no changes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evermap import check_recording, run_slam
from evermap.errors import DataError
from evermap.explain.seeds import find_mount
from evermap.explain.shape import compare_shapes, find_mirrored_part
from evermap.io.spatial import with_tag_poses
from evermap.metrics.trajectory import evaluate_trajectory
from evermap.slam.check import find_corner_mistake, is_clockwise, read_corners
from evermap.slam.mistake_search import find_motion
from evermap.slam.mistakes import Mistake
from evermap.slam.orientations import find_convention
from evermap.slam.pairs import USUAL, read_drive
from evermap.types import FloatArray, Landmarks, Recording, SensorKind, SpatialRecording, VerdictKind
from evermap_studies.causes.catalogue import catalogue
from evermap_studies.causes.drives import as_recording
from evermap_studies.causes.judge import make_case

from .worlds import World

WIDTH, HEIGHT = 1280, 800


def w_first(quaternion: FloatArray) -> FloatArray:
    """As written in the order w, x, y, z."""
    return quaternion[..., [3, 0, 1, 2]]


def inverse(pose: FloatArray) -> FloatArray:
    """By matrices: the world in the frame of what the pose is of."""
    turn = Rotation.from_quat(pose[:, 3:]).inv()
    return np.column_stack([-turn.apply(pose[:, :3]), turn.as_quat()])


def with_odometry(recording: SpatialRecording, pose: FloatArray) -> SpatialRecording:
    assert recording.odometry is not None
    return replace(recording, odometry=replace(recording.odometry, pose_world_robot=pose))


def with_sightings(recording: SpatialRecording, pose: FloatArray) -> SpatialRecording:
    seen = replace(recording.detections, position_sensor_m=pose[:, :3], rotation=pose[:, 3:])
    return replace(recording, detections=seen)


def with_corners(recording: SpatialRecording, corner_px: FloatArray) -> SpatialRecording:
    return replace(recording, detections=replace(recording.detections, corner_px=corner_px))


@pytest.fixture(scope="module")
def corners() -> SpatialRecording:
    return World(seed=11, seconds=40.0).space()


@pytest.fixture(scope="module")
def poses() -> SpatialRecording:
    return World(seed=11, seconds=40.0).space(corners=False)


CORNERS = {
    "exchanged": ("exchanged", lambda px: px[..., ::-1]),
    "upwards": ("upwards", lambda px: px * [1.0, -1.0] + [0.0, HEIGHT]),
    "leftwards": ("mirrored", lambda px: px * [-1.0, 1.0] + [WIDTH, 0.0]),
}


@pytest.mark.parametrize("how", CORNERS)
def test_corners_that_are_written_in_another_way_are_named(how: str, corners: SpatialRecording) -> None:
    word, write = CORNERS[how]
    wrong = with_corners(corners, write(corners.detections.corner_px))
    assert find_corner_mistake(wrong) == how
    (found,) = [finding for finding in check_recording(wrong).findings if finding.code == "corner-order"]
    assert word in found.message
    assert not found.usable


def test_corners_are_read_anew_where_a_reader_filled_in_poses_from_them(corners: SpatialRecording) -> None:
    _, write = CORNERS["upwards"]
    wrong = with_corners(corners, write(corners.detections.corner_px))
    right, filled = (
        replace(each, detections=with_tag_poses(each.detections, each.sensors, [])) for each in (corners, wrong)
    )
    assert find_corner_mistake(filled) == "upwards"
    assert find_corner_mistake(right) == ""
    read = read_corners(filled, "upwards").detections
    assert read.position_sensor_m == pytest.approx(right.detections.position_sensor_m, abs=1e-9)
    assert read.rotation == pytest.approx(right.detections.rotation, abs=1e-9)


def test_corners_all_listed_clockwise_are_no_mistake_by_themselves(corners: SpatialRecording) -> None:
    wrong = with_corners(corners, corners.detections.corner_px[:, ::-1])
    assert is_clockwise(wrong).all()
    assert find_corner_mistake(wrong) == ""


def test_corners_as_they_should_be_are_no_mistake(corners: SpatialRecording) -> None:
    assert find_corner_mistake(corners) == ""
    few = corners.detections.corner_px.copy()
    few[::8] = few[::8, ::-1]  # an eighth is misread, as of reflections
    assert find_corner_mistake(with_corners(corners, few)) == ""


@pytest.mark.parametrize("convention", ["w first", "inverse"])
def test_poses_of_detections_in_another_convention_are_named(convention: str, poses: SpatialRecording) -> None:
    seen = poses.detections
    pose = np.column_stack([seen.position_sensor_m, seen.rotation])
    pose = inverse(pose) if convention == "inverse" else np.column_stack([pose[:, :3], w_first(pose[:, 3:])])
    wrong = with_sightings(poses, pose)
    assert find_convention(wrong, USUAL) == convention
    assert find_convention(poses, USUAL) == ""


def test_rough_orientations_are_no_convention(poses: SpatialRecording) -> None:
    rng = np.random.default_rng(0)
    rough = Rotation.from_quat(poses.detections.rotation) * Rotation.from_rotvec(
        rng.normal(0.0, 0.35, (len(poses.detections), 3))
    )
    wrong = replace(poses, detections=replace(poses.detections, rotation=rough.as_quat()))
    assert find_convention(wrong, USUAL) == ""


@pytest.mark.parametrize("kind", ["corners", "poses"])
@pytest.mark.parametrize(("convention", "word"), [("w first", "w, x, y, z"), ("inverse", "of the world")])
def test_poses_of_the_odometry_in_another_convention_are_named(
    kind: str, convention: str, word: str, corners: SpatialRecording, poses: SpatialRecording
) -> None:
    recording = corners if kind == "corners" else poses
    assert recording.odometry is not None
    pose = recording.odometry.pose_world_robot
    pose = inverse(pose) if convention == "inverse" else np.column_stack([pose[:, :3], w_first(pose[:, 3:])])
    (found,) = [one for one in check_recording(with_odometry(recording, pose)).findings if not one.usable]
    assert (found.code, word in found.message) == ("odometry-poses", True)


@dataclass(frozen=True)
class Sideways(World):
    """A robot that turns as it likes, whichever way it drives; what it reports of its motion is written otherwise.

    Attributes:
        signs: factors on the speeds ahead, to the left, and on turns.
        exchanged: whether the first two are exchanged after that.
        slips: true way to the left over that ahead, of which the odometry says nothing.
    """

    signs: tuple[float, float, float] = (1.0, 1.0, 1.0)
    exchanged: bool = False
    slips: float = 0.0

    def path(self, stamp_s: FloatArray) -> FloatArray:
        pose = super().path(stamp_s)
        return pose + np.column_stack([0.0 * pose[:, :2], np.sin(2.0 * np.pi * stamp_s / 9.0)])

    def driven(self, random: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        stamp_s, velocity = super().driven(random)
        velocity[:, 1] -= self.slips * velocity[:, 0]
        velocity = velocity * self.signs
        return stamp_s, velocity[:, [1, 0, 2]] if self.exchanged else velocity


DRIVES: dict[str, tuple[dict[str, Any], str, str]] = {
    "lateral": ({"signs": (1.0, -1.0, 1.0)}, "odometry-axes", "lateral"),
    "exchanged": ({"exchanged": True}, "odometry-axes", "exchanged"),
    "forward": ({"signs": (-1.0, 1.0, 1.0)}, "forward-sign", "forward speeds"),
    "turns": ({"signs": (1.0, 1.0, -1.0)}, "turn-sign", "counter-clockwise"),
}


@pytest.mark.parametrize("kind", ["plane", pytest.param("corners", marks=pytest.mark.slow), "poses"])
@pytest.mark.parametrize("how", DRIVES)
def test_signs_and_axes_of_an_odometry_are_named(how: str, kind: str) -> None:
    written, code, word = DRIVES[how]
    world = Sideways(seed=4, **written)
    recording = world.plane() if kind == "plane" else world.space(corners=kind == "corners")
    (found,) = find_motion(recording, USUAL)
    assert (found.code, word in found.message, found.usable) == (code, True, False)


def test_a_mirrored_odometry_is_named() -> None:
    (found,) = find_motion(Sideways(seed=4, signs=(1.0, -1.0, -1.0)).space(corners=False), USUAL)
    assert found.code == "odometry-mirrored"


def test_a_sensor_that_looks_back_is_named_where_the_robot_drives_sideways() -> None:
    (found,) = find_motion(Sideways(seed=4, signs=(-1.0, -1.0, 1.0)).plane(), USUAL)
    assert (found.code, "looks backwards" in found.message) == ("forward-sign", True)


@pytest.mark.parametrize("world", [World(seed=4), Sideways(seed=4), Sideways(seed=4, slips=0.1), World(drift=0.05)])
def test_a_drive_as_it_is_has_no_wrong_axes(world: World) -> None:
    """Neither have one whose wheels slip to the side, nor one of a poor odometry."""
    assert find_motion(world.plane(), USUAL) == find_motion(world.space(corners=False), USUAL) == []


@pytest.mark.slow
@pytest.mark.parametrize("how", ["lateral", "exchanged"])
def test_a_drive_with_other_axes_is_solved_and_moves_nothing(how: str) -> None:
    written, code, word = DRIVES[how]
    result = run_slam(
        Sideways(seed=4, seconds=40.0, **written).space(corners=False), prior_map=World().map_in_space().as_prior(0.01)
    )
    assert result.verdict is not None
    assert result.verdict.kind is VerdictKind.SENSOR_SUSPECT
    (cause,) = result.causes
    assert (cause.code, word in cause.message) == (code, True)
    assert result.changes == ()


def map_faults(survey: Landmarks) -> dict[str, Landmarks]:
    """What is wrong with a map, each by itself."""
    at, rotation = survey.position_m, survey.rotation
    assert rotation is not None
    turn = Rotation.from_quat(rotation)
    mirrored = np.array([1.0, -1.0, 1.0])
    return {
        "w first": replace(survey, rotation=w_first(rotation)),
        "tags turned": replace(survey, rotation=(turn * Rotation.from_euler("z", 90, degrees=True)).as_quat()),
        "x out of the tag": replace(survey, rotation=(turn * Rotation.from_euler("y", 90, degrees=True)).as_quat()),
        "mirrored": replace(survey, position_m=at * mirrored),
        "millimetres": replace(survey, position_m=at * 1000.0),
        "feet": replace(survey, position_m=at / 0.3048),
    }


def test_shapes_agree_in_any_frame_and_with_few_changes() -> None:
    world = World(seed=1)
    survey = world.map_in_space()
    turn = Rotation.from_euler("xyz", [0.3, -0.2, 2.0])
    assert survey.rotation is not None
    elsewhere = replace(
        survey,
        position_m=turn.apply(survey.position_m) + [5.0, -3.0, 1.0],
        rotation=(turn * Rotation.from_quat(survey.rotation)).as_quat(),
    )
    assert compare_shapes(survey, elsewhere).share == 1.0
    moved = elsewhere.position_m.copy()
    moved[:4] += [1.0, 0.5, 0.0]
    found = compare_shapes(survey, replace(elsewhere, position_m=moved))
    assert found.placed == pytest.approx(12 / 16)


@pytest.mark.parametrize("fault", map_faults(World().map_in_space()))
def test_a_fault_of_a_map_shows_in_its_shape(fault: str) -> None:
    survey = World().map_in_space()
    found = compare_shapes(survey, map_faults(survey)[fault])
    turned = fault in ("w first", "tags turned", "x out of the tag")
    assert (found.placed == 1.0) == turned
    assert found.share < 0.75


NAMED = {
    "w first": ("map-axes", "w, x, y, z"),
    "tags turned": ("map-axes", "-y, x, z"),
    "x out of the tag": ("map-axes", "z, y, -x"),
    "mirrored": ("map-mirrored", "mirrored"),
    "millimetres": ("map-unit", "millimetres"),
    "feet": ("map-unit", "feet"),
}


@pytest.mark.parametrize("kind", ["corners", "poses"])
@pytest.mark.parametrize("fault", NAMED)
@pytest.mark.slow
def test_a_fault_of_a_map_is_named_and_moves_nothing(
    fault: str, kind: str, corners: SpatialRecording, poses: SpatialRecording
) -> None:
    recording = corners if kind == "corners" else poses
    result = run_slam(recording, prior_map=map_faults(World().map_in_space())[fault].as_prior(0.01))
    code, word = NAMED[fault]
    (cause,) = result.causes
    same = kind == "corners" and fault == "tags turned"  # as if corners were listed from another one on
    assert (cause.code, cause.subject) == (("corner-order", "tags") if same else (code, "map"))
    assert word in cause.message
    assert result.changes == ()


@pytest.mark.slow
def test_another_edition_is_no_fault_and_half_of_it_moved_is(corners: SpatialRecording) -> None:
    survey = World().map_in_space()
    assert survey.rotation is not None
    turn = Rotation.from_euler("z", 40, degrees=True)
    shifted = replace(
        survey,
        position_m=turn.apply(survey.position_m) + [30.0, -7.0, 0.0],
        rotation=(turn * Rotation.from_quat(survey.rotation)).as_quat(),
    )
    result = run_slam(corners, prior_map=shifted.as_prior(0.01))
    assert (result.causes, result.changes) == ((), ())


@pytest.mark.slow
def test_corners_in_the_order_of_opencv_are_put_right(corners: SpatialRecording) -> None:
    wrong = with_corners(corners, corners.detections.corner_px[:, ::-1])
    result = run_slam(wrong, prior_map=World().map_in_space().as_prior(0.01))
    (cause,) = result.causes
    assert (cause.code, cause.fix) == ("corner-order", "detections.csv: corners in the order 3, 2, 1, 0")
    assert result.changes == ()


@pytest.mark.parametrize("order", [(1, 0, 3, 2), (1, 2, 3, 0)])
@pytest.mark.slow
def test_corners_from_another_one_on_are_named_beside_a_map(order: tuple[int, ...], corners: SpatialRecording) -> None:
    wrong = with_corners(corners, corners.detections.corner_px[:, list(order)])
    result = run_slam(wrong, prior_map=World().map_in_space().as_prior(0.01))
    (cause,) = result.causes
    back = ", ".join(str(order.index(corner)) for corner in range(4))
    assert (cause.code, cause.fix) == ("corner-order", f"detections.csv: corners in the order {back}")
    assert result.changes == ()
    assert result.verdict is not None
    assert result.verdict.kind is VerdictKind.SENSOR_SUSPECT


def test_clockwise_corners_are_named_where_no_map_has_them_so(corners: SpatialRecording) -> None:
    wrong = with_corners(corners, corners.detections.corner_px[:, [1, 0, 3, 2]])
    result = run_slam(wrong)
    (cause,) = result.causes
    assert cause.code == "corner-order"
    assert result.verdict is not None
    assert (result.verdict.kind, result.verdict.causes) == (VerdictKind.SENSOR_SUSPECT, (cause,))
    again = run_slam(wrong, prior_map=result.landmarks.as_prior(0.01))
    assert again.causes == ()
    assert again.verdict is not None
    assert again.verdict.kind is VerdictKind.SOUND


def with_ranges_alone(recording: Recording, factor: float = 1.0) -> Recording:
    """As of radios, in another unit."""
    seen = recording.detections
    blind = replace(seen, bearing_rad=np.full(len(seen), np.nan), range_m=factor * seen.range_m)
    limit_m = recording.sensor.range_max_m * max(factor, 1.0)
    return replace(
        recording,
        detections=blind,
        sensor=replace(recording.sensor, kind=SensorKind.UWB, range_max_m=limit_m),
    )


@pytest.mark.parametrize(
    ("factor", "word"), [(1000.0, "millimetres"), (100.0, "centimetres"), (39.37, "inches"), (3.281, "feet")]
)
def test_ranges_alone_in_another_unit_are_named(factor: float, word: str) -> None:
    wrong = with_ranges_alone(World(seed=2).plane(), factor)
    (found,) = find_motion(wrong, USUAL)
    assert (found.code, word in found.message, found.usable) == ("length-unit", True, False)


def test_ranges_alone_in_centimetres_locate_nothing_and_the_line_says_why() -> None:
    with pytest.raises(DataError, match="centimetres"):
        run_slam(with_ranges_alone(World(seed=2).plane(), 100.0))


def test_ranges_alone_as_they_should_be_are_in_metres() -> None:
    """Also those of a robot whose wheels turn half as far, that stands, or one of whose beacons is carried about."""
    right = with_ranges_alone(World(seed=2).plane())
    slow = with_ranges_alone(World(seed=2, wheels=1.6).plane())
    driven, seen = right.odometry, right.detections
    stands = replace(right, odometry=replace(driven, forward_mps=0.0 * driven.forward_mps))
    noisy = seen.range_m + np.where(seen.landmark_id == 3, 30.0 * np.sin(right.frames.stamp_s[seen.frame]), 0.0)
    carried = replace(right, detections=replace(seen, range_m=np.abs(noisy)))
    for recording in (right, slow, stands, carried):
        assert find_motion(recording, USUAL) == []


@pytest.mark.parametrize("axis", [0, 1])
def test_a_coordinate_of_positions_with_the_wrong_sign_is_named(axis: int, poses: SpatialRecording) -> None:
    seen = poses.detections
    position = seen.position_sensor_m.copy()
    position[:, axis] *= -1.0
    wrong = with_sightings(poses, np.column_stack([position, seen.rotation]))
    (found,) = find_motion(wrong, USUAL)
    assert (found.code, found.message[0]) == ("detection-axes", "xy"[axis])


def mounted(recording: SpatialRecording, mount: FloatArray) -> SpatialRecording:
    """With the mounts (S, 7) stated."""
    sensors = [
        replace(one, mount_robot_sensor=tuple(by.tolist())) for one, by in zip(recording.sensors, mount, strict=True)
    ]
    return replace(recording, sensors=tuple(sensors))


def tilted(mount: FloatArray) -> FloatArray:
    """By angles: cameras that look 10 degrees down instead of up."""
    optical = Rotation.from_euler("ZYX", [-np.pi / 2, 0.0, -np.pi / 2])
    body = (Rotation.from_quat(mount[:, 3:]) * optical.inv()).as_euler("ZYX")
    return np.column_stack([mount[:, :3], (Rotation.from_euler("ZYX", body * [1.0, -1.0, 1.0]) * optical).as_quat()])


MISTAKES = {
    "tilted": (tilted, 1.0, "mount-flip", "pitch"),
    "exchanged": (lambda mount: mount[::-1], 1.0, "mount", "exchanged"),
    "inverted": (inverse, 1.0, "mount-flip", "inversely"),
    "millimetres": (lambda mount: mount, 1000.0, "length-unit", "millimetres"),
}


@pytest.mark.slow
@pytest.mark.parametrize("how", MISTAKES)
def test_a_mistake_of_all_sensors_is_named(how: str, poses: SpatialRecording) -> None:
    state, factor, code, word = MISTAKES[how]
    seen = poses.detections
    # the second camera's frame is turned: two that look in opposite directions are as well exchanged as turned
    by = Rotation.from_rotvec(np.where(seen.sensor == 1, 0.5, 0.0)[:, None] * [0.0, 1.0, 0.0])
    pose = [by.inv().apply(factor * seen.position_sensor_m), (by.inv() * Rotation.from_quat(seen.rotation)).as_quat()]
    mount = np.array([one.mount_robot_sensor for one in poses.sensors])
    mount[1, 3:] = (Rotation.from_quat(mount[1, 3:]) * Rotation.from_rotvec([0.0, 0.5, 0.0])).as_quat()
    given = with_sightings(mounted(poses, state(mount)), np.column_stack(pose))
    result = run_slam(given)
    assert result.verdict is not None
    assert result.verdict.kind is VerdictKind.SENSOR_SUSPECT
    (cause,) = result.causes
    assert (cause.code, word in cause.message, cause.probability > 0.9) == (code, True, True)
    assert result.changes == ()


def test_orientations_of_level_cameras_in_another_order_are_named() -> None:
    """Tags with y up, before cameras that look a little up, turn by little where their quaternions are misread."""
    tilted = World(seed=11).space(corners=False)
    for noise_rad in (0.0, 0.04):
        rough = Rotation.from_rotvec(
            np.random.default_rng(1).normal(0.0, noise_rad, (len(tilted.detections), 3))
        ) * Rotation.from_euler("z", np.pi)
        rotation = (Rotation.from_quat(tilted.detections.rotation) * rough).as_quat()
        pose = np.column_stack([tilted.detections.position_sensor_m, rotation])
        first = np.column_stack([pose[:, :3], w_first(rotation)])
        assert find_convention(with_sightings(tilted, first), USUAL) == "w first"
        back = inverse(pose)
        only_turned = np.column_stack([pose[:, :3], back[:, 3:]])
        assert find_convention(with_sightings(tilted, back), USUAL) == "inverse"
        assert find_convention(with_sightings(tilted, only_turned), USUAL) == ""  # where they are says otherwise
        assert find_convention(with_sightings(tilted, pose), USUAL) == ""


@pytest.mark.parametrize("pitch", [-0.2, 0.2])
def test_cameras_that_are_tilted_otherwise_have_no_other_convention(pitch: float, poses: SpatialRecording) -> None:
    tilt = Rotation.from_euler("y", pitch)
    mount = np.array([one.mount_robot_sensor for one in poses.sensors])
    turned = (tilt * Rotation.from_quat(mount[:, 3:])).as_quat()
    assert find_convention(mounted(poses, np.column_stack([mount[:, :3], turned])), USUAL) == ""


def with_sensor_at(recording: Recording, x_m: float) -> Recording:
    sensor = recording.sensor
    _, y_m, theta_rad = sensor.mount_robot_sensor
    return replace(recording, sensor=replace(sensor, mount_robot_sensor=(x_m, y_m, theta_rad)))


@pytest.mark.parametrize("off_m", [-0.5, 1.0])
def test_a_sensor_that_sits_elsewhere_is_no_slip(off_m: float) -> None:
    recording = World(seed=5).plane()
    result = run_slam(with_sensor_at(recording, recording.sensor.mount_robot_sensor[0] + off_m))
    assert result.verdict is not None
    assert result.verdict.kind is VerdictKind.SENSOR_SUSPECT
    (cause,) = result.causes
    assert (cause.code, cause.subject) == ("mount", "sensor x_m")
    assert cause.value == pytest.approx(-off_m, abs=0.05)


@pytest.mark.parametrize("world", [World(seed=5), World(seed=5, drift=0.04), Sideways(seed=5), World(wheels=1.1)])
def test_a_sensor_that_sits_where_it_is_stated_stays(world: World) -> None:
    assert np.abs(find_mount(world.plane(), USUAL)[0]) < 0.1


@pytest.mark.parametrize("in_map", [pytest.param(False, marks=pytest.mark.slow), True])
def test_forward_speeds_of_the_wrong_sign_are_named_by_ranges_alone(in_map: bool) -> None:
    world = World(seed=6, seconds=40.0)
    recording, given = with_ranges_alone(with_sensor_at(world.plane(), 0.2)), world.map_in_plane() if in_map else None
    driven = recording.odometry
    wrong = replace(recording, odometry=replace(driven, forward_mps=-driven.forward_mps))
    (cause,) = run_slam(wrong, prior_map=given).causes
    assert (cause.code, cause.subject) == ("forward-sign", "forward_mps")
    assert run_slam(recording, prior_map=given).causes == ()


WAYS = [Mistake("", "", lateral=-1.0, forward=3.6), Mistake("", "", exchanged=True, turn=-1.0)]


@pytest.mark.parametrize("first", WAYS)
@pytest.mark.parametrize("then", WAYS)
def test_two_mistakes_of_a_drive_are_undone_one_after_the_other(first: Mistake, then: Mistake) -> None:
    odometry = World(seconds=4.0).space(corners=False).odometry
    assert odometry is not None
    pose = odometry.pose_world_robot
    one_by_one = read_drive(read_drive(pose, *first.drive), *then.drive)
    at_once = read_drive(pose, *then.after(first).drive)
    np.testing.assert_allclose(at_once[:, :3], one_by_one[:, :3], atol=1e-9)
    turns = [Rotation.from_quat(each[:, 3:]).as_matrix() for each in (at_once, one_by_one)]
    np.testing.assert_allclose(*turns, atol=1e-9)


def in_survey(position_m: FloatArray) -> Landmarks:
    """The map of World with other places."""
    return Landmarks.at(np.arange(len(position_m)), position_m, sigma_m=0.01, frame="prior_map")


def clockwise(recording: Recording) -> Recording:
    """Bearings and turns, where y is to the right."""
    seen, driven = recording.detections, recording.odometry
    driven = replace(driven, angular_radps=-driven.angular_radps, lateral_mps=-driven.lateral_mps)
    return replace(recording, detections=replace(seen, bearing_rad=-seen.bearing_rad), odometry=driven)


def test_of_a_mirrored_map_and_clockwise_readings_one_is_wrong_and_nothing_says_which() -> None:
    recording = World(seed=4, seconds=20.0).plane()
    place = World().place[:, :2]
    for one, other in (
        (recording, in_survey(place * [1.0, -1.0])),
        (clockwise(recording), in_survey(place)),
    ):
        result = run_slam(one, prior_map=other)  # the sensor sits on the axis of the robot
        (cause,) = result.causes
        assert cause.code in ("map-mirrored", "bearing-sign")
        assert cause.probability == pytest.approx(0.5, abs=0.05)
        assert result.verdict is not None
        assert not result.verdict.kind.is_trustworthy
        assert "clockwise, both" in result.verdict.message
        assert "the given map is mirrored" in result.verdict.message
        assert result.changes == ()


@pytest.mark.parametrize("wrong", ["forward speeds", pytest.param("units", marks=pytest.mark.slow)])
def test_a_mirrored_map_is_found_beside_another_mistake(wrong: str) -> None:
    """Whose shape of the session is wrong, too; and which of all readings and the map is mirrored stays open."""
    recording = World(seed=4, seconds=20.0).plane()
    driven, given = recording.odometry, in_survey(World().place[:, :2] * [1.0, -1.0])
    factor = -1.0 if wrong == "forward speeds" else 3.6
    driven = replace(driven, forward_mps=factor * driven.forward_mps)
    result = run_slam(replace(recording, odometry=driven), prior_map=given)
    first, second = result.causes
    assert first.code == ("forward-sign" if wrong == "forward speeds" else "length-unit")
    assert (first.probability > 0.99, second.code in ("map-mirrored", "bearing-sign")) == (True, True)
    assert second.probability == pytest.approx(0.5, abs=0.05)
    assert result.changes == ()


@pytest.mark.parametrize("share", [0.3, 0.5])
def test_a_part_of_a_map_that_is_mirrored_is_one_cause_and_no_moves(share: float) -> None:
    recording, place = World(seed=4, seconds=20.0).plane(), World().place[:, :2].copy()
    part = place[:, 0] > np.quantile(place[:, 0], 1.0 - share)
    place[part, 1] = 9.0 - place[part, 1]
    result = run_slam(recording, prior_map=in_survey(place))
    (cause,) = result.causes
    assert (cause.code, cause.subject, cause.probability > 0.99) == ("map-mirrored", "map: a part", True)
    moved = np.flatnonzero(part & (np.abs(2.0 * place[:, 1] - 9.0) > 0.1))
    assert cause.message.endswith(": landmarks " + ", ".join(map(str, moved)))
    assert result.changes == ()
    assert result.verdict is not None
    assert result.verdict.kind is VerdictKind.MAP_OUTDATED
    assert recording.truth is not None
    found = evaluate_trajectory(result.trajectory, recording.truth, align=False)
    assert found is not None
    assert found.rmse_m < 0.02


def test_a_mirrored_part_is_where_it_is_in_the_frame_of_the_map() -> None:
    true, random = World().place, np.random.default_rng(3)
    for dim in (2, 3):
        at = true[:, :dim] + random.normal(0.0, 0.002, (16, dim))
        part = at[:, 0] > 6.5
        turned = Rotation.from_euler("z", 1.1).as_matrix()[:dim, :dim]
        found = Landmarks.at(np.arange(16), at @ turned.T + 2.0) if dim == 2 else Landmarks.in_space(
            np.arange(16), at @ turned.T + 2.0
        )  # fmt: skip
        given = at.copy()
        given[part, 1] = 9.0 - given[part, 1]
        mapped = replace(found, position_m=given)
        found_part = find_mirrored_part(found, mapped)
        assert found_part is not None
        names, position_m = found_part
        np.testing.assert_array_equal(names, np.flatnonzero(part))
        np.testing.assert_allclose(position_m, at[part], atol=1e-6)
        assert find_mirrored_part(found, replace(found, position_m=at)) is None
        given[part] = at[part] + [3.0, 1.0, 0.0][:dim]  # moved together
        assert find_mirrored_part(found, replace(found, position_m=given)) is None
        given[part] = random.permutation(at[part]) + random.normal(0.0, 1.0, at[part].shape)  # each by itself
        assert find_mirrored_part(found, replace(found, position_m=given)) is None
        given = at.copy()
        given[:3, 1] = 9.0 - given[:3, 1]  # three always fit a mirror
        assert find_mirrored_part(found, replace(found, position_m=given)) is None


@pytest.mark.parametrize(("wrong", "code"), [("sign of turning", "turn-sign"), ("map mirrored", "map-mirrored")])
def test_of_ranges_alone_the_side_of_the_sensor_tells_turns_from_a_mirrored_map(wrong: str, code: str) -> None:
    world = next(one for one in catalogue() if one.name == f"uwb in a map: {wrong}")
    given = make_case(replace(world, make=replace(world.make, duration_s=90.0)), 1).given
    assert given.sensors[0].mount_robot_sensor[1] == 0.05
    result = run_slam(as_recording(given), prior_map=given.places)
    (cause,) = result.causes
    assert (cause.code, cause.probability > 0.9) == (code, True)
    assert result.verdict is not None
    assert not result.verdict.kind.is_trustworthy


def test_a_radio_beside_the_axis_shows_the_sign_of_turns_without_a_map() -> None:
    world = next(one for one in catalogue() if one.name == "uwb alone: nothing wrong")
    recording = as_recording(make_case(replace(world, make=replace(world.make, duration_s=90.0)), 1).given)
    assert isinstance(recording, Recording)
    turned = replace(recording.odometry, angular_radps=-recording.odometry.angular_radps)
    right, wrong = run_slam(recording).verdict, run_slam(replace(recording, odometry=turned)).verdict
    assert right is not None
    assert wrong is not None
    assert (right.kind, wrong.kind) == (VerdictKind.SOUND, VerdictKind.WEAK)
    assert "mirrored" in [one.code for one in wrong.symptoms if one.is_alarming]
