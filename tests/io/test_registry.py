"""Every reader keeps the protocol; what no reader knows gets a helpful refusal."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from evermap.errors import InputError
from evermap.io import READERS, Reader, add_reader, find_readers, list_robots, read_recording, reader_for
from evermap.types import Recording


@pytest.fixture(params=[reader.name for reader in READERS])
def reader_and_path(request: pytest.FixtureRequest, lay_out: Callable) -> tuple[Reader, Path]:
    """A reader and a small recording of its format, from the fixture of its name."""
    reader = next(reader for reader in READERS if reader.name == request.param)
    return reader, lay_out(request.getfixturevalue(reader.name))


def test_protocol(reader_and_path: tuple[Reader, Path], check_recording: Callable, assert_same: Callable) -> None:
    reader, path = reader_and_path
    assert reader.matches(path)
    assert reader_for(path) is reader
    assert [other.name for other in READERS if other.matches(path)] == [reader.name]
    assert reader.looks_for
    recording = read_recording(path)
    assert isinstance(recording, Recording)
    assert recording.source == str(path)
    if recording.dim == 2:
        check_recording(recording)
    robots = list_robots(path)
    assert robots == tuple(sorted(robots))
    for robot in robots:
        check_recording(read_recording(path, robot))
    if robots:
        assert_same(recording, read_recording(str(path), robots[0]))
    with pytest.raises(InputError, match="robot 77"):
        read_recording(path, 77)


def test_names_are_unique() -> None:
    assert len({reader.name for reader in READERS}) == len(READERS)


def test_unknown_paths_say_what_was_looked_for(tmp_path: Path, mrclam: dict[str, str], lay_out: Callable) -> None:
    with pytest.raises(InputError, match="no such file or folder"):
        read_recording(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(
        InputError,
        match=r"contains no files; looked for mrclam: .*Barcodes\.dat; tagslam: .*; native: .*detections\.csv",
    ):
        read_recording(tmp_path / "empty")
    (tmp_path / "photos").mkdir()
    for number in range(7):
        (tmp_path / "photos" / f"{number}.jpg").touch()
    with pytest.raises(InputError, match=r"contains 0\.jpg, .* and 2 more; looked for"):
        read_recording(tmp_path / "photos")
    with pytest.raises(InputError, match=r"its folder .*MRCLAM_Test"):
        read_recording(lay_out(mrclam) / "Robot1_Odometry.dat")
    (tmp_path / "broken.zip").write_bytes(b"PK\x03\x04 and then the line went dead")
    with pytest.raises(InputError, match=r"broken\.zip: not a readable zip"):
        read_recording(tmp_path / "broken.zip")
    with pytest.raises(InputError, match=r"no usable file name|no such file"):
        read_recording("nul\0byte")


def test_a_zip_with_a_damaged_member(mrclam: dict[str, str], lay_out: Callable) -> None:
    path = lay_out(mrclam, zipped=True)
    data = path.read_bytes()
    start = data.index(b"Robot1_Odometry.dat") + 60
    path.write_bytes(data[:start] + bytes(40) + data[start + 40 :])
    with pytest.raises(InputError, match=r"MRCLAM_Test\.zip/Robot1_Odometry\.dat: damaged inside the zip"):
        read_recording(path)


def test_importing_loads_nothing_heavy() -> None:
    code = (
        "import evermap.io, sys; print([m for m in ('pyarrow', 'scipy', 'pandas', 'matplotlib') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True,
                          env={"PYTHONPATH": str(Path(__file__).parents[2] / "src")})  # fmt: skip
    assert done.stdout.strip() == "[]"


def test_a_reader_of_ones_own_is_tried_first(
    tmp_path: Path, mrclam: dict[str, str], lay_out: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Added in a process, or brought by a package; one with a known name takes its place."""
    monkeypatch.setattr("evermap.io._ADDED", [])
    path = lay_out(mrclam)
    known = reader_for(path)
    mine = replace(known, looks_for="mine")
    add_reader(mine)
    add_reader(mine)
    assert reader_for(path) is mine
    assert [reader.name for reader in find_readers()].count(known.name) == 1
    (tmp_path / "day.xyz").touch()
    brought = Reader("xyz", "day.xyz", lambda _: False, lambda *_: read_recording(path), endings=(".xyz",))
    monkeypatch.setattr("evermap.io.found", lambda _: {"xyz": None})
    monkeypatch.setattr("evermap.io.load", lambda group, name: {("evermap.readers", "xyz"): brought}[group, name])
    assert reader_for(tmp_path / "day.xyz") is brought
    assert read_recording(tmp_path / "day.xyz").name == read_recording(path).name
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"looked for .*mine; .*xyz: day\.xyz"):
        read_recording(tmp_path / "empty")
