"""`evermap track`: the example as it was made: its objects, spells and lifetimes; and mistakes in one line."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.runs import examples
from evermap.runs.track.lifetimes import read_lifetimes
from evermap.types import Clock

HOUR_S = 3600.0


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def yard(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the example as `detections.csv` and its run as `out`."""
    folder = tmp_path_factory.mktemp("yard")
    assert run("init", "detections", folder / "detections.csv").exit_code == 0
    result = run("track", folder / "detections.csv", "--range-m", "12", "--out", folder / "out")
    assert result.exit_code == 0, result.stderr
    return folder


def summary(folder: Path) -> Any:
    return json.loads((folder / "out" / "summary.json").read_text())


def rows(path: Path) -> Any:
    """A table of floats, nan where empty, and of words."""
    with path.open() as stream:
        names = next(csv.reader(stream))
    kinds = {"class_id": "U16", "state": "U16"}
    dtype = [(name, kinds.get(name, "f8")) for name in names]
    return np.genfromtxt(path, delimiter=",", skip_header=1, dtype=dtype, encoding="utf-8")


def true_stays() -> list[Any]:
    """Stays of the example during which the robot passed at least once."""
    random = np.random.default_rng(12)
    patrols = [24.0 * day + hour for day in range(4) for hour in range(8, 21, 2)]
    return [s for s in examples._stays(random) if any(s.begin_h <= patrol < s.end_h for patrol in patrols)]


def test_every_stay_is_a_spell_of_its_class_and_place(yard: Path) -> None:
    """One by one: each spell is a true stay, its bounds hold, and no stay is left over."""
    spells = rows(yard / "out" / "spells.csv")
    stays = true_stays()
    assert len(spells) == len(stays)
    left = list(stays)
    for spell in spells:
        mine = [
            s
            for s in left
            if s.kind == spell["class_id"]
            and np.hypot(s.place[0] - spell["x_m"], s.place[1] - spell["y_m"]) < 0.5
            and s.begin_h * HOUR_S <= spell["first_s"]
            and spell["last_s"] <= s.end_h * HOUR_S
        ]
        assert len(mine) == 1
        left.remove(mine[0])
        assert not spell["elsewhere_s"] > mine[0].begin_h * HOUR_S
        assert not spell["gone_s"] < mine[0].end_h * HOUR_S
    assert not left


def test_who_is_found_again_keeps_the_identity(yard: Path) -> None:
    tracks = rows(yard / "out" / "tracks.csv")
    pillars = tracks[tracks["class_id"] == "pillar"]
    assert len(np.unique(pillars["track_id"])) == 2
    assert np.ptp(pillars["stamp_s"]) > 3 * 24 * HOUR_S
    people = tracks[(tracks["class_id"] == "person") & (tracks["state"] == "alive")]
    assert np.median(people["vx_mps"]) == pytest.approx(-1.2, abs=0.1)


def test_detections_are_of_the_objects_that_they_are_near(yard: Path) -> None:
    """Object and detection are at the same place at the same time; the lines are those of the input."""
    text = (yard / "detections.csv").read_text().splitlines()
    found = rows(yard / "out" / "detections.csv")
    tracks = rows(yard / "out" / "tracks.csv")
    place = {(t["track_id"], t["stamp_s"]): (t["x_m"], t["y_m"], t["z_m"]) for t in tracks}
    distances = []
    for row in found[~np.isnan(found["track_id"])]:
        cells = text[int(row["line"]) - 1].split(",")
        assert float(cells[0]) == row["stamp_s"]
        where = place[int(row["track_id"]), row["stamp_s"]]
        distances.append(np.linalg.norm(np.array(cells[2:5], dtype=float) - where))
    assert len(distances) > 0.98 * len(found)
    assert np.quantile(distances, 0.99) < 0.5


def test_lifetimes_are_those_of_spells_whose_beginning_is_bounded(yard: Path) -> None:
    table = read_lifetimes(yard / "out" / "lifetimes.csv")
    classes = summary(yard)["classes"]
    for name, numbers in classes.items():
        mine = [k for k in range(len(table)) if table.class_names[table.class_of_row[k]] == name]
        assert table.data.weight[mine].sum() == pytest.approx(numbers["spells_with_lifetimes"])
    old = sum(stay.begin_h < 8.0 for stay in true_stays())  # there when the robot first came
    assert f"{old} spells" in summary(yard)["warnings"][0]
    assert sum(c["spells"] - c["spells_with_lifetimes"] for c in classes.values()) == old


def test_summary_counts_what_the_files_hold(yard: Path) -> None:
    counts = summary(yard)["counts"]
    tracks = rows(yard / "out" / "tracks.csv")
    assert counts["objects"] == len(np.unique(tracks["track_id"]))
    assert counts["spells"] == len(rows(yard / "out" / "spells.csv"))
    assert counts["gaps"] == 4 * 7 - 1
    assert counts["frames"] == 4 * 7 * 40
    assert summary(yard)["schema_version"] == "3"
    out = yard / "out"
    assert summary(yard)["outputs"] == sorted(str(path.relative_to(out)) for path in out.rglob("*") if path.is_file())


def test_parquet_says_what_csv_says(yard: Path) -> None:
    import pyarrow.parquet as pq

    table = pq.read_table(yard / "out" / "tracks.parquet")
    written = rows(yard / "out" / "tracks.csv")
    assert tuple(table.column_names) == written.dtype.names
    for name in table.column_names:
        assert table[name].to_pylist() == written[name].tolist()


def test_same_table_same_files(yard: Path, tmp_path: Path) -> None:
    result = run("track", yard / "detections.csv", "--range-m", "12", "--out", tmp_path / "again", "--json")
    assert result.exit_code == 0, result.stderr
    assert not (tmp_path / "again" / "scene.rrd").exists()
    for name in (
        "figures/objects.png",
        "tracks.csv",
        "detections.csv",
        "events.jsonl",
        "spells.csv",
        "lifetimes.csv",
        "tracks.parquet",
    ):
        assert (tmp_path / "again" / name).read_bytes() == (yard / "out" / name).read_bytes()
    assert json.loads(result.stdout)["counts"] == summary(yard)["counts"]


def test_lifetimes_have_dates_where_detections_have(yard: Path, tmp_path: Path) -> None:
    """The same four days as dates: the same lifetimes, with the instants from which their ages are counted."""
    head, *lines = (line for line in (yard / "detections.csv").read_text().splitlines() if not line.startswith("#"))
    start = np.datetime64("2026-03-02T00:00:00.000")
    cells = [line.split(",", 1) for line in lines]
    dated = [f"{start + np.timedelta64(round(1e3 * float(stamp)), 'ms')}Z,{rest}" for stamp, rest in cells]
    (tmp_path / "detections.csv").write_text("\n".join([head, *dated]) + "\n")
    result = run("track", tmp_path / "detections.csv", "--range-m", "12", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.stderr
    found, plain = (read_lifetimes(folder / "out" / "lifetimes.csv") for folder in (tmp_path, yard))
    assert plain.began_s is None
    assert found.clock is Clock.UNIX
    assert found.began_s is not None
    np.testing.assert_allclose(found.data.left_s, plain.data.left_s, atol=2e-3)
    last_s = rows(tmp_path / "out" / "spells.csv")["last_s"]
    assert np.abs((found.began_s + found.data.left_s)[:, None] - last_s).min(axis=1).max() < 2e-3


def test_survival_fit_takes_the_lifetimes(yard: Path) -> None:
    """Carts stay for five hours on average, pallets for twenty: some fifteen of each tell them apart."""
    result = run(
        "survival", "fit", yard / "out" / "lifetimes.csv", "--by", "class", "--estimator", "exponential", "--json"
    )
    assert result.exit_code == 0, result.stderr
    found = {group["class_id"]: group["mean_stay_s"] / HOUR_S for group in json.loads(result.stdout)["groups"]}
    assert found["cart"] == pytest.approx(5.0, rel=0.5)
    assert found["pallet"] == pytest.approx(20.0, rel=0.5)


def test_without_range_misses_count_for_nothing(yard: Path, tmp_path: Path) -> None:
    result = run("track", yard / "detections.csv", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.stderr
    assert "without --range-m" in result.stderr
    spells = rows(tmp_path / "out" / "spells.csv")
    pillars = spells[spells["class_id"] == "pillar"]
    assert np.isnan(pillars["gone_s"]).all()


FEW = "stamp_s,x_m,y_m,z_m,class_id\n" + "".join(f"{0.1 * k:.1f},1,2,3,car\n" for k in range(20))


@pytest.mark.parametrize(
    ("content", "options", "named"),
    [
        (FEW, ("--range-m", "5"), "field '--range-m': the position of the sensor is unknown"),
        (FEW, ("--range-m", "-5"), "field '--range-m': input should be greater than 0"),
        (FEW, ("--set", "gap_s=0"), "field 'track.gap_s': input should be greater than 0"),
        (FEW, ("--set", "min_score=2"), "field 'min_score': the table has no scores"),
        (FEW, ("--prior", "bus=never-leaves"), "no detection is of class 'bus' (try: one of car)"),
        (FEW, ("--prior", "exponentail:mean=1h"), "try: exponential"),
        (FEW, ("--set", "speeds_mps={bus=0.2}"), "no detection is of class 'bus'"),
        (FEW, ("--set", "warmup=2"), "field 'track.warmup': unknown key (try: track.warm_up)"),
        (FEW, ("--set", "warm_up=two"), "field 'track.warm_up': input should be a valid integer"),
        (FEW, ("--set", "p_detect=1.5"), "field 'track.p_detect': input should be less than 1, not 1.5"),
        (FEW, ("--set", "motion=circles"), "field 'track.motion'"),
        (FEW, ("--set", "warm_up"), "invalid setting 'warm_up'"),
        ("stamp_s,x_m,y_m,z_m\n1,2,3,4\n", (), "no object was seen often enough"),
        ("stamp_s,x_m,y_m\n1,2,3\n", (), "field 'z_m': missing column"),
    ],
)
def test_mistake_is_one_line_and_2(
    content: str, options: tuple[str, ...], named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("d.csv").write_text(content)
    result = run("track", "d.csv", "--out", "out", *options)
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    assert named in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["d.csv"]


def test_init_replaces_nothing_and_input_is_needed(tmp_path: Path) -> None:
    (tmp_path / "d.csv").write_text("mine")
    assert "exists already" in run("init", "detections", tmp_path / "d.csv").stderr
    assert (tmp_path / "d.csv").read_text() == "mine"
    result = run("track")
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
    assert "evermap init detections" in result.stderr
