"""The contenders do the same work, and the baseline can be trusted. No time is asserted."""

from __future__ import annotations

import importlib
import json
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import typer
from scipy.spatial import KDTree
from typer.testing import CliRunner

import evermap_studies.commands
from evermap.cli.bench import load_benchmarks
from evermap.errors import InputError
from evermap.existence import single
from evermap.geometry import se2
from evermap.survival import Exponential
from evermap.survival.censored import CensoredLifetimes
from evermap.tracking import kalman
from evermap_studies.lifetimes.tracking_scores import score_tracks

SMALL = 150
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def run() -> ModuleType:
    return load_benchmarks()


@pytest.fixture(scope="module")
def worlds(run: ModuleType) -> dict[bool, Any]:
    return {calibrated: run.circular_world(SMALL, calibrated=calibrated) for calibrated in (False, True)}


def apart(one: Any, other: Any) -> float:
    """Largest distance between two answers' poses and landmarks [m]."""
    both = zip((one.pose[:, :2], one.landmark), (other.pose[:, :2], other.landmark), strict=True)
    return max(float(np.nanmax(np.linalg.norm(a - b, axis=1))) for a, b in both)


@pytest.mark.slow
@pytest.mark.parametrize("race", ["isam2", "batch"])
def test_contenders_find_the_same_positions(run: ModuleType, worlds: dict[bool, Any], race: str) -> None:
    ours, theirs = (contender(worlds[False]) for contender in run.CONTENDERS[race])
    assert apart(ours, theirs) < 0.01
    np.testing.assert_array_equal(np.isfinite(ours.landmark), np.isfinite(theirs.landmark))


@pytest.mark.slow
def test_both_batch_contenders_reach_the_same_uncertainty(run: ModuleType, worlds: dict[bool, Any]) -> None:
    ours, theirs = (contender(worlds[False]) for contender in run.CONTENDERS["batch"])
    scale = np.abs(theirs.pose_covariance).max()
    np.testing.assert_allclose(ours.pose_covariance, theirs.pose_covariance, atol=0.01 * scale)


def test_streaming_and_batch_agree(run: ModuleType, worlds: dict[bool, Any]) -> None:
    """As far as they can: iSAM2 lets values drift by its threshold before it linearises anew."""
    assert apart(run.CONTENDERS["isam2"][1](worlds[False]), run.CONTENDERS["batch"][1](worlds[False])) < 0.05


@pytest.mark.slow
def test_free_calibration_explains_the_readings_no_worse(run: ModuleType, worlds: dict[bool, Any]) -> None:
    """With nominal sensors the calibrated answer is as near to the truth as the other, give or take its own doubt."""
    world = worlds[True]
    ours, theirs = (contender(world) for contender in run.CONTENDERS["isam2"])
    off = [np.linalg.norm(answer.pose[:, :2] - world.pose[:, :2], axis=1).mean() for answer in (ours, theirs)]
    assert off[0] < 2.0 * off[1] + 0.05


@pytest.mark.parametrize("exponential", [True, False])
def test_rosen_s_algorithm_and_the_filter_believe_the_same(run: ModuleType, exponential: bool) -> None:
    """Every contender of a case, from the same state: all give the belief at the horizon."""
    case = (run.persistence.exponential if exponential else run.persistence.general_purpose)(3000)
    expected = case.peers["numpy"]()
    assert 0.05 < np.std(expected) < 0.5
    for work in (case.work, case.spread, case.peers["numba"]):
        np.testing.assert_allclose(work(), expected, rtol=1e-8, atol=1e-12)


def test_one_feature_and_rosen_s_algorithm_believe_the_same(run: ModuleType) -> None:
    for make in (run.persistence.one_exponential, run.persistence.one_general_purpose):
        case = make(5000)
        assert case.work() == pytest.approx(case.peers["Python"](), abs=1e-9)


@pytest.mark.slow
def test_selectors_of_the_race_are_after_the_same_sequence(run: ModuleType) -> None:
    looks = run.selectors.landmarks(30)
    joint = {
        name: selector.select(looks, run.selectors.CHAIN, np.random.default_rng(0)).log_joint
        for name, selector in run.selectors.contenders().items()
    }
    for name in ("em", "mcts"):
        assert (joint[name] <= joint["viterbi"] + 1e-9).all()
        assert np.mean(joint[name] >= joint["viterbi"] - 1e-9) >= 0.5


def test_filters_of_cliques_in_the_race_believe_the_same(run: ModuleType) -> None:
    """The clique filter and its peer in arrays; and Rosen's algorithm what is right for each landmark by itself."""
    scene = run.cliques.world(40)
    ours, theirs, one_by_one = (
        make(scene) for make in (run.cliques.by_jcf, run.cliques.by_arrays, run.cliques.by_rosen)
    )
    alone = single.init(len(scene.clique), Exponential(run.cliques.RATE_HZ))
    for n in range(12):
        np.testing.assert_allclose(theirs(), ours(), rtol=1e-9)
        detected = scene.detected[n % len(scene.detected)]
        alone = alone.update(n + 1.0, detected, run.cliques.P_MISS, run.cliques.P_FALSE)
        np.testing.assert_allclose(one_by_one(), alone.probability, atol=1e-9)
    assert np.ptp(ours()) > 5.0


def test_lifetimes_of_the_race_are_as_probable_by_the_peer(run: ModuleType) -> None:
    """Both survival functions at the ends of the cells, where they are determined."""
    for draw in run.npmle.DATA.values():
        left, right = draw(200, np.random.default_rng(1))
        ours = run.npmle.npmle(CensoredLifetimes.of(left, right))
        ends = ours.support_right[np.isfinite(ours.support_right)]
        ends = ends[ends < ours.support_left[-1]]
        theirs = run.npmle.by_surpyval(left, right).sf(ends, interp="step")
        np.testing.assert_allclose(ours.survival(ends)[1], theirs, atol=1e-6)


def test_the_peer_of_the_tracker_filters_as_ours_does(run: ModuleType) -> None:
    """One object in both: the same mean, frame after frame, with constant velocity and the same noise."""
    race = run.tracking
    frame_s, sigma_m = race.FRAME_S, race.SIGMA_M
    peer = race.Sort(frame_s, sigma_m, race.MAX_AGE)
    mean, covariance = np.zeros((1, 6)), np.diag([sigma_m**2] * 3 + [1.0] * 3)[None]
    rng = np.random.default_rng(0)
    for k in range(30):
        point = rng.normal([0.05 * k, 0.0, 1.0], 0.1)
        reports = peer.step(point[None])
        if k == 0:
            mean[0, :3] = point
        else:
            kalman.predict(mean, covariance, 1, frame_s, 0.1)
            kalman.update(mean[0], covariance[0], point, sigma_m**2 * np.eye(3))
        assert reports.track_id.tolist() == [0]
        np.testing.assert_allclose(reports.position_m, mean[:, :3], rtol=1e-9)


@pytest.mark.slow
def test_trackers_of_the_race_are_judged_as_our_own_scores_are(run: ModuleType) -> None:
    race = run.tracking
    scene = race.Scene(27, 3.0, 1)
    recording = race.draw(scene, 5, 40)
    everyone = np.arange(scene.n)
    truth = [(everyone, there) for there in recording.truth_m]
    assert race.judge(recording, truth) == {"mota": 1.0, "idf1": 1.0, "switches": 0.0}
    for done in (race.by_evermap(scene, recording), race.by_sort(recording)):
        for reported in (done.at_once, done.afterwards):
            ours = score_tracks(truth, reported, race.MATCH_M)
            expected = {"mota": ours.mota, "idf1": ours.idf1, "switches": ours.switches}
            assert race.judge(recording, reported) == pytest.approx(expected, abs=1e-9)
            assert ours.mota > 0.8


def test_scenes_for_trackers_are_what_they_say(run: ModuleType) -> None:
    race = run.tracking
    scene = race.SCENES["1000"]
    recording = race.draw(scene, 3, 50)
    speed = np.linalg.norm(np.diff(recording.truth_m, axis=0), axis=2) / race.FRAME_S
    assert speed.max() <= 2.0 + 1e-9
    assert speed[0].mean() == pytest.approx(1.0, abs=0.1)
    assert np.mean([len(points) for points in recording.detected_m]) == pytest.approx(950.0, rel=0.01)
    distance = KDTree(recording.truth_m[0]).query(recording.detected_m[0])[0]
    near = distance[distance < 5.0 * race.SIGMA_M]
    assert np.mean(near**2) == pytest.approx(3.0 * race.SIGMA_M**2, rel=0.1)
    gaps = KDTree(recording.truth_m[0]).query(recording.truth_m[0], 2)[0][:, 1]
    np.testing.assert_allclose(gaps, scene.spacing_m)


def test_the_working_set_and_the_tree_of_the_race_find_the_same(run: ModuleType) -> None:
    race = run.tracking
    objects = race.stored_objects(3000, np.random.default_rng(0))
    kept = race.empty_working_set()
    kept.insert_arrays(objects)
    tree = KDTree(objects.position)
    for place in objects.position[::100]:
        near = kept.near(place[None], np.array([race.REACH_M])).tolist()
        assert near == sorted(tree.query_ball_point(place, race.REACH_M))
        assert len(near) > 1


@pytest.mark.slow
def test_both_who_race_in_a_known_map_find_the_way(run: ModuleType) -> None:
    """As near to each other as to the truth, and the map has what it says in view."""
    race = run.localize
    drives = race.draw(race.RACE, 60)
    for world in (drives, *(race.draw(size, 60) for size in race.SIZES)):
        expected = race.P_DETECT * race.IN_VIEW
        assert np.mean([len(seen.landmark_id) for seen in world.sightings]) == pytest.approx(expected, rel=0.05)
    ours, theirs = (contender(drives).pose[race.WARM_UP :] for contender in (race.by_evermap, race.by_gtsam))
    truth = drives.pose[race.WARM_UP :]
    for one, other in ((ours, truth), (theirs, truth), (ours, theirs)):
        assert np.abs(se2.log(se2.between(one, other))).max() < 0.05


@pytest.mark.slow
def test_learning_cliques_of_the_race_are_all_looked_at_and_learned_from(run: ModuleType) -> None:
    """Nobody saves time by leaving something out, and the memory is that of all arrays."""
    scene = run.cliques.world(40)
    ours = run.cliques.WithLearning(scene)
    for _ in range(6):
        for step in (ours.look, ours.filter, ours.confirm):
            step()
    np.testing.assert_array_equal(ours.model.stamp_s, 6.0)
    assert (ours.belief.probability > 0.99).mean() > 0.9
    assert (ours.model.pending == 0.0).all(axis=1).mean() > 0.9  # what was learned has gone to the profile
    assert ours.model.profile.range_hits.sum() > 500.0
    assert ours.bytes_used > 4 * 12 * len(scene.clique)  # two places in doubles, two rows of six floats


def test_worlds_are_what_they_say(worlds: dict[bool, Any]) -> None:
    world = worlds[True]
    assert world.problem.stamp_s.shape == (SMALL,)
    assert world.problem.prior.free.any()
    assert not worlds[False].problem.prior.free.any()
    np.testing.assert_array_equal(world.problem.reading, worlds[False].problem.reading)
    assert np.linalg.norm(np.diff(world.pose[:, :2], axis=0), axis=1).max() < 0.25
    # the increments that the other side is given are the true motion, but for noise as large as they say
    off = se2.log(se2.between(se2.between(world.pose[:-1], world.pose[1:]), world.increment))
    squared = np.einsum("ki,kij,kj->k", off, np.linalg.inv(world.covariance), off)
    assert 2.0 < squared.mean() < 4.0


def test_baseline_is_complete(run: ModuleType) -> None:
    baseline = run.read_baseline()
    assert set(baseline) == set(run.METRICS)
    for name, row in baseline.items():
        assert row["direction"] in ("higher", "lower")
        assert row["direction"] == run.METRICS[name][0]
        assert 0.0 < row["tolerance"] < 1.0
        assert row["value"] > 0.0


@pytest.mark.parametrize(
    "damage", ["", "{}", '{"metrics": [{"metric": "isam2_speed_ratio"}]}', '{"metrics": []}', "[1"]
)
def test_damaged_baseline_is_one_line(run: ModuleType, tmp_path: Path, damage: str) -> None:
    path = tmp_path / "baseline.json"
    path.write_text(damage)
    with pytest.raises(InputError, match=r"baseline.json: .*--update-baseline"):
        run.read_baseline(path)


@pytest.mark.parametrize(
    ("direction", "value", "change", "regression"),
    [("higher", 0.8, -0.2, False), ("higher", 0.7, -0.3, True), ("lower", 1.3, -0.3, True), ("lower", 0.5, 0.5, False)],
)
def test_regressions_are_those_beyond_the_tolerance(
    run: ModuleType, direction: str, value: float, change: float, regression: bool
) -> None:
    (row,) = run.compare({"m": value}, {"m": {"direction": direction, "tolerance": 0.25, "value": 1.0}})
    assert row["change"] == pytest.approx(change)
    assert row["regression"] is regression


def test_memory_is_measured_in_a_process_of_its_own(run: ModuleType) -> None:
    """The child's own peak, not its parent's: a parent with a large array changes nothing."""
    ballast = np.ones(60_000_000)
    found = run.measure("isam2", "gtsam", 60)
    assert 10.0 < found["before_mb"] <= found["peak_mb"] < ballast.nbytes / 1e6 + 100.0


def test_one_part_leaves_the_baseline_of_the_other(
    run: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, path = _read(run.BASELINE), tmp_path / "baseline.json"
    path.write_text(json.dumps({"metrics": [row for name, row in before.items() if name.startswith("isam2")]}))
    monkeypatch.setattr(run, "BASELINE", path)
    monkeypatch.setattr(run.persistence, "run", lambda *_: (dict.fromkeys(run.persistence.METRICS, 2.0), {}))
    run.run(update_baseline=True, only="persistence")
    after = _read(path)
    assert after["isam2_speed_ratio"] == before["isam2_speed_ratio"]
    assert {name for name, row in after.items() if row["value"] == 2.0} == set(run.persistence.METRICS)
    with pytest.raises(InputError, match="lacks batch_speed_ratio"):
        run.read_baseline(path)
    with pytest.raises(InputError, match="no part 'slams'"):
        run.run(only="slams")


@pytest.mark.slow
def test_a_small_run_writes_compares_and_reports(
    run: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, json_of: Callable[[Any], Any]
) -> None:
    monkeypatch.setattr(run, "BASELINE", tmp_path / "baseline.json")
    monkeypatch.setattr(run, "read_baseline", lambda: _read(tmp_path / "baseline.json"))
    monkeypatch.setattr(run.scale, "SIZES", (20, 40))
    errors = dict.fromkeys(("odometry_m", "ours_m", "calibrated_m", "all_stand_m", "as_is_m", "cpu_ms", "factor"), 1.0)
    traffic = {"sequence": "0000", "range_scale": None, "landmarks": 2, **errors}
    traffic["parked_or_moving"] = {"ranges": [9, 10, 1], "reference": [8, 10, 1]}
    shown = {"classes": {}, "ms_a_frame": {"evermap": 0.3}, "slam": [traffic]}
    boxes = dict.fromkeys(run.kitti.METRICS, 1.0), shown
    monkeypatch.setattr(run.kitti, "FOLDER", tmp_path)
    monkeypatch.setattr(run.kitti, "run", lambda: boxes)
    tags = dict.fromkeys(run.space.METRICS, 1.0), {"tags": [], "changes": {}, "days": [], "objects": []}
    (tmp_path / "tagslam").mkdir()
    monkeypatch.setattr(run.space, "FOLDER", tmp_path)
    monkeypatch.setattr(run.space, "run", lambda: tags)
    nameless = dict.fromkeys(run.association.METRICS, 1.0), {"rows": []}
    (tmp_path / "mrclam").mkdir()
    monkeypatch.setattr(run.association, "FOLDER", tmp_path)
    monkeypatch.setattr(run.association, "run", lambda: nameless)
    soaked = {"sessions": 1, "sites": 1, "uploads": 1, "kills": {}, "store": "sqlite", "took_s": 1.0, "wait_ms": {}}
    soaked |= {"robots": 1, "cpu_s": {"server": 1.0, "worker": 1.0}, "memory_mb": [1.0, 1.0]}
    served = dict.fromkeys(run.fleet.METRICS, 1.0), soaked
    monkeypatch.setattr(run.fleet, "run", lambda: served)
    measured = run.run(
        update_baseline=True,
        n_poses=80,
        turns=1,
        n_features=2000,
        seconds=0.01,
        n_cliques=50,
        n_lifetimes=300,
        n_frames=12,
        n_stored=2000,
        n_steps=25,
    )
    assert measured["regressions"] == []
    assert [row["metric"] for row in measured["metrics"]] == list(run.METRICS)
    assert all(abs(row["change"]) < 1e-3 for row in measured["metrics"])
    assert json_of(measured) == measured
    text = run.as_text(measured)
    assert text.endswith("no regression")
    assert len(re.findall(r"poses/s", text)) == 4
    assert "| general purpose | ≤ 30 |" in text
    measured["metrics"][0]["regression"] = True
    measured["regressions"] = ["isam2_speed_ratio"]
    assert "REGRESSION" in run.as_text(measured)
    assert run.as_text(measured).endswith("worse than the baseline allows: isam2_speed_ratio")


def _read(path: Path) -> dict[str, Any]:
    return {row["metric"]: row for row in json.loads(path.read_text())["metrics"]}


@pytest.fixture
def json_of() -> Callable[[Any], Any]:
    return lambda value: json.loads(json.dumps(value, allow_nan=False))


@pytest.mark.parametrize(
    ("study", "given", "wanted"),
    [
        ("association", ["sessions", "rooms"], (["sessions", "rooms"], {})),
        ("association", ["--data", "recordings"], ((), {"folder": Path("recordings")})),
        ("soak", ["--hours", "1", "--seed", "3"], (["--hours", "1.0", "--seed", "3"], {})),
        ("liars", [], ([], {})),
        ("liars", ["--lie", "misreads", "--seed", "4"], (["--lies", "misreads", "--seeds", "4"], {})),
    ],
)
def test_studies_of_the_pages_run_the_benchmarks(
    study: str, given: list[str], wanted: tuple[Any, dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """`evermap reproduce` has a command for each; it adds nothing to them."""
    declared = tomllib.loads((ROOT / "studies" / "pyproject.toml").read_text("utf-8"))
    points = declared["project"]["entry-points"]["evermap.studies"]
    assert points[study] == f"evermap_studies.commands:{study}"
    called: list[tuple[Any, dict[str, Any]]] = []
    load_benchmarks()
    benchmark = importlib.import_module(f"benchmarks.{study}")
    monkeypatch.setattr(benchmark, "main", lambda *args, **more: called.append((*args, more)))
    commands = typer.Typer()
    commands.command()(getattr(evermap_studies.commands, study))
    result = CliRunner().invoke(commands, given)
    assert result.exit_code == 0, result.output
    assert called == [wanted]
