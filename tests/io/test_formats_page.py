"""The pages about files tell the truth: their example is a recording, and their columns are those of the files."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from evermap.io import read_recording, write_map_parquet
from evermap.io.sensor_toml import Settings, parse_sensor_toml
from evermap.runs.summary import RunInfo, change_dict, summary_dict
from evermap.types import (
    ChangeKind,
    Detections,
    Frames,
    Innovations,
    Landmarks,
    MapChange,
    Misses,
    Odometry,
    Recording,
    SlamResult,
    SpatialRecording,
    Trajectory,
)


def page(repository: Path, name: str) -> str:
    return (repository / "docs" / f"{name}.md").read_text(encoding="utf-8")


def test_the_complete_example_is_a_recording(repository: Path, tmp_path: Path, check_recording: Callable) -> None:
    section = page(repository, "native-format").split("## A complete example")[1].split("\n## ")[0]
    files = dict(re.findall(r"`(\w+\.\w+)`[^`]*```\w+\n(.*?)```", section, re.DOTALL))
    assert set(files) == {"odometry.csv", "detections.csv", "frames.csv", "sensor.toml"}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    recording = read_recording(tmp_path)
    check_recording(recording)
    assert recording.warnings == ()
    assert recording.frames.complete
    assert recording.class_names == ("door", "pillar")
    assert recording.sensor.mount_robot_sensor == (0.2, 0.0, 0.0)
    np.testing.assert_array_equal(recording.detections.frame, [0, 0, 2, 4, 4])


def test_the_defaults_of_the_sensor_file_are_those_of_the_program(repository: Path) -> None:
    text = re.search(r"```toml\n(\[recording\].*?)```", page(repository, "native-format"), re.DOTALL)
    assert text is not None
    settings = parse_sensor_toml(text[1].encode(), Path("sensor.toml"))
    default = Settings()
    assert settings.clock == default.clock
    for name in ("range_min_m", "range_max_m", "bearing_min_rad", "bearing_max_rad", "p_detect", "p_false",
                 "mount_robot_sensor"):  # fmt: skip
        assert getattr(settings.sensor, name) == getattr(default.sensor, name), name


def test_all_map_columns_are_listed(repository: Path, tmp_path: Path) -> None:
    plane, space = page(repository, "map-files").split("\n## ")[:2]
    flat = Landmarks.at([1], [[0, 0]])
    written = pq.read_table(write_map_parquet(flat, tmp_path / "map.parquet")).column_names
    assert column_names(plane) == written
    tag = Landmarks.in_space([1], [[0, 0, 0]], rotation=[[0, 0, 0, 1]], size_m=[[1, 1, 0]])
    written_too = pq.read_table(write_map_parquet(tag, tmp_path / "map.parquet")).column_names
    added = [name for name in written_too if name not in written or name.startswith("cov_")]
    assert column_names(space) == added


def column_names(section: str) -> list[str]:
    """Names in the first column of a table."""
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    return [name for row in rows for name in re.findall(r"`(\w+)`", row)]


def test_the_example_of_cameras_is_read(repository: Path, tmp_path: Path) -> None:
    text = re.search(r"```toml\n(\[camera.*?)```", page(repository, "recordings-in-space"), re.DOTALL)
    assert text is not None
    (tmp_path / "camera.toml").write_text(text[1])
    (tmp_path / "detections.csv").write_text(
        "stamp_s,landmark_id,sensor,x_m,y_m,z_m\n0,17,lidar,1,2,3\n1,17,front,1,0,3\n"
    )
    recording = read_recording(tmp_path)
    assert isinstance(recording, SpatialRecording)
    front, lidar = recording.sensors
    assert (front.distortion_model, front.resolution_px, lidar.range_max_m) == ("equidistant", (1280, 1024), 50.0)


def test_all_keys_of_summaries_and_changes_are_listed(repository: Path) -> None:
    empty = Trajectory(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    none = np.zeros(0, dtype=np.int64)
    nothing = Innovations(np.zeros(0), none, none, np.zeros(0), np.zeros(0))
    result = SlamResult(
        empty, empty, Landmarks.at([], []), (), nothing, Misses(none, none, np.zeros(0)), np.zeros(0), empty
    )
    recording = Recording("", Odometry(*np.zeros((4, 0))), Frames(np.zeros(0)), Detections(*[none] * 8))
    summary = summary_dict(recording, result, {}, config={}, info=RunInfo(), timing={})
    summary["outputs"] = []  # of `RunFolder.finish`
    section = page(repository, "outputs").split("## Summary and changes")[1].split("\n## ")[0]
    keys = section.partition("Errors in `metrics`")[0]
    listed = re.findall(r"`(\w+)`", "".join(line.split("|")[1] for line in keys.splitlines() if line[:3] == "| `"))
    assert sorted([*listed, "schema_version"]) == sorted(summary)

    change = change_dict(MapChange((1,), ChangeKind.MOVED, 0.0, 1.0, (0.0, 0.0), 0.0, 1.0))
    assert set(re.findall(r"`(\w+)`", section.split("Their keys")[1])) == set(change)
    told = (repository / "docs" / "changes.md").read_text(encoding="utf-8").split("| key |")[1].split("\n\n")[0]
    rows = [line.split("|")[1] for line in told.splitlines() if line.startswith("| `")]
    assert re.findall(r"`(\w+)`", "".join(rows)) == list(change)
