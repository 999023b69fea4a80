"""The native format: what each column means, that writing and reading agree, and what is refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.linalg import expm

from evermap.errors import ConfigError, DataError, InputError
from evermap.geometry import se2
from evermap.io import read_native, read_recording, write_native
from evermap.io.native_write import LONGEST_S, write_session
from evermap.maps.store.measured import pack_recording, unpack_recording
from evermap.types import (
    Clock,
    Detections,
    Frames,
    Landmarks,
    Odometry,
    Recording,
    RobotSightings,
    Sensor,
    Trajectory,
    rows_of,
)
from evermap.valid import validate

Files = dict[str, str]
NOT_WRITTEN = frozenset({"source", "warnings", "source_line"})


def test_every_column_and_key_arrives(native: Files, lay_out: Callable, check_recording: Callable) -> None:
    recording = read_recording(lay_out(native))
    check_recording(recording)
    assert recording.warnings == ()
    assert recording.name == "hall"
    assert recording.clock is Clock.UNIX
    assert recording.class_names == ("door", "pillar")
    assert recording.sensor == Sensor(0.1, 8.0, -2.0, 2.0, 0.02, 0.01, 0.8, 0.002, (0.2, -0.05, 0.1))
    np.testing.assert_array_equal(recording.odometry.lateral_mps, np.full(40, 0.01))
    np.testing.assert_array_equal(recording.odometry.angular_radps[:4], [0.0, 0.02, 0.04, 0.0])
    assert recording.frames.complete
    np.testing.assert_array_equal(recording.frames.stamp_s, [0, 0.5, 1, 1.5, 2, 2.5])
    seen = recording.detections
    np.testing.assert_array_equal(seen.frame, [1, 1, 2, 4])
    np.testing.assert_array_equal(seen.landmark_id, [7, 8, -1, 7])
    np.testing.assert_array_equal(seen.class_id, [0, -1, 1, 0])
    np.testing.assert_array_equal(seen.sigma_range_m, [0.02, np.nan, np.nan, 0.03])
    np.testing.assert_array_equal(seen.sigma_bearing_rad, [0.01, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(seen.source_line, [3, 4, 5, 6])
    assert recording.truth is not None
    assert recording.truth.pose_world_robot[2, 2] == pytest.approx(7 - 2 * np.pi, abs=1e-15)
    assert recording.true_landmarks is not None
    np.testing.assert_array_equal(recording.true_landmarks.landmark_id, [7, 8])
    np.testing.assert_array_equal(recording.true_landmarks.covariance_m2[1], np.diag([0.01**2, 0.01**2]))
    np.testing.assert_array_equal(recording.true_landmarks.class_id, [0, -1])
    assert recording.robot_sightings is not None
    np.testing.assert_array_equal(recording.robot_sightings.robot_id, [2])


def test_two_files_are_enough(native: Files, lay_out: Callable, check_recording: Callable) -> None:
    recording = read_recording(
        lay_out({name: native[name] for name in ("odometry.csv", "detections.csv")}, zipped=True)
    )
    check_recording(recording)
    assert not recording.frames.complete
    np.testing.assert_array_equal(recording.frames.stamp_s, [0.5, 1.0, 2.0])
    assert recording.sensor == Sensor()
    assert recording.truth is None
    assert any("no sensor.toml" in remark for remark in recording.warnings)


LIKE = """stamp_s,landmark_id,range_m,bearing_rad,colour_g,radius_m,descriptor_1,descriptor_0,colour_r,mask_id
0.5,1,2,0.1,,0.25,-3,7,,12
1.0,2,2,0.2,0.5,,,1e3,,-1
"""


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_what_landmarks_are_like_arrives_and_is_written(
    form: Any, native: Files, lay_out: Callable, tmp_path: Path, assert_same: Callable
) -> None:
    native["detections.csv"] = LIKE
    recording = read_recording(lay_out(native))
    seen = recording.detections
    assert seen.feature_names == ("radius_m", "colour_g", "mask_id", "descriptor_0", "descriptor_1")  # nothing is red
    nan = np.nan
    np.testing.assert_array_equal(seen.features, [[0.25, nan, 12.0, 7.0, -3.0], [nan, 0.5, -1.0, 1e3, nan]])
    again = read_recording(write_native(recording, tmp_path / "again", format=form))
    assert_same(again.detections, seen, frozenset({"source_line"}))
    assert_same(unpack_recording(pack_recording(recording)).detections, seen)
    np.testing.assert_array_equal(rows_of(seen, [1]).features, seen.features[1:])


@pytest.mark.parametrize(
    ("cells", "field", "line"),
    [
        (("radius_m", "0.2", "-1"), "radius_m", 3),
        (("colour_b", "", "red"), "colour_b", 3),
        (("mask_id", "1", "1e16"), "mask_id", 3),
        (("descriptor_1", "1", "2"), "descriptor_0", 1),
        (("descriptor_x", "1", "2"), "descriptor_x", 1),
        (("radius", "1", "2"), "radius", 1),
    ],
)
def test_what_landmarks_cannot_be_like_is_refused(
    cells: tuple[str, str, str], field: str, line: int, native: Files, lay_out: Callable
) -> None:
    name, one, other = cells
    native["detections.csv"] = f"stamp_s,landmark_id,range_m,bearing_rad,{name}\n0.5,1,2,0.1,{one}\n1.0,2,2,0,{other}\n"
    with pytest.raises(InputError) as caught:
        read_recording(lay_out(native))
    assert (caught.value.path.name, caught.value.line, caught.value.field) == ("detections.csv", line, field)


def test_features_of_another_shape_are_refused(native: Files, lay_out: Callable) -> None:
    recording = read_recording(lay_out(native))
    features = np.zeros((len(recording.detections), 2))
    for names, values in ((("radius_m",), features), (("a", "b"), features + np.inf), (("a", "b"), None)):
        wrong = replace(recording.detections, features=values, feature_names=names)
        with pytest.raises(InputError, match=r"detections\.features"):
            validate(replace(recording, detections=wrong))


@pytest.mark.parametrize("with_frames", [True, False])
def test_stamps_closer_than_a_microsecond_are_one_frame(native: Files, lay_out: Callable, with_frames: bool) -> None:
    stamps = [0.5, 0.5000008, 0.5000016, 0.5000024, 1.0]
    rows = "".join(f"{stamp!r},{row},2.0,0.1\n" for row, stamp in enumerate(stamps))
    native["detections.csv"] = "stamp_s,landmark_id,range_m,bearing_rad\n" + rows
    native["frames.csv"] = "stamp_s\n0.2\n" + "".join(f"{stamp + 3e-7!r}\n" for stamp in stamps)
    if not with_frames:
        del native["frames.csv"]
    recording = read_recording(lay_out(native))
    assert len(recording.frames) == 2 + with_frames
    np.testing.assert_array_equal(recording.detections.frame - with_frames, [0, 0, 0, 0, 1])
    assert recording.frames.complete == with_frames


def test_cartesian_detections(native: Files, lay_out: Callable) -> None:
    native["detections.csv"] = "stamp_s,landmark_id,x_m,y_m,sigma_m\n0.5,1,3,4,0.1\n1.0,2,-1,0,\n1.5,3,0,-2,0.2\n"
    seen = read_recording(lay_out(native)).detections
    np.testing.assert_allclose(seen.range_m, [5, 1, 2])
    np.testing.assert_allclose(seen.bearing_rad, [np.arctan(4 / 3), np.pi, -np.pi / 2])
    # a round covariance of 0.1 m, seen from the sensor, by the Jacobian of (range, bearing) at (3, 4)
    jacobian = np.array([[3 / 5, 4 / 5], [-4 / 25, 3 / 25]])
    expected = np.sqrt(np.diag(jacobian @ (0.1**2 * np.eye(2)) @ jacobian.T))
    np.testing.assert_allclose([seen.sigma_range_m[0], seen.sigma_bearing_rad[0]], expected)
    assert np.isnan(seen.sigma_range_m[1])
    assert np.isnan(seen.sigma_bearing_rad[1])


def test_increments_become_the_twists_that_make_them(native: Files, lay_out: Callable) -> None:
    random = np.random.default_rng(3)
    stamp_s = np.cumsum(random.uniform(0.05, 0.4, 30))
    increments = random.normal(0.0, [0.1, 0.02, 0.5], (30, 3))
    rows = np.column_stack([stamp_s, increments]).tolist()
    native["odometry.csv"] = "stamp_s,dx_m,dy_m,dtheta_rad\n" + "".join(",".join(map(repr, row)) + "\n" for row in rows)
    recording = read_recording(lay_out(native))
    odometry = recording.odometry
    np.testing.assert_array_equal(odometry.stamp_s, stamp_s)
    for i in range(1, 30):
        v, w, turn = (getattr(odometry, name)[i - 1] for name in ("forward_mps", "lateral_mps", "angular_radps"))
        moved = expm((stamp_s[i] - stamp_s[i - 1]) * np.array([[0, -turn, v], [turn, 0, w], [0, 0, 0]]))
        np.testing.assert_allclose(moved[:2, 2], increments[i, :2], atol=1e-12)
        np.testing.assert_allclose(moved[:2, 0], [np.cos(increments[i, 2]), np.sin(increments[i, 2])], atol=1e-12)
    assert odometry.forward_mps[-1] == odometry.forward_mps[-2]
    assert any("the first increment is ignored" in remark for remark in recording.warnings)


def test_tables_as_pandas_and_spreadsheets_write_them(native: Files, lay_out: Callable, assert_same: Callable) -> None:
    plain = read_recording(lay_out(native))
    for name in native:
        if name.endswith(".csv"):
            native[name] = "\ufeff" + native[name].replace("\n", "\r\n").replace(",door", ',"door"')
    native["detections.csv"] = native["detections.csv"].replace("0.5,7,", "0.5,7.0,").replace(",8,", ", 8 ,")
    native["detections.csv"] = native["detections.csv"].replace("0.01\r\n", "0.01,\r\n")
    assert_same(plain, read_recording(lay_out(native)))


def test_parquet_of_other_types(native: Files, lay_out: Callable, tmp_path: Path) -> None:
    path = lay_out(native)
    (path / "detections.csv").unlink()
    table = {
        "stamp_s": pa.array([0.5, 1.0, 2.0], pa.float32()),
        "landmark_id": pa.array([7, None, 9], pa.int32()),
        "range_m": pa.array([1, 2, 3], pa.int64()),
        "bearing_rad": pa.array([0.1, 0.2, 0.3], pa.float64()),
        "class_id": pa.array(["door", None, "door"]).dictionary_encode(),
    }
    pq.write_table(pa.table(table), path / "detections.parquet")
    seen = read_recording(path).detections
    np.testing.assert_array_equal(seen.landmark_id, [7, -1, 9])
    np.testing.assert_array_equal(seen.range_m, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(seen.class_id, [0, -1, 0])


finite = {"allow_nan": False, "allow_infinity": False}
LABELS = st.text("abc ,\"#é_1\\'", min_size=1, max_size=6).map(str.strip).filter(bool)


@st.composite
def recordings(draw: st.DrawFn) -> Recording:
    """Recordings with any of the optional parts, awkward numbers and awkward names."""

    def column(count: int, low: float, high: float, **more: bool) -> np.ndarray:
        return draw(hnp.arrays(np.float64, count, elements=st.floats(low, high, **(finite | more))))

    def stamps(count: int) -> np.ndarray:
        steps = draw(hnp.arrays(np.float64, count, elements=st.floats(0.001, 0.5)))
        return start_s + np.cumsum(steps)

    clock = draw(st.sampled_from(list(Clock)))
    start_s = draw(st.sampled_from([0.0, -3.3, 1248444187.156]))
    odometry_count, frame_count, count = draw(st.integers(2, 8)), draw(st.integers(1, 6)), draw(st.integers(1, 8))
    names = tuple(draw(st.lists(LABELS, max_size=3, unique=True)))
    classes = st.integers(-1, len(names) - 1)
    sigma = hnp.arrays(np.float64, count, elements=st.one_of(st.just(np.nan), st.floats(1e-6, 10)))
    landmark_id = np.array(sorted(draw(st.sets(st.integers(0, 2**53), min_size=1, max_size=5))))
    factor = draw(
        hnp.arrays(np.float64, (len(landmark_id), 2, 2), elements=st.floats(-1, 1).map(lambda x: round(x, 3)))
    )
    optional = draw(st.lists(st.booleans(), min_size=3, max_size=3))
    truth = Trajectory(
        stamps(3),
        np.stack([column(3, -1e6, 1e6), column(3, -1e6, 1e6), column(3, -np.pi, np.pi)], axis=1),
        np.zeros((3, 3, 3)),
        "truth",
        clock,
    )
    landmarks = replace(
        Landmarks.at(landmark_id, np.stack([column(len(landmark_id), -1e6, 1e6)] * 2, axis=1), class_names=names),
        covariance_m2=np.matmul(factor, factor.transpose(0, 2, 1)),
        class_id=draw(hnp.arrays(np.int64, len(landmark_id), elements=classes)),
        clock=clock,
    )
    return Recording(
        name=draw(st.text(max_size=10).filter(str.isprintable)),
        robot=draw(st.text(max_size=10).filter(str.isprintable)),
        odometry=Odometry(
            stamps(odometry_count), *(column(odometry_count, -900, 900) for _ in range(3)), clock=clock
        ),
        frames=Frames(stamps(frame_count), complete=draw(st.booleans()), clock=clock),
        detections=Detections(
            frame=np.sort(draw(hnp.arrays(np.int64, count, elements=st.integers(0, frame_count - 1)))),
            landmark_id=draw(hnp.arrays(np.int64, count, elements=st.integers(-1, 50))),
            range_m=column(count, 1e-3, 1e5),
            bearing_rad=column(count, -np.pi, np.pi),
            class_id=draw(hnp.arrays(np.int64, count, elements=classes)),
            sigma_range_m=draw(sigma),
            sigma_bearing_rad=draw(sigma),
            source_line=np.zeros(count, dtype=np.int64),
        ),
        sensor=Sensor(
            range_min_m=draw(st.floats(0, 1)),
            range_max_m=draw(st.floats(2, np.inf)),
            bearing_min_rad=draw(st.floats(-np.pi, 0)),
            sigma_range_m=draw(st.one_of(st.none(), st.floats(1e-6, 1))),
            p_detect=draw(st.floats(0, 1)),
            mount_robot_sensor=(draw(st.floats(-2, 2)), 0.25, draw(st.floats(-3, 3))),
        ),
        truth=truth if optional[0] else None,
        true_landmarks=landmarks if optional[1] else None,
        robot_sightings=RobotSightings(np.array([1.5]), np.array([4]), np.array([2.0]), np.array([0.5]), clock)
        if optional[2]
        else None,
        class_names=names,
        clock=clock,
    )  # fmt: skip


@pytest.mark.parametrize("form", ["csv", "parquet"])
@settings(
    max_examples=settings.default.max_examples * 2 // 5, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(recording=recordings())
def test_what_is_written_reads_back_the_same(
    recording: Recording, form: str, tmp_path: Path, assert_same: Callable, check_recording: Callable
) -> None:
    shutil.rmtree(tmp_path / "out", ignore_errors=True)
    folder = write_native(recording, tmp_path / "out", form)  # type: ignore[arg-type]
    again = read_native(folder)
    check_recording(again)
    assert_same(replace(recording, name=recording.name or "out"), again, but=NOT_WRITTEN)


@pytest.mark.data
@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_a_real_recording_converts_without_loss(
    shared_data: Path, tmp_path: Path, form: str, assert_same: Callable
) -> None:
    recording = read_recording(shared_data / "mrclam" / "MRCLAM_Dataset3.zip", 2)
    write_native(recording, tmp_path / "out", form)  # type: ignore[arg-type]
    assert_same(recording, read_recording(tmp_path / "out"), but=NOT_WRITTEN)


def edit(name: str, old: str, new: str) -> Callable[[Files], None]:
    def apply(files: Files) -> None:
        assert old in files[name]
        files[name] = files[name].replace(old, new, 1)

    return apply


def edit_all(name: str, old: str, new: str) -> Callable[[Files], None]:
    """More than the few bad rows that are left out."""
    return lambda files: files.update({name: files[name].replace(old, new)})


def put(name: str, text: str) -> Callable[[Files], None]:
    return lambda files: files.update({name: text})


DET, ODO, TOML = "detections.csv", "odometry.csv", "sensor.toml"
BAD = {
    "missing odometry": (lambda files: files.pop(ODO), ["odometry.csv", "missing", ".parquet"]),
    "misspelt column": (
        edit(ODO, "forward_mps", "foward_mps"),
        [f"{ODO}:1", "'foward_mps'", "unknown column", "try: forward_mps"],
    ),
    "missing column": (
        put(DET, "stamp_s,landmark_id,bearing_rad\n0.5,1,0\n"),
        [f"{DET}:1", "'range_m'", "missing column"],
    ),
    "strange column": (put("frames.csv", "stamp_s,zzz\n0.5,1\n"), ["frames.csv:1", "'zzz'", "stamp_s"]),
    "column twice": (edit(ODO, "lateral_mps", "forward_mps"), [f"{ODO}:1", "'forward_mps'", "twice"]),
    "no header": (put("frames.csv", "0.0\n0.5\n"), ["frames.csv:1", "must name the columns"]),
    "semicolons": (put("frames.csv", "stamp_s;x\n0.0;1\n"), ["frames.csv:1", "commas"]),
    "mixed forms": (edit(ODO, "lateral_mps", "dx_m"), [f"{ODO}:1", "mixes forward_mps"]),
    "truncated line": (edit(DET, "0.5,8,3.5,0.3,,,", "0.5,8,3.5"), [f"{DET}:4", "3 cells instead of 7"]),
    "words": (edit(DET, "3.5", "far"), [f"{DET}:4", "'range_m'", "'far' is not a number"]),
    "empty cell": (edit(DET, "3.5", ""), [f"{DET}:4", "'range_m'", "is empty"]),
    "nan": (edit(DET, "3.5", "nan"), [f"{DET}:4", "'range_m'", "nan"]),
    "inf": (edit_all(ODO, ",0.5,", ",inf,"), [f"{ODO}:2", "'forward_mps'", "inf"]),
    "negative range": (edit(DET, "3.5", "-3.5"), [f"{DET}:4", "'range_m'", "-3.5"]),
    "no return": (edit(DET, "3.5", "0"), [f"{DET}:4", "'range_m'", "no return"]),
    "degrees": (edit(DET, "-0.3", "-17"), [f"{DET}:3", "'bearing_rad'", "radians"]),
    "fraction as id": (edit(DET, "0.5,7", "0.5,7.5"), [f"{DET}:3", "'landmark_id'", "7.5 is not a whole number"]),
    "bell as id": (edit(DET, "0.5,7", "0.5,door\a"), [f"{DET}:3", "'landmark_id'", "cannot be printed"]),
    "negative id": (edit(DET, "0.5,7", "0.5,-7"), [f"{DET}:3", "'landmark_id'", "-7"]),
    "zero sigma": (edit(DET, "0.02,0.01", "0,0.01"), [f"{DET}:3", "'sigma_range_m'", "greater than zero"]),
    "both sigmas": (edit(DET, "sigma_bearing_rad", "sigma_m"), [f"{DET}:2", "'sigma_m'", "both given"]),
    "time backwards": (edit_all(ODO, "\n1.", "\n0."), [f"{ODO}:12", "'stamp_s'", "backwards by 0.9 s"]),
    "detections backwards": (edit(DET, "\n2.0", "\n0.5"), [f"{DET}:6", "'stamp_s'", "backwards"]),
    "frames backwards": (edit("frames.csv", "1.5", "0.1"), ["frames.csv:5", "backwards"]),
    "detection without frame": (
        edit("frames.csv", "1.0\n", ""),
        [f"{DET}:5", "'stamp_s'", "1.0 and 0 more have no row in frames.csv"],
    ),
    "no frames": (put("frames.csv", "stamp_s\n"), [f"{DET}:3", "have no row in frames.csv"]),
    "quotation marks": (edit(DET, "door", '"door'), [f"{DET}:3", "quotation marks"]),
    "binary": (edit(ODO, "0.3,0.5", "\x00\x07"), [f"{ODO}:5", "not plain text"]),
    "empty file": (put(DET, ""), [DET, "is empty"]),
    "landmark twice": (
        edit("landmarks.csv", "8,3.3", "7,3.3"),
        ["landmarks.csv:3", "'landmark_id'", "7 is listed twice"],
    ),
    "bad toml": (edit(TOML, "range_min_m = 0.1", "range_min_m = "), [TOML, "not valid TOML", "line 6"]),
    "unknown section": (edit(TOML, "[mount]", "[mounting]"), [f"{TOML}:15", "'mounting'", "try: mount"]),
    "unknown key": (edit(TOML, "\nx_m =", "\nx ="), [f"{TOML}:16", "'mount.x'", "try: x_m"]),
    "wrong type": (
        edit(TOML, "range_max_m = 8", "range_max_m = '8'"),
        [f"{TOML}:7", "'limits.range_max_m'", "a number, not str"],
    ),
    "limits swapped": (edit(TOML, "range_max_m = 8", "range_max_m = 0.05"), [f"{TOML}:7", "greater than range_min_m"]),
    "toml degrees": (edit(TOML, "bearing_max_rad = 2.0", "bearing_max_rad = 120"), [f"{TOML}:9", "radians"]),
    "unknown kind": (
        edit(TOML, "[recording]\n", '[sensor]\nkind = "lazer"\n[recording]\n'),
        [f"{TOML}:2", "'sensor.kind'", "unknown kind of sensor 'lazer'", "laser"],
    ),
    "kind as a number": (
        edit(TOML, "[recording]\n", "[sensor]\nkind = 3\n[recording]\n"),
        [f"{TOML}:2", "'sensor.kind'", "unknown kind of sensor '3'"],
    ),
    "data sheet": (
        edit(TOML, "[recording]\n", "[odometry]\nsigma_odometer_scale = 5\n[recording]\n"),
        [f"{TOML}:2", "'odometry.sigma_odometer_scale'", "outside [0, 1]"],
    ),
    "unknown clock": (edit(TOML, '"unix"', '"gps"'), [f"{TOML}:3", "'recording.clock'", "unknown clock 'gps'"]),
    "newer version": (
        edit(TOML, "[recording]\n", "[recording]\nformat_version = 2\n"),
        [f"{TOML}:2", "2 is not the version"],
    ),
    "unlisted class": (
        edit(TOML, "[recording]\n", '[recording]\nclass_names = ["door"]\n'),
        [f"{DET}:5", "'class_id'", "'pillar'"],
    ),
    "two formats": (put("odometry.parquet", "x"), [ODO, "exists together with odometry.parquet"]),
    "truncated truth": (put("truth.csv", "stamp_s,x_m,y_m,theta_rad\n0,0,0\n1,1,1,1\n"), ["truth.csv:2", "3 cells"]),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_refused_with_file_line_and_field(case: str, native: Files, lay_out: Callable) -> None:
    spoil, words = BAD[case]
    spoil(native)
    with pytest.raises(InputError) as caught:
        read_recording(lay_out(native))
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message, message


NOTHING = {
    "no odometry": ("odometry.csv", "stamp_s,forward_mps,angular_radps\n", "no odometry"),
    "one increment": ("odometry.csv", "stamp_s,dx_m,dy_m,dtheta_rad\n0,0,0,0\n", "two rows"),
    "nothing seen": ("detections.csv", "stamp_s,landmark_id,range_m,bearing_rad\n", "no landmark was seen"),
    "another clock": (
        "odometry.csv", "stamp_s,forward_mps,angular_radps\n1248444187,0,0\n1248444197,0,0\n", "do not overlap",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", NOTHING)
def test_recordings_without_content_are_data_errors(case: str, native: Files, lay_out: Callable) -> None:
    name, content, words = NOTHING[case]
    native[name] = content
    with pytest.raises(DataError, match=words):
        read_recording(lay_out(native))


def test_survived_with_counted_warnings(native: Files, lay_out: Callable, check_recording: Callable) -> None:
    native["odometry.csv"] += "3.9,0.9,0,0\n30,0.5,0,0\n31,0"
    native["detections.csv"] += "2.0,7,2.0,-0.5,door,,\n2.5,7,2.0,0."
    native["frames.csv"] = native["frames.csv"].replace("1.5\n", "1.5\n1.5\n") + "90\n"
    native["truth.csv"] += "2,1,0.02,7\n"
    native["frame.csv"] = "stamp_s\n"
    recording = read_recording(lay_out(native))
    check_recording(recording)
    remarks = "\n".join(recording.warnings)
    assert "odometry.csv: 1 unfinished last line (44) left out" in remarks
    assert "detections.csv: 1 unfinished last line (8) left out" in remarks
    assert "odometry.csv: 1 row with the stamp of the next row left out" in remarks
    assert "truth.csv: 1 row with the stamp of the next row left out" in remarks
    assert "frames.csv: 1 row with the stamp of the row before left out" in remarks
    assert "odometry has 1 gap over 10 s: 26.1 s from 3.9 s after its start" in remarks
    assert "1 frame with 0 detections left out" in remarks
    assert "1 detection of a landmark that the same frame has already, kept (first: landmark 7, line 7)" in remarks
    assert "file frame.csv is not read; did you mean frames.csv?" in remarks
    assert recording.odometry.forward_mps[-2] == 0.9


def test_a_robot_number_is_refused(native: Files, lay_out: Callable) -> None:
    with pytest.raises(InputError, match="there is no robot 2"):
        read_recording(lay_out(native), 2)


def test_parquet_is_refused_with_its_row(native: Files, lay_out: Callable) -> None:
    path = lay_out(native)
    (path / "frames.csv").unlink()
    pq.write_table(pa.table({"stamp_s": [0.0, 0.5, float("nan")]}), path / "frames.parquet")
    with pytest.raises(InputError, match=r"frames\.parquet:3: field 'stamp_s': nan"):
        read_recording(path)
    pq.write_table(pa.table({"stamp_s": pa.array([0, 1], pa.duration("ns"))}), path / "frames.parquet")
    with pytest.raises(InputError, match=r"frames\.parquet: field 'stamp_s': contains duration.*float64"):
        read_recording(path)
    (path / "frames.parquet").write_bytes(b"PAR1 but not really PAR1")
    with pytest.raises(InputError, match=r"frames\.parquet: not a readable Parquet file"):
        read_recording(path)


def test_nothing_is_overwritten_unasked(native: Files, lay_out: Callable, tmp_path: Path) -> None:
    recording = read_recording(lay_out(native))
    target = tmp_path / "target"
    write_native(recording, target)
    with pytest.raises(InputError, match="not empty"):
        write_native(recording, target)
    thesis = tmp_path / "target" / "thesis.txt"
    thesis.write_text("years of work")
    with pytest.raises(InputError, match="not empty"):
        write_native(recording, target, "parquet")
    assert thesis.read_text() == "years of work"
    assert not list(target.glob("*.parquet"))
    with pytest.raises(ConfigError, match="xlsx"):
        write_native(recording, tmp_path / "other", "xlsx")  # type: ignore[arg-type]
    assert sorted(child.name for child in tmp_path.iterdir()) == ["MRCLAM_Test", "target"]


def _driven(odometry: Odometry, start_s: float, stop_s: float) -> np.ndarray:
    """(3,) motion between two stamps, row by row."""
    pose, ends = np.zeros(3), np.append(odometry.stamp_s[1:], np.inf)
    for k, (begin_s, end_s) in enumerate(zip(odometry.stamp_s, ends, strict=True)):
        held_s = min(stop_s, end_s) - max(start_s, begin_s)
        if held_s > 0.0:
            twist = [odometry.forward_mps[k], odometry.lateral_mps[k], odometry.angular_radps[k]]
            pose = se2.compose(pose, se2.exp(np.array(twist) * held_s))
    return pose


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 5))])
def test_a_condensed_session_has_the_motion_between_frames_and_the_silences(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    stamp_s = np.cumsum(np.where(rng.uniform(size=2000) < 0.005, 3.0, 0.02))
    driven = Odometry(stamp_s, *(rng.normal(size=(3, 2000)).cumsum(axis=1) * 0.03))
    at = np.sort(rng.choice(stamp_s[1:-1], 40, replace=False))
    count = 100
    recording = Recording(
        name="drive",
        odometry=driven,
        frames=Frames(at),
        detections=Detections(
            frame=np.sort(rng.integers(0, 40, count)),
            landmark_id=rng.integers(0, 9, count),
            range_m=rng.uniform(1.0, 9.0, count),
            bearing_rad=rng.uniform(-1.0, 1.0, count),
            class_id=np.full(count, -1),
            sigma_range_m=np.full(count, np.nan),
            sigma_bearing_rad=np.full(count, np.nan),
            source_line=np.zeros(count, dtype=np.int64),
        ),
    )
    again = read_recording(write_session(recording, tmp_path / "session.zip"))
    assert again.dim == 2
    few = again.odometry
    assert len(few) < 0.2 * len(driven)
    assert np.isin(few.stamp_s, stamp_s).all()
    for start_s, stop_s in pairwise(at):
        assert _driven(few, start_s, stop_s) == pytest.approx(_driven(driven, start_s, stop_s), abs=1e-5)
    silent = np.flatnonzero(np.diff(stamp_s) > LONGEST_S)
    assert len(silent)
    assert np.isin(stamp_s[[*silent, *(silent + 1)]], few.stamp_s).all()
    assert np.array_equal(again.frames.stamp_s, at)
    assert np.array_equal(again.detections.landmark_id, recording.detections.landmark_id)
    assert again.detections.range_m == pytest.approx(recording.detections.range_m, rel=1e-6)
