"""Whatever happens to a file on its way, reading it gives a sound recording or one line that says what is wrong."""

from __future__ import annotations

import io
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from evermap.errors import EvermapError
from evermap.io import (
    read_landmarks,
    read_recording,
    read_tum,
    write_map_geojson,
    write_map_parquet,
    write_native,
    write_template,
)
from evermap.types import Landmarks
from evermap.valid import validate

Files = dict[str, bytes]
damage_settings = settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
INTERESTING = [
    b"\n",
    b"\r",
    b"\x00",
    b"#",
    b",",
    b'"',
    b"nan",
    b"-",
    b"1e999",
    b"\xff\xfe",
    b"[",
    b"_",
    b"99999999999",
    b" ",
]


@st.composite
def damaged(draw: st.DrawFn, data: bytes) -> bytes:
    """The bytes cut short, or with some of them changed, removed, repeated or put in."""
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, max(0, len(data) - 1)))
        size = draw(st.integers(1, 40))
        kind = draw(st.sampled_from(["cut", "flip", "remove", "repeat", "insert"]))
        if kind == "cut":
            data = data[:at]
        elif kind == "flip" and data:
            data = data[:at] + bytes([data[at] ^ draw(st.integers(1, 255))]) + data[at + 1 :]
        elif kind == "remove":
            data = data[:at] + data[at + size :]
        elif kind == "repeat":
            data = data[: at + size] + data[at:]
        elif kind == "insert":
            data = data[:at] + draw(st.one_of(st.sampled_from(INTERESTING), st.binary(max_size=8))) + data[at:]
    return data


def sound_or_one_line(read: Callable[[], object], check: Callable[[object], None] | None = None) -> None:
    try:
        result = read()
    except EvermapError as error:
        message = str(error)
        assert "\n" not in message
        assert 10 < len(message) < 700, message
    else:
        if check is not None:
            check(result)


@damage_settings
@given(data=st.data())
def test_damaged_mrclam(
    data: st.DataObject, mrclam: dict[str, str], lay_out: Callable, check_recording: Callable
) -> None:
    files = {name: text.encode() for name, text in mrclam.items()}
    name = data.draw(st.sampled_from(sorted(files)))
    files[name] = data.draw(damaged(files[name]))
    path = lay_out(files)
    sound_or_one_line(lambda: read_recording(path, 1), check_recording)


@damage_settings
@given(data=st.data())
def test_damaged_native(
    data: st.DataObject, native: dict[str, str], lay_out: Callable, check_recording: Callable
) -> None:
    files = {name: text.encode() for name, text in native.items()}
    name = data.draw(st.sampled_from(sorted(files)))
    files[name] = data.draw(damaged(files[name]))
    path = lay_out(files)
    sound_or_one_line(lambda: read_recording(path), check_recording)


@pytest.mark.parametrize("made", ["space", "template", "tagslam", "ycbv"])
@damage_settings
@given(data=st.data())
def test_damaged_in_space(
    data: st.DataObject, made: str, request: pytest.FixtureRequest, lay_out: Callable, tmp_path: Path
) -> None:
    if made == "template":
        template = tmp_path / "template"
        shutil.rmtree(template, ignore_errors=True)
        files = {path.name: path.read_bytes() for path in write_template(template, in_space=True).iterdir()}
    else:
        files = {name: text.encode() for name, text in request.getfixturevalue(made).items()}
    name = data.draw(st.sampled_from(sorted(files)))
    files[name] = data.draw(damaged(files[name]))
    path = lay_out(files)
    sound_or_one_line(lambda: read_recording(path), validate)


@damage_settings
@given(data=st.data())
def test_damaged_zip(data: st.DataObject, mrclam: dict[str, str], tmp_path: Path, check_recording: Callable) -> None:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in mrclam.items():
            archive.writestr(f"MRCLAM_Test/{name}", text)
    path = tmp_path / "damaged.zip"
    path.write_bytes(data.draw(damaged(packed.getvalue())))
    sound_or_one_line(lambda: read_recording(path), check_recording)


@damage_settings
@given(data=st.data())
def test_damaged_parquet(
    data: st.DataObject, native: dict[str, str], lay_out: Callable, tmp_path: Path, check_recording: Callable
) -> None:
    shutil.rmtree(tmp_path / "parquet", ignore_errors=True)
    folder = write_native(read_recording(lay_out(native)), tmp_path / "parquet", "parquet")
    file = data.draw(st.sampled_from(sorted(folder.glob("*.parquet"))))
    file.write_bytes(data.draw(damaged(file.read_bytes())))
    sound_or_one_line(lambda: read_recording(folder), check_recording)


@pytest.mark.parametrize("ending", [".parquet", ".geojson", ".csv"])
@damage_settings
@given(data=st.data())
def test_damaged_maps(data: st.DataObject, tmp_path: Path, ending: str) -> None:
    landmarks = Landmarks.at([3, 1], [[1.5, 2.0], [-1.0, 0.25]], sigma_m=0.1, class_id=[0, -1], class_names=("door",))
    path = tmp_path / f"map{ending}"
    if ending == ".parquet":
        write_map_parquet(landmarks, path)
    elif ending == ".geojson":
        write_map_geojson(landmarks, path)
    else:
        path.write_text("landmark_id,x_m,y_m,sigma_m,class_id\n3,1.5,2.0,0.1,door\n1,-1.0,0.25,,\n")
    path.write_bytes(data.draw(damaged(path.read_bytes())))
    sound_or_one_line(lambda: read_landmarks(path))


@damage_settings
@given(data=st.data())
def test_damaged_trajectories(data: st.DataObject, tmp_path: Path) -> None:
    path = tmp_path / "trajectory.tum"
    path.write_bytes(data.draw(damaged(b"0.0 1 2 0 0 0 0 1\n0.5 1 2 0 0 0 0.6 0.8\n1.0 1.5 2 0 0 0 0 1\n")))
    sound_or_one_line(lambda: read_tum(path))


@given(garbage=st.binary(max_size=200))
@damage_settings
def test_garbage_is_no_recording(garbage: bytes, tmp_path: Path) -> None:
    for name in ("garbage", "garbage.zip", "garbage.mcap"):
        path = tmp_path / name
        path.write_bytes(garbage)
        with pytest.raises(EvermapError):
            read_recording(path)
