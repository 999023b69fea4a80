"""`evermap map`: what each command prints and writes, and mistakes in one line."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from random_maps import random_changes, random_evidence, random_map
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.errors import InputError
from evermap.io import read_landmarks
from evermap.maps.diff import diff
from evermap.maps.store import Provenance, open_store

MAPS = [random_map(seed, cliques=5, stamp_s=86400.0 * (seed + 1)) for seed in range(3)]


def run(*arguments: str | Path | int) -> Result:
    return CliRunner().invoke(app, ["map", *(str(argument) for argument in arguments)])


def said(*arguments: str | Path | int) -> Any:
    """What a command prints with `--json`."""
    result = run(*arguments, "--json")
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("map") / "site.evermap"
    with open_store(path, create=True) as store:
        for seed, living in enumerate(MAPS):
            origin = Provenance(
                recording=f"day {seed}",
                source="/data",
                command="evermap slam",
                config="[slam]",
                seed=4,
                stamp_from_s=86400.0 * seed,
                stamp_to_s=86400.0 * seed + 60.0,
                wall_s=2.5,
            )
            changes = random_changes(seed, living)
            store.commit(living, origin, changes, random_evidence(seed, living), parent=seed)
    return path


@pytest.fixture
def site(template: Path, tmp_path: Path) -> Path:
    """A map of three sessions."""
    return Path(shutil.copy(template, tmp_path / "site.evermap"))


def test_log_has_a_line_for_every_revision(site: Path) -> None:
    lines = run("log", site).stdout.splitlines()
    assert len(lines) == 2 + 3
    assert lines[1].split()[:2] == ["revision", "written"]
    existing = int(np.sum((MAPS[2].p_exists() >= 0.5) & ~MAPS[2].members.deleted))
    assert lines[4].split()[0] == "3"
    for part in ("session", "day 2", "day 2 00:00:00", f"{existing} of {len(MAPS[2].members)}", "1 moved", "2.5 s"):
        assert part in lines[4]
    listed = said("log", site)
    assert listed["head"] == 3
    assert [item["revision"] for item in listed["revisions"]] == [1, 2, 3]
    third = listed["revisions"][2]
    assert (third["recording"], third["source"], third["seed"], third["config"]) == ("day 2", "/data", 4, "[slam]")
    assert third["changes"] == {"appeared": 1, "moved": 1}
    assert third["grown"] == len(said("diff", site, 2, 3)["grown"])
    assert third["existing"] == existing


def test_show_lists_what_exists(site: Path) -> None:
    content = said("show", site)
    living = MAPS[2]
    assert (content["revision"], content["ahead_s"]) == (3, 86400.0)
    assert [item["landmark"] for item in content["landmarks"]] == living.members.landmark_id.tolist()
    np.testing.assert_allclose([item["p_exists"] for item in content["landmarks"]], living.p_exists())
    records = living.landmarks()
    by_id = {item["landmark"]: item for item in content["landmarks"]}
    for k, name in enumerate(records.landmark_id.tolist()):
        item = by_id[name]
        assert (item["x_m"], item["y_m"]) == tuple(records.position_m[k])
        assert item["sigma_m"] == pytest.approx(np.sqrt(np.trace(records.covariance_m2[k]) / 2))
        assert (item["hits"], item["seen_s"]) == (records.n_hits[k], records.last_seen_s[k])
    shown = [line.split()[0] for line in run("show", site).stdout.splitlines()[2:]]
    wanted = [n for n, i in by_id.items() if i["pinned"] or (i["p_exists"] >= 0.5 and not i["deleted"])]
    assert shown == [str(n) for n in wanted]
    assert len(run("show", site, "--all").stdout.splitlines()) == 2 + len(by_id)
    assert said("show", site, "--revision", 0)["landmarks"] == []


def test_show_foretells_less_the_longer_ahead(site: Path) -> None:
    """Of what stands, less is left after a month than after a minute; after no time nothing has changed."""
    soon = {i["landmark"]: i for i in said("show", site, "--ahead", "1s")["landmarks"]}
    late = {i["landmark"]: i for i in said("show", site, "--ahead", "1y")["landmarks"]}
    standing = [n for n, i in soon.items() if i["p_exists"] > 0.7]
    assert standing
    for name in standing:
        assert soon[name]["p_ahead"] == pytest.approx(soon[name]["p_exists"], abs=0.05)
        assert late[name]["p_ahead"] < soon[name]["p_ahead"]


def test_show_tells_lifetimes_of_every_class_and_chunk(site: Path) -> None:
    from evermap.survival.text import parse_prior

    lives = MAPS[-1].lives
    told = said("show", site)["lifetimes"]
    assert len(told) == len(lives.life) > 0
    for one, chunk, life in zip(told, lives.chunk.tolist(), lives.life, strict=True):
        assert one["chunk"] in (None, chunk)
        assert (one["stays"], one["stays_that_ended"]) == (life.n_stays, life.n_ended)
        assert parse_prior(one["stay"]).quantile(0.5) == pytest.approx(life.stay.quantile(0.5), rel=1e-6)
        assert one["half_gone_s"] is None or one["half_gone_s"] > 0.0


def test_landmarks_at_a_time_and_within_a_box() -> None:
    living = MAPS[2]
    now, later = living.landmarks(), living.landmarks(at=living.stamp_s + 30 * 86400.0)
    np.testing.assert_array_equal(now.landmark_id, later.landmark_id)
    np.testing.assert_allclose(living.landmarks(at=living.stamp_s).p_exists, now.p_exists, atol=1e-9)
    assert np.all(later.p_exists[now.p_exists > 0.7] < now.p_exists[now.p_exists > 0.7])
    low, high = np.quantile(now.position_m, [0.2, 0.8], axis=0)
    inside = ((now.position_m >= low) & (now.position_m <= high)).all(axis=1)
    found = living.landmarks(within=(*low, *high), p_least=0.3)
    assert found.landmark_id.tolist() == now.landmark_id[inside & (now.p_exists >= 0.3)].tolist()
    with pytest.raises(InputError, match="before the map's newest look"):
        living.landmarks(at=living.stamp_s - 1.0)
    with pytest.raises(InputError, match="not a box"):
        living.landmarks(within=(1.0, 0.0, 0.0, 1.0))


def test_maps_stores_differences_and_answers_show_themselves(site: Path) -> None:
    import evermap as em

    with em.open_store(site) as store:
        living, found = store.load(), em.diff(store, 1)
        answer = em.why(store, int(living.members.landmark_id[0]))
        for shown in (store, living, living.sites, found, answer):
            assert len(repr(shown)) < 1000
            assert "\n" not in repr(shown)
            assert shown._repr_html_().startswith("<table>")
        assert "revisions=3" in repr(store)
        assert f"landmarks={len(living.members)}" in repr(living)
        assert len(living.to_pandas()) == len(living.landmarks())
        assert living.sites.to_pandas()["p_here"].tolist() == living.sites.p_here.tolist()
        assert len(found.to_pandas()) == len(found.changes)
        log = store.to_pandas()
        assert log["number"].tolist() == [1, 2, 3]
        assert log["moved"].tolist() == [1, 1, 1]
        assert living.plot(title="here").axes
        assert store.plot().axes


def test_diff_lists_changes_and_edits(site: Path) -> None:
    run("pin", site, int(MAPS[2].members.landmark_id[0]))
    content = said("diff", site, 1)
    with open_store(site) as store:
        wanted, first = diff(store, 1), diff(store, 0, 1)
    assert (content["a"], content["b"]) == (1, 4)
    assert [(c["landmarks"], c["kind"]) for c in content["changes"]] == [
        (list(c.landmark_ids), c.kind.value) for c in wanted.changes
    ]
    assert content["grown"] == wanted.grown.tolist()
    assert {"landmark": int(MAPS[2].members.landmark_id[0]), "what": "pinned"} in said("diff", site, 3)["edits"]
    lines = run("diff", site, 0, 1).stdout.splitlines()
    assert len(lines) == len(first.changes) + 1
    assert all("hits" in line for line in lines[:-1])
    assert lines[-1].startswith(f"the map grew by {len(first.grown)} landmarks: ")
    assert "no difference between revisions 2 and 2" in run("diff", site, 2, 2).stderr


def test_an_edit_is_a_revision_that_can_be_reverted(site: Path) -> None:
    one, two = (int(name) for name in np.flatnonzero(~MAPS[2].members.deleted)[:2])
    one, two = (int(MAPS[2].members.landmark_id[row]) for row in (one, two))
    done = said("delete", site, one, two, "--note", "a mirror")
    assert done == {"map": str(site), "revision": 4, "parent": 3, "deleted": sorted([one, two])}
    store = open_store(site)
    assert not np.isin([one, two], store.load().landmarks().landmark_id).any()
    assert store.log()[-1].provenance.note == f"deleted landmarks {one}, {two}: a mirror"
    again = run("delete", site, one)
    assert again.exit_code == 0
    assert "nothing to do: already deleted" in again.stderr
    assert store.head() == 4
    assert f"revision 5: undeleted landmark {one}; undo with: evermap map revert" in run("undelete", site, one).stderr
    assert said("revert", site, 3)["restores"] == 3
    assert np.isin([one, two], store.load().landmarks().landmark_id).all()
    assert store.head() == 6
    free = int(MAPS[2].members.landmark_id[~MAPS[2].members.pinned][0])
    for word, pinned in (("pin", True), ("unpin", False)):
        assert run(word, site, free).exit_code == 0
        members = store.load().members
        assert members.pinned[members.landmark_id == free] == [pinned]


def test_export_for_nav2(site: Path, tmp_path: Path) -> None:
    told = said("nav2", site, "--out", tmp_path / "speed.yaml", "--speed-mask", "--ahead", "3d", "--cell-m", 0.5)
    living = MAPS[2]
    now, then = living.landmarks(), living.landmarks(at=living.stamp_s + 3 * 86_400.0)
    wrong = np.where(now.p_exists >= 0.5, 1.0 - then.p_exists, then.p_exists)
    assert told["p_wrong"] == {str(k): p for k, p in zip(now.landmark_id.tolist(), wrong.tolist(), strict=True)}
    assert (tmp_path / "speed.pgm").is_file()
    sure = int(np.argmax(now.p_exists))
    ends = now.position_m[sure, :2] + np.array([[-1.0, 0.0], [1.0, 0.0]])
    nodes = [
        {"type": "Feature", "properties": {"id": k}, "geometry": {"type": "Point", "coordinates": at}}
        for k, at in enumerate(ends.tolist())
    ]
    line = {"type": "LineString", "coordinates": ends.tolist()}
    way = {"type": "Feature", "properties": {"id": 9, "startid": 0, "endid": 1}, "geometry": line}
    (tmp_path / "in.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [*nodes, way]}))
    told = said("nav2", site, "--out", tmp_path / "open.geojson", "--route-graph", tmp_path / "in.geojson")
    assert told["closed"] == [9]
    assert len(json.loads((tmp_path / "open.geojson").read_text())["features"]) == 2


@pytest.mark.parametrize("ending", ["parquet", "geojson", "csv"])
def test_export_reads_back_as_the_map(site: Path, tmp_path: Path, ending: str) -> None:
    out = tmp_path / f"map.{ending}"
    said("export", site, "--out", out, "--revision", 2)
    wanted, read = MAPS[1].landmarks(p_least=0.5), read_landmarks(out)
    assert read.landmark_id.tolist() == wanted.landmark_id.tolist()
    for name in ("position_m", "covariance_m2", "p_exists", "last_seen_s"):
        np.testing.assert_array_equal(getattr(read, name), getattr(wanted, name))
    assert said("export", site, "--out", out, "--p-least", 0.0, "--force")["landmarks"] == len(MAPS[2].landmarks())
    if ending == "csv":
        with out.open() as stream:
            assert set(next(csv.DictReader(stream))["class_id"]) <= set("palletcart")


def test_why_with_figure_and_json(site: Path, tmp_path: Path) -> None:
    name = int(MAPS[2].members.landmark_id[0])
    lines = run("why", site, name).stdout.splitlines()
    assert lines[0].startswith(f"landmark {name} ")
    content = said("why", site, name, "--figure", tmp_path / "why.png")
    assert (tmp_path / "why.png").read_bytes()[:4] == b"\x89PNG"
    clique = int(MAPS[2].members.clique_id[0])
    seen = random_evidence(2, MAPS[2])
    seen = seen[seen.clique_id == clique]
    session = content["sessions"][-1]
    assert (session["revision"], session["hits"], session["misses"]) == (3, seen.n_hits.sum(), seen.n_misses.sum())
    assert session["log_odds"] == pytest.approx(seen.log_odds.sum(), rel=1e-5)
    assert content["looks"]["stamp_s"][-len(seen) :] == seen.stamp_s.tolist()


def test_gc_prunes_old_revisions(site: Path, tmp_path: Path) -> None:
    landmark = int(MAPS[2].members.landmark_id[0])
    assert run("pin", site, landmark, "--note", "surveyed").exit_code == 0
    assert run("unpin", site, landmark).exit_code == 0
    asked = [("log", site), ("why", site, landmark), ("show", site), ("diff", site, 4, 5)]
    before, size, data = [run(*one).stdout for one in asked], site.stat().st_size, site.read_bytes()
    assert "an operator pinned it in revision 4" in before[1]

    plan = run("gc", site, "--keep", 2, "--dry-run")
    assert plan.exit_code == 0
    assert plan.stderr.startswith("evermap: would be pruned: the content of 1 to 3 (")
    assert site.read_bytes() == data
    planned, done = said("gc", site, "--keep", 2, "--dry-run"), said("gc", site, "--keep", 2)
    assert planned == {**done, "dry_run": True}
    assert (done["pruned"], done["kept"]) == ([1, 2, 3], [4, 5])
    assert site.stat().st_size <= size - done["bytes"]
    assert run("gc", site).stderr == "evermap: nothing to prune: 2 revisions have content\n"

    assert [run(*one).stdout for one in asked] == before
    checked = run("verify", site)
    assert checked.exit_code == 0
    assert "all 5 revisions are intact" in checked.stderr
    assert "; the content of 1 to 3 is pruned" in checked.stderr
    assert said("verify", site)["pruned"] == [1, 2, 3]
    out = tmp_path / "map.csv"
    for use in (
        ("show", site, "--revision", 2),
        ("diff", site, 2),
        ("diff", site, 5, 2),
        ("export", site, "--out", out, "--revision", 2),
        ("why", site, landmark, "--revision", 2),
        ("revert", site, 2),
    ):
        result = run(*use)
        assert result.exit_code == 2
        assert result.stdout == ""
        (line,) = result.stderr.splitlines()
        assert "the content of revision 2 is pruned since 20" in line
        assert " UTC; kept: 4, 5 (try: " in line
    assert not out.exists()
    assert run("gc", site, "--keep", 0).exit_code == 2


def test_compact_tells_what_it_saved(site: Path) -> None:
    landmark, size = int(MAPS[2].members.landmark_id[0]), site.stat().st_size
    asked = [("log", site), ("why", site, landmark), ("show", site, "--revision", 1), ("diff", site, 1, 3)]
    before = [run(*one).stdout for one in asked]
    done = said("compact", site)
    assert done == {"map": str(site), "bytes_before": size, "bytes": site.stat().st_size}
    assert [run(*one).stdout for one in asked] == before
    assert run("compact", site).stderr.startswith(f"evermap: {site}: ")
    refused = run("compact", "postgresql://nowhere/fleet/site")
    assert refused.exit_code == 2
    assert "VACUUM FULL" in refused.stderr


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (
            ("log", "nowhere.evermap"),
            "nowhere.evermap: no such map (try: evermap map enter nowhere.evermap INPUT starts",
        ),
        (("show", "SITE", "--revision", "9"), "no revision 9; it has 3 of them (try: evermap map log"),
        (("diff", "SITE", "9"), "no revision 9"),
        (("revert", "SITE", "3"), "revision 3 is the newest already"),
        (("why", "SITE", "-1"), "no such option"),
        (("why", "SITE", "9999"), "no landmark 9999; the nearest ids are"),
        (("pin", "SITE", "9999"), "no landmark 9999 in revision 3 (try: evermap map show"),
        (
            ("export", "SITE", "--out", "map.png"),
            "map.png: cannot write a '.png' map (try: parquet, wpilib",
        ),
        (("nav2", "SITE", "--out", "s.csv", "--speed-mask"), "s.csv: field '--speed-mask': is an image"),
        (("nav2", "SITE", "--out", "s.csv", "--route-graph", "g"), "s.csv: field '--route-graph': is written as Geo"),
        (("nav2", "SITE", "--out", "s.json", "--route-graph", "no"), "no: cannot be read: No such file"),
        (("show", "SITE", "--figure", "map.pdf"), "cannot draw a '.pdf' file"),
        (("show", "SITE", "--ahead", "3"), "'3' has no unit"),
    ],
)
def test_mistakes_are_one_line(site: Path, arguments: tuple[str, ...], line: str) -> None:
    result = run(*(site if word == "SITE" else word for word in arguments))
    assert result.exit_code == 2
    assert result.stdout == ""
    (said_,) = result.stderr.splitlines()
    assert line.lower() in said_.lower()
    assert open_store(site).head() == 3
