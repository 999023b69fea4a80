"""What is no recording says what it is and what to do, in one line; files beside a bag do not change what it is."""

from __future__ import annotations

import gzip
import io
import tarfile
import zipfile
from pathlib import Path

import pytest

from evermap.errors import InputError
from evermap.io import read_recording, reader_for

TUM = "".join(f"{k}.5 1 2 0 0 0 0 1\n" for k in range(5))
POINTER = (
    "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a214614ab2935c943f9e0ff69d22eadbb8f32b1\nsize 12345\n"
)
EUROC = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m]\n1403636579763555584,1,2\n"


def tar_bytes() -> bytes:
    """The same whenever it is made: processes that share the tests must collect the same ones."""
    made = io.BytesIO()
    with tarfile.open(fileobj=made, mode="w") as archive:
        archive.addfile(tarfile.TarInfo("odometry.csv"))
    return gzip.compress(made.getvalue(), mtime=0)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("path.txt", TUM, "a trajectory in the format of TUM"),
        ("00.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n" * 3, "a trajectory in the format of KITTI"),
        ("data.csv", EUROC, "in the layout of EuRoC"),
        ("run.mat", b"MATLAB 5.0 MAT-file, Platform: GLNXA64", "a MATLAB file"),
        ("run.h5", b"\x89HDF\r\n\x1a\n" + bytes(40), "an HDF5 file"),
        ("drive.mcap", POINTER, r"a pointer of Git LFS to a file of 12,345 bytes that was not fetched \(try: `git lfs"),
        ("drive.g2o", POINTER, "a pointer of Git LFS"),
        ("day.tar.gz", tar_bytes(), r"a tar archive, not a recording \(try: unpack it"),
        ("front.png", b"\x89PNG\r\n\x1a\n" + bytes(40), r"an image \(PNG\), not a recording .*detections of landmarks"),
        ("empty.bag.txt", b"", "an empty file"),
        ("cloud.pcd", b"# .PCD v0.7\n", "a cloud of points"),
        ("map.geojson", '{"type": "FeatureCollection", "features": []}', "--prior-map FILE"),
        ("tags.yaml", "bodies:\n  - hall:\n", "a map of tags or a calibration"),
        ("drive.bin", b"#ROSBAG V2.0\n", r"a bag of ROS 1 under another name, .*rename it to NAME\.bag"),
        ("odometry.csv", "stamp_s,forward_mps,angular_radps\n0,1,0\n", r"one table of a recording, .*its folder .*"),
        ("map.csv", "landmark_id,x_m,y_m\n1,2,3\n", "a map of landmarks, .*--prior-map"),
    ],
)
def test_a_file_says_what_it_is(name: str, content: str | bytes, said: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(InputError, match=said) as caught:
        read_recording(path)
    assert "\n" not in str(caught.value)
    assert caught.value.hint


def test_a_living_map_is_named(tmp_path: Path) -> None:
    from evermap.maps.store import open_store

    open_store(tmp_path / "site.evermap", create=True).close()
    with pytest.raises(InputError, match=r"a living map of evermap, .*map enter site\.evermap"):
        read_recording(tmp_path / "site.evermap")


def test_folders_say_what_they_hold(tmp_path: Path) -> None:
    (tmp_path / "mav0" / "cam0").mkdir(parents=True)
    (tmp_path / "mav0" / "cam0" / "data.csv").write_text("#timestamp [ns],filename\n1,1.png\n")
    with pytest.raises(InputError, match="the layout of EuRoC"):
        read_recording(tmp_path)
    with pytest.raises(InputError, match="the layout of EuRoC"):
        read_recording(tmp_path / "mav0")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "summary.json").write_text('{"schema_version": 3, "evermap_version": "1"}')
    with pytest.raises(InputError, match="the results of an evermap run"):
        read_recording(tmp_path / "run")
    (tmp_path / "poses").mkdir()
    for number in range(3):
        (tmp_path / "poses" / f"{number:02}.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(InputError, match="each is a trajectory in the format of KITTI"):
        read_recording(tmp_path / "poses")


def test_a_pointer_inside_a_recording_is_named(native: dict[str, str], lay_out, tmp_path: Path) -> None:
    native["detections.csv"] = POINTER
    with pytest.raises(InputError, match=r"detections\.csv: is a pointer of Git LFS"):
        read_recording(lay_out(native))
    packed = tmp_path / "day.zip"
    with zipfile.ZipFile(packed, "w") as archive:
        for name, text in native.items():
            archive.writestr(name, text)
    with pytest.raises(InputError, match=r"day\.zip/detections\.csv: is a pointer of Git LFS"):
        read_recording(packed)


def test_yaml_beside_tables_does_not_make_them_those_of_tagslam(
    native: dict[str, str], tagslam: dict[str, str], lay_out
) -> None:
    calibration = {name: text for name, text in tagslam.items() if name.endswith(".yaml")}
    assert reader_for(lay_out({**native, **calibration})).name == "native"


def test_yaml_beside_a_bag_does_not_make_it_one_of_tagslam(
    bag: dict[str, bytes], tagslam: dict[str, str], lay_out
) -> None:
    calibration = {name: text.encode() for name, text in tagslam.items() if name.endswith(".yaml")}
    path = lay_out({**bag, **calibration})
    assert reader_for(path).name == "bag"
    (file,) = path.glob("*.mcap")
    assert reader_for(file).name == "bag"
    assert len(read_recording(path).detections) == len(read_recording(file).detections)


def test_metadata_of_something_else_does_not_make_a_folder_a_bag(native: dict[str, str], lay_out) -> None:
    path = lay_out({**native, "metadata.yaml": "author: somebody\n"})
    assert reader_for(path).name == "native"


def test_a_folder_that_holds_one_bag_is_that_bag(bag: dict[str, bytes], tagslam: dict[str, str], lay_out) -> None:
    only = {name: data for name, data in bag.items() if name.endswith(".mcap")}
    path = lay_out({**only, "tags.yaml": tagslam["tagslam.yaml"].encode()})
    assert reader_for(path).name == "bag"
    assert len(read_recording(path).detections)
