"""MRCLAM against a naive parse of the same files, and what is wrong with files in the world."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from evermap.errors import DataError, EvermapError, InputError
from evermap.io import list_robots, read_mrclam, read_recording
from evermap.types import Clock

Files = dict[str, str]


def naive(path: Path, name: str) -> np.ndarray:
    with zipfile.ZipFile(path) as archive:
        member = next(member for member in archive.namelist() if member.endswith(name))
        return np.loadtxt(io.BytesIO(archive.read(member)))


@pytest.mark.data
@pytest.mark.parametrize(("dataset", "robot"), [(6, 1), (6, 3), (3, 5), (1, 2)])
def test_real_recordings_are_read_as_a_naive_parse_reads_them(
    shared_data: Path, check_recording: Callable, dataset: int, robot: int
) -> None:
    path = shared_data / "mrclam" / f"MRCLAM_Dataset{dataset}.zip"
    recording = read_mrclam(path, robot)
    check_recording(recording)
    assert recording.name == f"MRCLAM_Dataset{dataset} robot {robot}"
    assert recording.clock is Clock.UNIX
    assert not recording.frames.complete

    odometry = naive(path, f"Robot{robot}_Odometry.dat")
    last = {row[0]: row for row in odometry.tolist()}  # the last row of every stamp
    expected = np.array(list(last.values()))
    np.testing.assert_array_equal(recording.odometry.stamp_s, expected[:, 0])
    np.testing.assert_array_equal(recording.odometry.forward_mps, expected[:, 1])
    np.testing.assert_array_equal(recording.odometry.angular_radps, expected[:, 2])

    subject_of = {int(barcode): int(subject) for subject, barcode in naive(path, "Barcodes.dat")}
    landmarks, robots = [], []
    for stamp, barcode, distance, bearing in naive(path, f"Robot{robot}_Measurement.dat").tolist():
        subject = subject_of.get(int(barcode), 0)
        if subject:
            (landmarks if subject >= 6 else robots).append((stamp, subject, distance, bearing))
    seen = recording.detections
    got = np.stack([recording.frames.stamp_s[seen.frame], seen.landmark_id, seen.range_m, seen.bearing_rad], axis=1)
    np.testing.assert_array_equal(got, np.array(landmarks))
    sightings = recording.robot_sightings
    assert sightings is not None
    got = np.stack([sightings.stamp_s, sightings.robot_id, sightings.range_m, sightings.bearing_rad], axis=1)
    np.testing.assert_array_equal(got, np.array(robots))
    measured = naive(path, f"Robot{robot}_Measurement.dat")[:, 0]
    np.testing.assert_array_equal(recording.frames.stamp_s, np.unique(measured))

    survey = naive(path, "Landmark_Groundtruth.dat")
    assert recording.true_landmarks is not None
    np.testing.assert_array_equal(recording.true_landmarks.position_m, survey[:, 1:3])
    variances = np.diagonal(recording.true_landmarks.covariance_m2, axis1=1, axis2=2)
    np.testing.assert_allclose(np.sqrt(variances), survey[:, 3:5], rtol=1e-14)
    if dataset in (3, 6):
        assert recording.truth is not None
        truth = naive(path, f"Robot{robot}_Groundtruth.dat")
        np.testing.assert_array_equal(recording.truth.stamp_s, truth[:, 0])
        np.testing.assert_array_equal(recording.truth.pose_world_robot[:, :2], truth[:, 1:3])
        np.testing.assert_allclose(np.exp(1j * recording.truth.pose_world_robot[:, 2]), np.exp(1j * truth[:, 3]))
    else:
        assert recording.truth is None


@pytest.mark.data
def test_source_lines_point_at_the_reading_in_the_real_file(shared_data: Path) -> None:
    path = shared_data / "mrclam" / "MRCLAM_Dataset6.zip"
    seen = read_mrclam(path, 2).detections
    with zipfile.ZipFile(path) as archive:
        lines = archive.read("MRCLAM_Dataset6/Robot2_Measurement.dat").decode().splitlines()
    for row in (0, 1000, len(seen) - 1):
        assert float(lines[seen.source_line[row] - 1].split()[2]) == seen.range_m[row]


@pytest.mark.data
def test_a_robot_without_odometry_in_the_real_data(shared_data: Path) -> None:
    path = shared_data / "mrclam" / "MRCLAM_Dataset3.zip"
    assert list_robots(path) == (1, 2, 3, 5)
    with pytest.raises(InputError, match=r"robot 4 has no odometry file.*1, 2, 3, 5"):
        read_mrclam(path, 4)


@pytest.mark.parametrize("inside", ["", "MRCLAM_Test", "backup/MRCLAM_Test"])
@pytest.mark.parametrize("zipped", [True, False])
@pytest.mark.parametrize("line_end", ["\n", "\r\n", "\r"])
def test_zip_folder_and_line_ends_make_no_difference(
    mrclam: Files, lay_out: Callable, assert_same: Callable, check_recording: Callable, inside: str, zipped: bool,
    line_end: str,
) -> None:  # fmt: skip
    if inside.startswith("backup") and not zipped:
        inside = "MRCLAM_Test"
    files = {name: text.replace("\n", line_end) for name, text in mrclam.items()}
    recording = read_recording(lay_out(files, zipped=zipped, inside=inside))
    check_recording(recording)
    assert recording.name == "MRCLAM_Test robot 1"
    np.testing.assert_array_equal(recording.frames.stamp_s, [1000.5, 1001.25, 1002.0, 1003.125])
    np.testing.assert_array_equal(recording.detections.frame, [0, 0, 2, 3])
    np.testing.assert_array_equal(recording.detections.landmark_id, [6, 7, 8, 6])
    np.testing.assert_array_equal(recording.detections.source_line, [3, 4, 7, 8])
    assert recording.robot_sightings is not None
    np.testing.assert_array_equal(recording.robot_sightings.robot_id, [2])
    assert len(recording.warnings) == 1
    assert "1 sighting of barcodes not in Barcodes.dat left out: 99 (1x)" in recording.warnings[0]


def test_the_default_robot_is_the_first_with_both_files(mrclam: Files, lay_out: Callable) -> None:
    del mrclam["Robot1_Odometry.dat"]
    path = lay_out(mrclam)
    assert list_robots(path) == (2,)
    assert read_recording(path).name == "MRCLAM_Test robot 2"


def test_missing_truth_is_none(mrclam: Files, lay_out: Callable) -> None:
    del mrclam["Landmark_Groundtruth.dat"]
    mrclam["Robot1_Groundtruth.dat"] = "# nothing here\n"
    recording = read_recording(lay_out(mrclam))
    assert recording.truth is None
    assert recording.true_landmarks is None
    assert any("Robot1_Groundtruth.dat" in remark for remark in recording.warnings)


def edit(name: str, old: str, new: str) -> Callable[[Files], None]:
    def apply(files: Files) -> None:
        assert old in files[name]
        files[name] = files[name].replace(old, new, 1)

    return apply


def edit_all(name: str, old: str, new: str) -> Callable[[Files], None]:
    """More than the few bad rows that are left out."""
    return lambda files: files.update({name: files[name].replace(old, new)})


def drop(name: str) -> Callable[[Files], None]:
    return lambda files: files.pop(name)


def set_back(name: str) -> Callable[[Files], None]:
    """The second half of a file comes before its first half."""

    def apply(files: Files) -> None:
        lines = files[name].splitlines(keepends=True)
        head = [line for line in lines if line.startswith("#")]
        rows = lines[len(head) :]
        files[name] = "".join([*head, *rows[len(rows) // 2 :], *rows[: len(rows) // 2]])

    return apply


@pytest.mark.parametrize("name", ["Robot1_Odometry.dat", "Robot1_Measurement.dat", "Robot1_Groundtruth.dat"])
def test_a_row_out_of_order_is_sorted_in_and_told(mrclam: Files, lay_out: Callable, name: str) -> None:
    # as the first odometry row of data set 9, as published
    in_order = read_recording(lay_out(mrclam))
    lines = mrclam[name].splitlines(keepends=True)
    first = next(row for row, line in enumerate(lines) if not line.startswith("#"))
    lines[first : first + 4] = [*lines[first + 1 : first + 4], lines[first]]
    mrclam[name] = "".join(lines)
    recording = read_recording(lay_out(mrclam))
    told = [remark for remark in recording.warnings if name in remark and "1 row out of order" in remark]
    assert len(told) == 1
    np.testing.assert_array_equal(recording.odometry.stamp_s, in_order.odometry.stamp_s)
    np.testing.assert_array_equal(recording.odometry.forward_mps, in_order.odometry.forward_mps)
    for name in ("range_m", "landmark_id"):  # rows of one stamp may stand in any order
        got, expected = (np.sort(getattr(each.detections, name)) for each in (recording, in_order))
        np.testing.assert_array_equal(got, expected)


BAD = {
    "missing barcodes": (drop("Barcodes.dat"), ["Barcodes.dat", "missing"]),
    "words": (
        edit_all("Robot1_Odometry.dat", " \t  0.100 \t", " \t fast \t"),
        ["Odometry.dat:3", "forward_mps", "'fast'"],
    ),
    "nan": (
        edit_all("Robot1_Odometry.dat", " \t  0.100 \t", " \t nan \t"),
        ["Odometry.dat:3", "forward_mps", "nan"],
    ),
    "inf": (edit("Robot1_Measurement.dat", "3.000", "inf"), ["Measurement.dat:4", "range_m", "inf"]),
    "negative range": (edit("Robot1_Measurement.dat", "3.000", "-3.0"), ["Measurement.dat:4", "range_m", "-3"]),
    "degrees": (edit("Robot1_Measurement.dat", "-0.250", "-14.3"), ["Measurement.dat:3", "bearing_rad", "radians"]),
    "milliseconds": (
        edit_all("Robot1_Odometry.dat", "\n100", "\n124827227284"),
        ["Odometry.dat:3", "stamp_s", "seconds"],
    ),
    "truncated in the middle": (
        edit("Robot1_Measurement.dat", "3.000 \t 0.100", "3.000"),
        ["Measurement.dat:4", "3 columns"],
    ),
    "clock set back": (
        set_back("Robot1_Odometry.dat"),
        ["Odometry.dat:", "stamp_s", "backwards by"],
    ),
    "truth set back": (set_back("Robot1_Groundtruth.dat"), ["Groundtruth.dat:", "stamp_s", "backwards by"]),
    "barcode twice": (edit("Barcodes.dat", "14", "5"), ["Barcodes.dat:4", "barcode", "5 is listed twice"]),
    "landmark twice": (edit("Landmark_Groundtruth.dat", "  7 ", "  6 "), ["Landmark_Groundtruth.dat:4", "subject"]),
    "barcode with fraction": (
        edit("Robot1_Measurement.dat", " 25 ", " 25.5 "),
        ["Measurement.dat:4", "barcode", "25.5"],
    ),
    "extra column": (edit("Robot1_Measurement.dat", "3.000", "3.0 3.0"), ["Measurement.dat:4", "5 columns"]),
    "grouped digits": (edit("Robot1_Measurement.dat", "3.000", "3_000"), ["Measurement.dat:4", "range_m", "3_000"]),
    "binary": (edit("Robot1_Odometry.dat", "1000.300", "\x00\x01"), ["Odometry.dat:6", "not plain text"]),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_refused_with_file_line_and_field(case: str, mrclam: Files, lay_out: Callable) -> None:
    spoil, words = BAD[case]
    spoil(mrclam)
    with pytest.raises(InputError) as caught:
        read_recording(lay_out(mrclam))
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message, message


NOTHING = {
    "empty odometry": ("Robot1_Odometry.dat", "# comment only\n", "no odometry"),
    "zero bytes": ("Robot1_Odometry.dat", "", "no odometry"),
    "one row": ("Robot1_Odometry.dat", "1000.0 0.1 0.0\n", "two rows"),
    "no measurement": ("Robot1_Measurement.dat", "# comment only\n", "no measurement"),
    "only robots seen": ("Robot1_Measurement.dat", "1001.0 14 2.0 0.0\n", "no landmark was seen"),
    "only strangers seen": ("Robot1_Measurement.dat", "1001.0 77 2.0 0.0\n", "no landmark was seen"),
    "another clock": ("Robot1_Measurement.dat", "900000.0 7 2.0 0.0\n", "do not overlap in time"),
}


@pytest.mark.parametrize("case", NOTHING)
def test_recordings_without_content_are_data_errors(case: str, mrclam: Files, lay_out: Callable) -> None:
    name, content, words = NOTHING[case]
    mrclam[name] = content
    path = lay_out(mrclam)
    with pytest.raises(DataError, match=words) as caught:
        read_recording(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    "ending", ["1003.500 \t 63 \t 1.8", "1003.500 \t 63", "1003.500 \t 63 \t 1.8 \n", "1003.5 63 1.8 -"]
)
def test_an_unfinished_last_line_is_left_out_and_counted(mrclam: Files, lay_out: Callable, ending: str) -> None:
    mrclam["Robot1_Measurement.dat"] += ending
    recording = read_recording(lay_out(mrclam))
    assert len(recording.detections) == 4
    assert "Robot1_Measurement.dat: 1 unfinished last line (9) left out" in recording.warnings


def test_survived_with_counted_warnings(mrclam: Files, lay_out: Callable, check_recording: Callable) -> None:
    mrclam["Robot1_Odometry.dat"] += "1004.900 \t 0.7 \t 0.0 \n1020.000 \t 0.1 \t 0.0 \n"
    mrclam["Robot1_Measurement.dat"] += "1003.125 \t 63 \t 1.950 \t -0.4\n1003.2 63 1.9 0\n1040.0 63 1.9 0\n"
    recording = read_recording(lay_out(mrclam))
    check_recording(recording)
    remarks = "\n".join(recording.warnings)
    assert "Robot1_Odometry.dat: 1 row with the stamp of the next row left out" in remarks
    assert recording.odometry.forward_mps[-2] == 0.7
    assert "odometry has 1 gap over 10 s: 15.1 s from 4.9 s after its start" in remarks
    assert "1 frame with 1 detection left out: more than 10 s before or after the odometry" in remarks
    assert "1 detection of a landmark that the same frame has already, kept (first: landmark 6, line 9)" in remarks
    np.testing.assert_array_equal(recording.frames.stamp_s, [1000.5, 1001.25, 1002.0, 1003.125, 1003.2])
    np.testing.assert_array_equal(recording.detections.frame, [0, 0, 2, 3, 3, 4])


@pytest.mark.parametrize("robot", [3, 4, 0, -1, 10**9])
def test_a_robot_that_is_not_there(mrclam: Files, lay_out: Callable, robot: int) -> None:
    with pytest.raises(InputError, match=r"robots with both files: 1, 2"):
        read_recording(lay_out(mrclam), robot)


def test_two_recordings_in_one_zip(mrclam: Files, lay_out: Callable) -> None:
    files = {f"{folder}/{name}": text for folder in ("first", "second") for name, text in mrclam.items()}
    with pytest.raises(EvermapError, match="contains 2 recordings: first, second"):
        read_recording(lay_out(files, zipped=True))
