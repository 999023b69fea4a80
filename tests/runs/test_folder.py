"""The run folder is whole or not there, and its numbers are reproducible."""

import dataclasses
import errno
import json
import sys
from hashlib import sha256
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from evermap.config import load_config
from evermap.errors import ConfigError, MissingExtraError
from evermap.io import read_prior_map
from evermap.io.tum import read_tum
from evermap.runs import folder as runfolder
from evermap.runs.folder import MANIFEST, RunFolder, check_output_file, check_replaceable, write_run
from evermap.runs.summary import RunInfo, summary_dict, timing_dict

sys.path.insert(0, str(Path(__file__).parents[1] / "metrics"))

INFO = RunInfo(command="evermap slam x", seeds={"slam": 0}, processing_s=2.0, total_s=3.0)


@pytest.fixture(scope="module")
def run():
    from synthetic_run import make_run

    return make_run(duration_s=120.0)


@pytest.fixture(scope="module")
def written(run, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "deep" / "first"
    return out, write_run(out, *run, load_config(), info=INFO)


def quick(out, run, **options):
    return write_run(out, *run, info=INFO, figures=False, report=False, scene=False, **options)


def leftovers(folder):
    return sorted(path.name for path in folder.iterdir() if path.name.startswith(".") and path.name != MANIFEST)


def listed(folder):
    return [path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()]


def test_everything_that_is_listed_is_there_and_nothing_else(written):
    out, summary = written
    there = sorted(path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file())
    assert there == summary["outputs"]
    listed = json.loads((out / MANIFEST).read_text())["files"]
    assert listed == {name: [sha256((out / name).read_bytes()).hexdigest()] for name in there if name != MANIFEST}
    assert {
        "summary.json",
        "trajectory.tum",
        "online.tum",
        "map.parquet",
        "map.geojson",
        "changes.jsonl",
        "innovations.parquet",
        "report.html",
        "figures/map.png",
        "figures/errors.svg",
    } <= set(there)
    assert leftovers(out.parent) == []
    assert json.loads((out / "summary.json").read_text()) == summary


def test_summary_has_its_contract(written, run):
    _, summary = written
    assert summary["schema_version"] == "3"
    assert summary["metrics"]["pose_rmse_m"] > 0
    assert summary["timing"]["real_time_factor"] == pytest.approx(np.ptp(run[0].frames.stamp_s) / 2.0)
    assert summary["timing"]["step_p99_ms"] == pytest.approx(1e3 * np.percentile(run[1].step_s, 99))
    assert summary["timing"]["peak_memory_mb"] > 0.0
    assert summary["counts"]["robot_sightings"] == 5
    assert summary["counts"]["frames"] == len(run[0].frames)
    assert summary["config"]["slam"]["robust"] is True
    assert summary["interrupted"] is False
    assert summary["warnings"][:2] == ["3 detections of unknown barcodes dropped", "12 detections treated as outliers"]
    assert summary["frames"]["world"].startswith("first_pose")
    fixed = next(p for p in summary["parameters"] if p["name"] == "mount_x_m")
    assert fixed["fixed"] is True
    assert fixed["prior_sigma"] is None


def test_files_hold_the_estimate(written, run):
    out, _ = written
    poses = read_tum(out / "trajectory.tum").pose_world_robot
    np.testing.assert_allclose(poses, run[1].trajectory.pose_world_robot, atol=1e-9)
    innovations = pq.read_table(out / "innovations.parquet")
    np.testing.assert_array_equal(innovations["nis"].to_numpy(), run[1].innovations.nis)
    np.testing.assert_array_equal(innovations["landmark_id"].to_numpy(), run[1].innovations.landmark_id)
    assert json.loads((out / "map.geojson").read_text())["type"] == "FeatureCollection"


def test_a_run_in_space_has_the_same_folder(written, tmp_path):
    from synthetic_run import make_spatial_run, with_spatial_changes

    recording, result = make_spatial_run()
    result = with_spatial_changes(result)
    out = tmp_path / "stair"
    summary = write_run(out, recording, result, load_config(), info=INFO)
    assert summary["outputs"] == written[1]["outputs"]
    assert summary["metrics"].keys() == written[1]["metrics"].keys()
    assert summary["counts"].keys() == written[1]["counts"].keys()
    rows = np.loadtxt(out / "trajectory.tum")
    np.testing.assert_allclose(rows[:, 1:], result.trajectory.pose_world_robot, atol=1e-9)
    innovations = pq.read_table(out / "innovations.parquet")
    np.testing.assert_array_equal(innovations["dof"].to_numpy(), result.innovations.dof)
    known = read_prior_map(out / "map.parquet", sigma_m=1.0)
    np.testing.assert_allclose(known.position_m, result.landmarks.position_m)
    np.testing.assert_allclose(known.covariance_m2, result.landmarks.covariance_m2)
    np.testing.assert_allclose(known.rotation, result.landmarks.rotation)
    told = [json.loads(text) for text in (out / "changes.jsonl").read_text().splitlines()]
    assert told == summary["changes"]


def test_the_same_run_gives_the_same_bytes_but_for_time(written, run, tmp_path):
    out, _ = written
    slower = RunInfo(command=INFO.command, seeds=INFO.seeds, processing_s=9.0)
    write_run(tmp_path / "second", *run, load_config(), info=slower)
    volatile = {MANIFEST, "summary.json", "report.html", "scene.rrd", "figures/latency.png", "figures/latency.svg"}
    for path in out.rglob("*"):
        name = path.relative_to(out).as_posix()
        if path.is_file() and name not in volatile:
            assert path.read_bytes() == (tmp_path / "second" / name).read_bytes(), name

    def without_time(folder):
        summary = json.loads((folder / "summary.json").read_text())
        del summary["timing"], summary["versions"]
        return runfolder.summary_text(summary)

    assert without_time(out) == without_time(tmp_path / "second")


def test_a_failure_in_the_middle_leaves_the_old_run_untouched(run, tmp_path, monkeypatch):
    out = tmp_path / "run"
    quick(out, run)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}

    def fail(*_):
        raise RuntimeError("power cut")

    monkeypatch.setattr(runfolder, "changes_text", fail)
    with pytest.raises(RuntimeError, match="power cut"):
        quick(out, run)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    assert leftovers(tmp_path) == []


@pytest.mark.parametrize("stop", [KeyboardInterrupt, OSError])
def test_an_interrupt_while_writing_leaves_nothing_half_done(stop, tmp_path):
    out = tmp_path / "run"

    def write_half():
        with RunFolder(out) as folder:
            folder.path("figures/map.png").write_bytes(b"half")
            raise stop

    with pytest.raises(stop):
        write_half()
    assert list(tmp_path.iterdir()) == []


def test_the_old_run_comes_back_if_the_new_one_cannot_take_its_place(run, tmp_path, monkeypatch):
    out = tmp_path / "run"
    quick(out, run)
    rename = Path.rename

    def refuse(self, target):
        if ".partial-" in self.name:
            raise PermissionError(13, "Permission denied", str(self))
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", refuse)
    with pytest.raises(ConfigError, match="cannot be written"):
        quick(out, run)
    assert (out / "summary.json").is_file()
    assert leftovers(tmp_path) == []


def test_a_new_run_replaces_the_old_one_completely(run, tmp_path):
    out = tmp_path / "run"
    write_run(out, *run, figures=True, report=False, scene=False)
    quick(out, run)
    assert not (out / "figures").exists()
    (out / "notes.txt").write_text("mine")
    with pytest.raises(ConfigError, match=r"notes\.txt.*`force`"):
        quick(out, run)
    assert (out / "notes.txt").read_text() == "mine"
    quick(out, run, force=True)
    assert (out / "notes.txt").read_text() == "mine"
    (out / "notes.txt").unlink()
    quick(out, run)
    assert sorted(listed(out)) == json.loads((out / "summary.json").read_text())["outputs"]


def test_only_run_folders_and_empty_ones_are_replaced(tmp_path, monkeypatch):
    check_replaceable(tmp_path / "new")
    (tmp_path / "empty").mkdir()
    check_replaceable(tmp_path / "empty")
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("x")
    with pytest.raises(ConfigError, match=r"chapter\.tex"):
        check_replaceable(tmp_path / "thesis")
    check_replaceable(tmp_path / "thesis", force=True)  # beside it
    with pytest.raises(ConfigError, match="is a file"):
        check_replaceable(tmp_path / "thesis" / "chapter.tex", force=True)
    (tmp_path / "thesis" / "summary.json").write_text('{"outputs": ["chapter.tex"]}')  # somebody else's summary
    with pytest.raises(ConfigError, match="no evermap run"):
        check_replaceable(tmp_path / "thesis")
    monkeypatch.chdir(tmp_path / "thesis")
    for danger in (".", "..", "/", "~"):
        with pytest.raises(ConfigError, match="working or home"):
            check_replaceable(danger, force=True)


def test_an_unwritable_place_is_one_line(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(ConfigError, match="cannot be written"):
        RunFolder(tmp_path / "file" / "run").__enter__()


def test_a_full_disk_is_one_line(run, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(runfolder, "changes_text", full)
    with pytest.raises(ConfigError, match="No space left"):
        quick(tmp_path / "run", run)
    assert list(tmp_path.iterdir()) == []


def test_symbolic_links_are_followed(run, tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    quick(tmp_path / "link", run)
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real" / "summary.json").is_file()


def test_without_rerun_a_configured_scene_is_a_remark_and_a_wanted_one_an_error(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    config = load_config(None, ["output.figures=false", "output.report=false", "output.rerun=true"])
    summary = write_run(tmp_path / "run", *run, config)
    assert "scene.rrd" not in summary["outputs"]
    assert any("evermap[rerun]" in warning for warning in summary["warnings"])
    with pytest.raises(MissingExtraError):
        write_run(tmp_path / "run", *run, figures=False, report=False, scene=True)
    assert (tmp_path / "run" / "summary.json").is_file()


def test_rerun_is_not_loaded_unless_a_scene_is_wanted(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    summary = write_run(tmp_path / "run", *run, figures=False, report=False)
    assert "scene.rrd" not in summary["outputs"]
    assert not any("rerun" in remark for remark in summary["warnings"])


def test_configuration_switches_outputs_off_and_sets_the_rate(run, tmp_path):
    config = load_config(
        None,
        ["output.figures=false", "output.report=false", "output.rerun=false", "output.score_rate_hz=1.0"],
    )
    summary = write_run(tmp_path / "run", *run, config)
    assert summary["metrics"]["alignment"]["rate_hz"] == 1.0
    assert not [name for name in summary["outputs"] if name.endswith((".png", ".html", ".rrd"))]


def test_changes_and_alternatives_are_kept_in_every_form(run, tmp_path):
    from synthetic_run import with_changes

    recording, result = run[0], with_changes(run[1])
    summary = quick(tmp_path / "run", (recording, result))
    ids = [list(change.landmark_ids) for change in result.changes]
    assert [change["landmarks"] for change in summary["changes"]] == ids
    first, second = summary["changes"][:2]
    assert first == {
        "landmarks": ids[0],
        "kind": "moved",
        "stamp_s": None,
        "decided_s": None,
        "stamp_from_s": None,
        "stamp_to_s": result.trajectory.stamp_s[0],
        "displacement_m": [-1.0, 0.0],
        "displacement_covariance_m2": None,
        "rotation_rad": 0.0,
        "probability": 0.97,
        "hits": 0,
        "misses": 0,
        "names": None,
    }
    assert (second["kind"], second["stamp_from_s"], second["rotation_rad"]) == ("rotated", 150.0, 0.35)
    lines = (tmp_path / "run" / "changes.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in lines] == summary["changes"]
    assert [a["probability"] for a in summary["alternatives"]] == [a.probability for a in result.alternatives]
    for rank, alternative in enumerate(result.alternatives, start=1):
        there = read_prior_map(tmp_path / "run" / f"alternative_{rank}.geojson")
        np.testing.assert_array_equal(there.position_m, alternative.landmarks.position_m)
        assert f"alternative_{rank}.geojson" in summary["outputs"]
    plain = quick(tmp_path / "run", run)
    assert (plain["changes"], plain["alternatives"]) == ([], [])
    assert (tmp_path / "run" / "changes.jsonl").read_text() == ""
    assert not (tmp_path / "run" / "alternative_1.geojson").exists()


def test_summary_of_an_interrupted_run_counts_what_was_done(run):
    recording, result = run
    online = result.online
    done = dataclasses.replace(
        online,
        stamp_s=online.stamp_s[:101],
        pose_world_robot=online.pose_world_robot[:101],
        covariance=online.covariance[:101],
    )
    part = dataclasses.replace(result, interrupted=True, step_s=result.step_s[:101], online=done)
    info = RunInfo(processing_s=1.0)
    summary = summary_dict(recording, part, {}, config={}, info=info, timing=timing_dict(recording, part, info))
    assert summary["interrupted"] is True
    assert summary["counts"]["frames_processed"] == 101
    expected = online.stamp_s[100] - online.stamp_s[0]
    assert summary["timing"]["real_time_factor"] == pytest.approx(expected)


# what belongs to the user


def snapshot(folder):
    """Names and contents of everything in a folder, links as what they say."""
    return {
        path.relative_to(folder).as_posix(): str(path.readlink()) if path.is_symlink() else path.read_bytes()
        for path in folder.rglob("*")
        if path.is_symlink() or not path.is_dir()
    }


def write(out, names, **options):
    with RunFolder(out, **options) as folder:
        for name, text in names.items():
            folder.path(name).write_text(text)


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize(
    ("out", "read"),
    [
        ("rec", "rec"),
        (".", "rec"),
        ("parent", "parent/rec"),
        ("parent", "parent/rec/odometry.csv"),
        ("rec", "parent/../rec"),
        ("parent/../rec", "rec"),
        ("link", "rec"),
        ("rec", "link"),
        ("rec", "linked/odometry.csv"),
        ("rec", "linked"),
        ("holds_link", "holds_link/rec"),
        ("new", "new/site.evermap"),
        ("hidden/../new", "new/site.evermap"),
    ],
)
def test_what_is_read_is_never_in_the_way(out, read, force, tmp_path, monkeypatch):
    base = tmp_path / "user"
    for folder in ("rec", "parent/rec", "holds_link", "linked"):
        (base / folder).mkdir(parents=True)
    for folder in ("rec", "parent/rec"):
        (base / folder / "odometry.csv").write_text("mine")
    (base / "link").symlink_to(base / "rec")
    (base / "holds_link" / "rec").symlink_to(base / "rec")
    (base / "linked" / "odometry.csv").symlink_to(base / "rec" / "odometry.csv")
    before = snapshot(base)
    monkeypatch.chdir(tmp_path)
    for name in (Path("user") / out, base / out):
        for source in (Path("user") / read, base / read):
            with pytest.raises(ConfigError, match="which this command reads"):
                write(name, {"map.csv": "new"}, force=force, inputs=[None, "", source])
    assert snapshot(base) == before


def test_an_output_of_evermap_that_is_read_is_not_replaced_either(tmp_path):
    write(tmp_path / "out", {"model.json": "learned"})
    with pytest.raises(ConfigError, match=r"model\.json.*reads"):
        check_replaceable(tmp_path / "out", inputs=[tmp_path / "out" / "model.json"])
    (tmp_path / "second").mkdir()
    (tmp_path / "second" / "model.json").hardlink_to(tmp_path / "out" / "model.json")
    write(tmp_path / "out", {"model.json": "again"}, inputs=[tmp_path / "second" / "model.json"])
    assert (tmp_path / "second" / "model.json").read_text() == "learned"


def test_files_of_the_user_stay_beside_a_forced_run(tmp_path):
    out = tmp_path / "out"
    write(out, {"summary.json": "1", "map.csv": "1", "figures/a.png": "1", "figures/b.png": "1"})
    mine = {"notes.txt": "mine", "figures/mine.png": "mine", "deep/er/x": "mine"}
    for name, text in mine.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(text)
    (out / "dangling").symlink_to("nowhere")
    (out / "empty").mkdir()
    inode = out.stat().st_ino
    with pytest.raises(ConfigError, match="`force` to keep it and write into the folder"):
        write(out, {"map.csv": "2"})
    new = {"summary.json": "2", "map.csv": "2", "figures/b.png": "2"}
    write(out, new, force=True)
    there = snapshot(out)
    there.pop(MANIFEST)
    assert there == {name: text.encode() for name, text in (mine | new).items()} | {"dangling": "nowhere"}
    assert out.stat().st_ino == inode  # the user's folder itself stays, too
    assert (out / "empty").is_dir()
    assert leftovers(tmp_path) == leftovers(out) == []
    for name in mine:
        (out / name).unlink()
    (out / "dangling").unlink()
    write(out, {"map.csv": "3"})
    assert sorted(snapshot(out)) == [MANIFEST, "map.csv"]


@pytest.mark.parametrize("force", [False, True])
def test_a_file_that_was_changed_since_is_the_user_s(force, tmp_path):
    out = tmp_path / "out"
    write(out, {"map.evermap": "one session", "summary.json": "1"})
    (out / "map.evermap").write_text("forty sessions")
    with pytest.raises(ConfigError, match=r"map\.evermap', which was changed since"):
        write(out, {"map.evermap": "one session"}, force=force)
    assert (out / "map.evermap").read_text() == "forty sessions"


@pytest.mark.parametrize("theirs", ["map.csv", "figures", "figures/a.png/x", "summary.json"])
def test_a_file_in_the_way_stays_and_the_new_run_is_put_beside(theirs, tmp_path):
    out = tmp_path / "out"
    (out / theirs).parent.mkdir(parents=True)
    (out / theirs).write_text("mine")
    new = {"map.csv": "new", "figures/a.png": "new", "summary.json": "new"}
    with pytest.raises(ConfigError, match="contains '") as refused:
        write(out, new, force=True)
    assert snapshot(out) == {theirs: b"mine"}
    if theirs != "summary.json":  # that one is known before the run
        assert str(tmp_path / "out-2") in refused.value.one_line()
        assert snapshot(tmp_path / "out-2").keys() - {MANIFEST} == new.keys()
    assert leftovers(tmp_path) == []


def test_what_appears_during_a_run_is_not_lost_nor_is_the_run(tmp_path):
    out = tmp_path / "out"
    write(out, {"map.csv": "1"})

    def run():
        with RunFolder(out) as folder:
            folder.path("map.csv").write_text("2")
            (out / "notes.txt").write_text("written meanwhile")

    with pytest.raises(ConfigError, match="new results are in"):
        run()
    assert (out / "notes.txt").read_text() == "written meanwhile"
    assert (out / "map.csv").read_text() == "1"
    assert (tmp_path / "out-2" / "map.csv").read_text() == "2"


@pytest.mark.parametrize("crash_at", range(1, 8))
def test_a_crash_between_any_two_steps_loses_nothing(crash_at, tmp_path, monkeypatch):
    """Beside files of the user each file is old or new, whole, and known as evermap's to the next run."""
    out = tmp_path / "out"
    old = {"summary.json": "old", "a.csv": "old", "gone.csv": "old"}
    write(out, old)
    (out / "notes.txt").write_text("mine")
    calls = []
    replace = Path.replace

    def crashing(self, target):
        calls.append(target)
        if len(calls) == crash_at:
            raise RuntimeError("power cut")
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", crashing)
    new = {"summary.json": "new", "a.csv": "new", "b.csv": "new"}
    try:
        write(out, new, force=True)
        assert len(calls) < crash_at
    except RuntimeError:
        pass
    monkeypatch.undo()
    assert (out / "notes.txt").read_text() == "mine"
    for name in old.keys() | new.keys():
        if (out / name).exists():
            assert (out / name).read_text() in {old.get(name), new.get(name)}
    (out / "notes.txt").unlink()
    write(out, new)  # nothing but evermap's is left
    assert snapshot(out).keys() - {MANIFEST} == new.keys()


def test_an_older_evermap_s_run_is_replaced_but_not_its_map(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "map.csv").write_text("1")
    listed = {"evermap": "0.1.0", "schema_version": "1", "outputs": ["map.csv", "summary.json", "map.evermap"]}
    (out / "summary.json").write_text(json.dumps(listed))
    check_replaceable(out)
    (out / "map.evermap").write_text("forty sessions")
    with pytest.raises(ConfigError, match=r"map\.evermap"):
        check_replaceable(out)


def test_outputs_that_are_no_runs_are_replaced_on_request_only(tmp_path):
    out = tmp_path / "recordings"
    write(out, {"day0/odometry.csv": "1"}, renew=False)
    with pytest.raises(ConfigError, match="is not empty"):
        write(out, {"day0/odometry.csv": "2"}, renew=False)
    write(out, {"day1/odometry.csv": "2"}, renew=False, force=True)
    assert snapshot(out).keys() == {MANIFEST, "day1/odometry.csv"}


def test_a_folder_beside_which_nothing_can_be_written_is_filled_in_place(tmp_path, monkeypatch):
    out = tmp_path / "mounted"
    out.mkdir()
    monkeypatch.setattr(Path, "is_mount", lambda self: self == out)
    for text in ("1", "2"):
        write(out, {"map.csv": text, f"only_{text}.csv": text})
    assert snapshot(out).keys() == {MANIFEST, "map.csv", "only_2.csv"}
    assert [path.name for path in tmp_path.iterdir()] == ["mounted"]


def test_a_single_output_file_is_no_input_and_no_map(tmp_path):
    (tmp_path / "looks.csv").write_text("mine")
    (tmp_path / "link.csv").symlink_to(tmp_path / "looks.csv")
    for path in ("looks.csv", "link.csv"):
        with pytest.raises(ConfigError, match="is the input of this command"):
            check_output_file(tmp_path / path, inputs=[tmp_path / "looks.csv"])
    (tmp_path / "site.png").write_bytes(b"SQLite format 3\0...")
    with pytest.raises(ConfigError, match="living map"):
        check_output_file(tmp_path / "site.png")
    with pytest.raises(ConfigError, match=r"not a \.json"):
        check_output_file(tmp_path / "looks.csv", ending=".json")
    check_output_file(tmp_path / "new.csv", inputs=[tmp_path / "looks.csv"], ending=".json")
