"""Landmarks called by texts, and stamps given as dates: through files, runs and sessions, and back."""

from __future__ import annotations

import json
import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from evermap import read_looks, read_recording, run_session, run_slam, write_native
from evermap.cli.main import app
from evermap.errors import InputError
from evermap.io import read_landmarks, write_map_geojson, write_map_parquet, write_template
from evermap.runs.summary import change_dict
from evermap.types import ChangeKind, Clock, MapChange, landmark_code, landmark_id_of

FIVE = "2026-03-01T12:00:05Z"
NAMES = {1: "door-3", 2: "tag:17", 3: "42"}


def named_template(folder: Path) -> Path:
    """The template with two landmarks that are called by a text and one by another number."""
    write_template(folder)
    for file, column in (("detections.csv", 1), ("landmarks.csv", 0)):
        lines = (folder / file).read_text().splitlines()
        for row, line in enumerate(lines):
            cells = line.split(",")
            if not line.startswith("#") and len(cells) > column and cells[column] in {"1", "2", "3"}:
                cells[column] = NAMES[int(cells[column])]
                lines[row] = ",".join(cells)
        (folder / file).write_text("\n".join(lines) + "\n")
    return folder


def dated(folder: Path, zone: str, start: datetime = datetime(2026, 3, 1, 12, tzinfo=UTC)) -> Path:
    """A recording whose stamps are dates."""
    for file in folder.glob("*.csv"):
        lines = file.read_text().splitlines()
        for row, line in enumerate(lines):
            if re.match(r"\d", line) and file.name != "landmarks.csv":
                stamp, _, rest = line.partition(",")
                date = datetime.fromtimestamp(start.timestamp() + float(stamp), UTC).replace(tzinfo=None)
                lines[row] = f"{date.isoformat()}{zone}" + ("," + rest if rest else "")
        file.write_text("\n".join(lines) + "\n")
    toml = folder / "sensor.toml"
    toml.write_text(re.sub(r"(?m)^clock = .*$", "", toml.read_text()))
    return folder


def test_the_id_of_a_text_is_the_same_everywhere_and_survives_float64_and_json() -> None:
    assert landmark_id_of("door-3") == landmark_id_of(" door-3 ") == 8249110127006580
    ids = {landmark_id_of(f"tag:{number}") for number in range(10_000)}
    assert len(ids) == 10_000
    assert all(2**52 <= number < 2**53 and int(float(number)) == number for number in ids)


def test_texts_go_through_a_run_into_every_output(tmp_path: Path) -> None:
    recording = read_recording(named_template(tmp_path / "named"))
    ids = {landmark_id_of("door-3"), landmark_id_of("tag:17"), 42, 4, 5, 6}
    assert set(recording.detections.landmark_id.tolist()) == ids
    assert set(recording.landmark_names.values()) == {"door-3", "tag:17"}
    assert recording.true_landmarks is not None
    assert set(recording.true_landmarks.landmark_id.tolist()) == ids

    plain = run_slam(read_recording(write_template(tmp_path / "plain"))).landmarks
    landmarks = run_slam(recording).landmarks
    order = [landmarks.landmark_id.tolist().index(i) for i in (landmark_id_of("door-3"), landmark_id_of("tag:17"), 42)]
    np.testing.assert_allclose(landmarks.position_m[order], plain.position_m[:3], atol=1e-9)

    for write, name in ((write_map_parquet, "map.parquet"), (write_map_geojson, "map.geojson")):
        again = read_landmarks(write(landmarks, tmp_path / name))
        np.testing.assert_array_equal(again.landmark_id, landmarks.landmark_id)
        assert dict(again.names) == dict(landmarks.names)
    features = json.loads((tmp_path / "map.geojson").read_text())["features"]
    names = {each["properties"].get("name") for each in features if each["geometry"]["type"] == "Point"}
    assert names == {"door-3", "tag:17", ""}


def test_a_map_tells_and_takes_texts(tmp_path: Path) -> None:
    runner, file = CliRunner(), str(tmp_path / "site.evermap")
    recording = str(named_template(tmp_path / "named"))

    def told(*words: str) -> str:
        result = runner.invoke(app, [*words])
        assert result.exit_code == 0, result.output
        return result.output

    told("map", "enter", file, recording, "--out", str(tmp_path / "run"))
    assert "door-3" in told("map", "show", file)
    assert "landmark door-3 " in told("map", "why", file, "door-3")
    assert "pinned landmark tag:17" in told("map", "pin", file, "tag:17")
    assert "landmark tag:17 pinned" in told("map", "diff", file, "1", "2")
    assert [
        item["label"] for item in json.loads(told("map", "show", file, "--json"))["landmarks"] if item["pinned"]
    ] == ["tag:17"]
    for name in ("door-4", "tag:99"):
        result = runner.invoke(app, ["map", "why", file, name])
        assert result.exit_code == 2
        assert re.search(f"no landmark '{name}'; there is (door-3|tag:17)", result.output)


def test_texts_are_written_as_texts_and_read_back(tmp_path: Path) -> None:
    recording = read_recording(named_template(tmp_path / "named"))
    for ending in ("csv", "parquet"):
        again = read_recording(write_native(recording, tmp_path / ending, ending))
        np.testing.assert_array_equal(again.detections.landmark_id, recording.detections.landmark_id)
        assert dict(again.landmark_names) == dict(recording.landmark_names)
    assert ",door-3," in (tmp_path / "csv" / "detections.csv").read_text()


def test_the_same_text_is_the_same_landmark_in_the_next_session(tmp_path: Path) -> None:
    first = run_session(read_recording(dated(named_template(tmp_path / "one"), "Z")))
    later = datetime(2026, 3, 2, 12, tzinfo=UTC)
    second = run_session(read_recording(dated(named_template(tmp_path / "two"), "+00:00", later)), first.living)
    assert second.found
    assert second.changes == ()
    assert sorted(second.living.members.landmark_id.tolist()) == sorted(first.living.members.landmark_id.tolist())


def test_changes_say_the_names() -> None:
    change = MapChange((7, landmark_id_of("door-3")), ChangeKind.VANISHED, 0.0, 1.0, (np.nan, np.nan), 0.0, 0.9)
    assert change_dict(change)["names"] is None
    assert change.labels == ("7", landmark_code(landmark_id_of("door-3")))
    named = change.named({landmark_id_of("door-3"): "door-3"})
    assert named == change
    assert change_dict(named)["names"] == ["7", "door-3"]


def test_dates_with_a_zone_are_unix_and_without_one_the_clocks_on_the_wall(tmp_path: Path) -> None:
    start = datetime(2026, 3, 1, 12, tzinfo=UTC).timestamp()
    for zone, clock, shift in (("Z", Clock.UNIX, 0.0), ("+01:00", Clock.UNIX, 3600.0), ("", Clock.LOCAL_WALL, 0.0)):
        recording = read_recording(dated(write_template(tmp_path / f"zone{zone[:3]}"), zone))
        assert recording.clock is recording.odometry.clock is recording.frames.clock is clock
        assert recording.odometry.stamp_s[0] == start - shift
        np.testing.assert_allclose(np.diff(recording.odometry.stamp_s), 0.1, atol=1e-6)


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        (
            "odometry.csv",
            "2026-03-01T12:00:05Z",
            "2026-03-01T12:00:05",
            r"odometry.csv:\d+: field 'stamp_s': .*no zone, unlike",
        ),
        (
            "odometry.csv",
            "2026-03-01T12:00:05Z",
            "2026-13-01T12:00:05Z",
            r"odometry.csv:\d+: field 'stamp_s': .*is not a date",
        ),
        ("odometry.csv", "2026-03-01T12:00:05Z", "noon", "is not a date"),
        ("odometry.csv", "2026-03-01T12:00:05Z", "2026-03-01T11:00:05Z", "time runs backwards"),
        (
            "sensor.toml",
            "format_version = 1",
            'format_version = 1\nclock = "local_wall"',
            "dates on the clock unix",
        ),
    ],
)
def test_bad_dates_are_refused(tmp_path: Path, file: str, old: str, new: str, words: str) -> None:
    folder = dated(write_template(tmp_path / "dated"), "Z")
    text = (folder / file).read_text()
    assert old in text
    if file == "odometry.csv":  # in a long table one such row would be left out
        lines = text.splitlines()
        at = next(row for row, line in enumerate(lines) if line.startswith(old))
        text = "\n".join([*(line for line in lines if line.startswith("stamp_s")), *lines[at - 6 : at + 6]]) + "\n"
    (folder / file).write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=words):
        read_recording(folder)


def test_a_table_of_looks_may_have_dates_as_text_or_as_parquet_timestamps(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    dates = [datetime(2026, 3, 1, hour, tzinfo=UTC).replace(tzinfo=None) for hour in (8, 9, 10)]
    path = tmp_path / "looks.csv"
    path.write_text("stamp_s,feature_id,detected\n" + "".join(f"{date.isoformat()},door-3,1\n" for date in dates))
    expected = [date.replace(tzinfo=UTC).timestamp() for date in dates]
    table = read_looks(path)
    assert table.clock is Clock.LOCAL_WALL
    assert table.stamp_s.tolist() == expected
    for zone, clock in ((None, Clock.LOCAL_WALL), ("UTC", Clock.UNIX)):
        stamps = pa.array(dates, type=pa.timestamp("ns", tz=zone))
        pq.write_table(
            pa.table({"stamp_s": stamps, "feature_id": ["a"] * 3, "detected": [1, 0, 1]}), tmp_path / "l.parquet"
        )
        table = read_looks(tmp_path / "l.parquet")
        assert table.clock is clock
        assert table.stamp_s.tolist() == expected


def test_an_id_that_is_a_broken_number_is_still_refused(tmp_path: Path) -> None:
    folder = write_template(tmp_path / "t")
    text = (folder / "detections.csv").read_text()
    for bad in ("1.5", "-3", "1e30"):
        row = re.sub(r"(?m)^(0\.0),\d", rf"\1,{bad}", text, count=1)
        (folder / "detections.csv").write_text(row)
        with pytest.raises(InputError, match="landmark_id"):
            read_recording(folder)
