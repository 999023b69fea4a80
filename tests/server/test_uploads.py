"""Uploads: what is read, what is refused, and that nothing takes more than its share."""

from __future__ import annotations

import io
import threading
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("fastapi", reason="a server needs evermap[server]")
pytest.importorskip("httpx", reason="needs httpx: pip install 'evermap[dev]'")


from fleets import SQLITE, SQLITE_ONLY, Fleet, renamed, zipped

from evermap.config import Config, LivingConfig
from evermap.errors import InputError
from evermap.io.bag import bag_settings, read_bag
from evermap.server import uploads
from evermap.server.uploads import UploadLimits, check_digest, recording_of
from evermap.types import SpatialRecording


def bomb(data: bytes) -> bytes:
    return renamed(data, lambda files: {**files, "day0/more.csv": bytes(3_000_000)})


def link(data: bytes) -> bytes:
    buffer = io.BytesIO(data)
    with zipfile.ZipFile(buffer, "a") as archive:
        info = zipfile.ZipInfo("day0/frames.toml")
        info.external_attr = 0o120777 << 16
        archive.writestr(info, "/etc/passwd")
    return buffer.getvalue()


HOSTILE: dict[str, Callable[[bytes], bytes]] = {
    "nothing": lambda _: b"",
    "no zip": lambda _: b"PK\x03\x04 not really",
    "cut off": lambda data: data[: len(data) // 2],
    "parent": lambda data: renamed(data, lambda files: {**files, "../up.csv": b"x"}),
    "absolute": lambda data: renamed(data, lambda files: {**files, "/etc/cron.csv": b"x"}),
    "backslash": lambda data: renamed(data, lambda files: {**files, "..\\up.csv": b"x"}),
    "deep": lambda data: renamed(data, lambda files: {**files, "a/b/c.csv": b"x"}),
    "hidden": lambda data: renamed(data, lambda files: {**files, "day0/.csv": b"x"}),
    "control": lambda data: renamed(data, lambda files: {**files, "day0/a\x1b[1m.csv": b"x"}),
    "twice": lambda data: renamed(data, lambda files: {**files, "day1/detections.csv": b"x"}),
    "bomb": bomb,
    "many": lambda data: renamed(data, lambda files: {**files, **{f"day0/{k}.csv": b"" for k in range(200)}}),
    "thousands": lambda data: zipped({f"{k}": b"" for k in range(5000)}),
    "link": link,
    "gzip": lambda data: renamed(data, lambda files: {**files, "day0/frames.csv": b"\x1f\x8b" + bytes(9)}),
    "parquet": lambda data: renamed(data, lambda files: {**files, "day0/frames.parquet": b"PAR1"}),
    "rows": lambda data: renamed(data, lambda files: {**files, "day0/objects.parquet": many_rows()}),
    "empty": lambda _: zipped({"a/readme.csv": b""}),
    "two bags": lambda _: zipped({"a.db3": SQLITE, "b.db3": SQLITE}),
    "two settings": lambda _: zipped({"a.db3": SQLITE, "b.toml": b"", "c.toml": b""}),
    "no bag": lambda _: zipped({"a.mcap": SQLITE}),
    "bag outside": lambda _: zipped({"../a.db3": SQLITE}),
    "settings only": lambda _: zipped({"metadata.yaml": b"", "a.toml": b""}),
}


def many_rows() -> bytes:
    import pyarrow as pa
    from pyarrow import parquet

    buffer = io.BytesIO()
    parquet.write_table(pa.table({"x": pa.array(np.zeros(400_000))}), buffer)
    assert len(buffer.getvalue()) < 20_000
    return buffer.getvalue()


@pytest.mark.parametrize("where", ["sqlite"], indirect=True)
@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_zips_are_refused(fleet: Fleet, zips: list[bytes], kind: str) -> None:
    fleet.server.limits = UploadLimits(n_bytes=2_000_000, unpacked_bytes=2_500_000)
    assert fleet.upload(zips[0]).status_code == 202
    answer = fleet.upload(HOSTILE[kind](zips[0]))
    assert answer.status_code == 422, answer.text
    assert "\x1b" not in answer.json()["detail"]
    assert len(fleet("GET", "/jobs").json()) == 1
    assert not list(Path(fleet.where).parent.rglob("up.csv"))


@pytest.mark.parametrize("where", ["sqlite"], indirect=True)
def test_what_is_too_large_or_has_no_site_is_refused(fleet: Fleet, zips: list[bytes]) -> None:
    fleet.server.limits = UploadLimits(n_bytes=1000)
    assert fleet.upload(zips[0]).status_code == 413
    fleet.server.limits = UploadLimits()
    for site in ("..", "%2e%2e%2fx", "a b", "x" * 49, "a;b", "%00", "server.db", 'a"b'):
        assert fleet.upload(zips[0], site=site).status_code in (404, 405, 422), site
        assert fleet("GET", f"/maps/{site}/revisions").status_code in (404, 405), site
    assert {path.name for path in Path(fleet.where).iterdir()} == {"server.db"}


def test_the_digest_is_of_the_session_and_not_of_the_zip(zips: list[bytes]) -> None:
    def moved(files: dict[str, bytes]) -> dict[str, bytes]:
        return {f"elsewhere/{name.rpartition('/')[2]}": files[name] for name in sorted(files, reverse=True)}

    other = renamed(zips[0], moved, compression=zipfile.ZIP_STORED)
    assert other != zips[0]
    assert (
        check_digest(other, UploadLimits())
        == check_digest(zips[0], UploadLimits())
        != check_digest(zips[1], UploadLimits())
    )


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Files of ROS 1, ROS 2 as MCAP and in SQLite, and one of tags, whose size it does not tell."""
    pytest.importorskip("rosbags", reason="the extra ros is not installed")
    from bags import write

    folder = tmp_path_factory.mktemp("bags")
    written = [write(folder / name, "objects") for name in ("ros1.bag", "mcap", "sqlite_sqlite")]
    written.append(write(folder / "tags", "tags"))
    ros1, mcap, sqlite, tags = (next(p for p in (one, *one.glob("*")) if p.suffix in ENDINGS) for one in written)
    return {"ros1": ros1, "mcap": mcap, "sqlite": sqlite, "tags": tags}


ENDINGS = (".bag", ".mcap", ".db3")


@pytest.mark.parametrize("kind", ["ros1", pytest.param("mcap", marks=pytest.mark.slow), "sqlite"])
def test_a_bag_is_read_as_it_is_and_in_a_zip(bags: dict[str, Path], kind: str) -> None:
    path, limits = bags[kind], UploadLimits()
    data, wanted = path.read_bytes(), read_bag(path)
    digest = check_digest(data, limits)
    packed = zipped({f"monday/{path.name}": data, "monday/readme.txt": b"x"})
    assert check_digest(packed, limits) == digest
    for one in (data, packed):
        found = recording_of(one, digest)
        assert isinstance(found, SpatialRecording)
        assert found.name == f"session-{digest[:12]}"
        assert found.source == f"upload:{digest}"
        assert found.warnings == wanted.warnings
        assert found.odometry is not None
        assert wanted.odometry is not None
        assert found.clock is wanted.clock
        for name in ("landmark_id", "position_sensor_m", "rotation", "covariance_sensor_m2"):
            a, b = (getattr(item.detections, name) for item in (found, wanted))
            np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-9, err_msg=name)
        np.testing.assert_allclose(found.odometry.pose_world_robot, wanted.odometry.pose_world_robot, atol=1e-9)
        np.testing.assert_allclose(found.frames.stamp_s, wanted.frames.stamp_s, rtol=0.0, atol=1e-6)


def test_a_bag_of_several_files_is_read_by_its_metadata(bags: dict[str, Path]) -> None:
    folder = bags["mcap"].parent
    data = zipped({f"{folder.name}/{path.name}": path.read_bytes() for path in folder.iterdir()})
    found = recording_of(data, check_digest(data, UploadLimits()))
    assert len(found.detections) == len(read_bag(folder).detections)


@pytest.mark.parametrize("where", ["sqlite", pytest.param("postgresql", marks=pytest.mark.slow)], indirect=True)
def test_a_bag_is_uploaded_with_the_settings_of_its_robot(fleet: Fleet, bags: dict[str, Path]) -> None:
    data = bags["tags"].read_bytes()
    alone = fleet.upload(data).json()["id"]
    settings = bag_settings(bags["tags"]).replace("# [tags]\n# size_m = 0.16", "") + "[tags]\nsize_m = 0.2\n"
    whole = fleet.upload(zipped({"drive.mcap": data, "robot.toml": settings.encode()})).json()["id"]
    worker = fleet.worker(config=Config(living=LivingConfig(accept="weak")))  # it holds two tags
    while worker.step():
        pass
    told = fleet("GET", f"/jobs/{alone}").json()
    assert told["state"] == "rejected"
    assert "does not state the size of its tags" in told["reason"]
    assert "evermap-upload" not in told["reason"]
    assert fleet("GET", f"/jobs/{whole}").json()["state"] == "entered", fleet("GET", f"/jobs/{whole}").text
    assert {one["label"] for one in fleet("GET", "/maps/ward/landmarks").json()["landmarks"]} == {"3", "7"}


def test_a_bag_takes_no_more_than_its_share(
    bags: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sqlite3

    def refused(data: bytes, convert: str) -> str:
        with monkeypatch.context() as patched:
            patched.setattr(uploads, "_CONVERT", convert)
            with pytest.raises(InputError) as told:
                recording_of(data, check_digest(data, UploadLimits()))
        return told.value.problem

    usual = uploads._CONVERT
    endless = (
        "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x, 'a', 'ros2msg', 'b', 'c' FROM c"
    )
    with sqlite3.connect(tmp_path / "endless.db3") as database:
        database.executescript(f"""
            CREATE TABLE messages (id, topic_id, timestamp, data); CREATE TABLE topics (id, name, type);
            CREATE TABLE schema (schema_version); INSERT INTO schema VALUES (4);
            CREATE VIEW message_definitions (id, topic_type, encoding, encoded_message_definition,
            type_description_hash) AS {endless}
        """)
    told = refused((tmp_path / "endless.db3").read_bytes(), usual.replace(f"({uploads._BAG_CPU_S},", "(4,"))
    assert told.startswith("cannot be read as a bag")
    little = usual.replace(str(uploads._BAG_BYTES), "60000000")
    assert refused(bags["ros1"].read_bytes(), little)
    with pytest.raises(InputError, match="cannot be read as a bag"):
        recording_of(SQLITE, check_digest(SQLITE, UploadLimits()))


def test_a_refused_session_is_kept_with_its_reason(fleet: Fleet, zips: list[bytes]) -> None:
    broken = renamed(zips[0], lambda files: {**files, "day0/detections.csv": b"stamp_s,range_m\n1,x\n"})
    job = fleet.upload(broken).json()["id"]
    fleet.worker().step()
    told = fleet("GET", f"/jobs/{job}").json()
    assert told["state"] == "rejected"
    assert "detections.csv" in told["reason"]
    assert "/tmp" not in told["reason"]
    assert fleet("GET", f"/jobs/{job}/payload").content == broken
    assert fleet.upload(broken).json()["state"] == "rejected"
    assert fleet("POST", f"/jobs/{job}/retry").json()["state"] == "queued"
    assert fleet("POST", f"/jobs/{job}/retry").status_code == 409
    fleet.worker().step()
    assert fleet("GET", "/jobs?state=rejected").json()[0]["id"] == job


def test_tables_that_no_recording_has_are_not_unpacked(zips: list[bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []
    usual = zipfile.ZipFile.open

    def opened(self: zipfile.ZipFile, name: Any, *how: Any, **more: Any) -> Any:
        read.append(name.filename)
        return usual(self, name, *how, **more)

    more = renamed(zips[0], lambda files: {**files, "day0/foreign.csv": bytes(3_000_000), "day0/x.toml": b"a"})
    monkeypatch.setattr(zipfile.ZipFile, "open", opened)
    assert check_digest(more, UploadLimits()) == check_digest(zips[0], UploadLimits())
    assert read
    assert not any("foreign" in name or "x.toml" in name for name in read)


def test_a_session_is_unpacked_in_pieces(zips: list[bytes]) -> None:
    import tracemalloc

    large = renamed(zips[0], lambda files: {**files, "day0/frames.csv": bytes(200_000_000)})
    tracemalloc.start()
    check_digest(large, UploadLimits())
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 20_000_000


@SQLITE_ONLY
def test_few_uploads_are_unpacked_at_once(fleet: Fleet, zips: list[bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    now, most, lock = 0, 0, threading.Lock()

    def slowly(data: bytes, limits: UploadLimits) -> str:
        nonlocal now, most
        with lock:
            now += 1
            most = max(most, now)
        time.sleep(0.2)
        with lock:
            now -= 1
        return check_digest(data, limits)

    monkeypatch.setattr("evermap.server.app.check_digest", slowly)
    threads = [threading.Thread(target=fleet.upload, args=(zips[0], f"site-{k}")) for k in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == 2
    assert len(fleet("GET", "/jobs").json()) == 6
