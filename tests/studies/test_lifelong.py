"""Script and edited sessions against plain geometry, scores by hand, and the whole on a made-up recording."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evermap.config import LivingConfig
from evermap.errors import ConfigError, InputError, NumericalError
from evermap.geometry import se2
from evermap.maps.living import LivingMap, Members, Places, Sites
from evermap.metrics.trajectory import interpolate
from evermap.types import ChangeKind, Landmarks, MapChange, Trajectory
from evermap_studies.lifelong import runs as lifelong_runs
from evermap_studies.lifelong import study as lifelong
from evermap_studies.lifelong.figures import draw_errors, draw_flat
from evermap_studies.lifelong.runs import ABLATIONS, CONTENDERS, WHOLE, live
from evermap_studies.lifelong.scores import (
    NOTHING,
    alignment_of,
    change_counts,
    changes_found,
    landmark_rmse_m,
    session_scores,
)
from evermap_studies.lifelong.script import CLEAR_M, Unrest, draw_script
from evermap_studies.lifelong.table import as_markdown, verdicts
from evermap_studies.lifelong.world import DAY_S, World, recorded_world, simulated_world
from evermap_studies.nielsen2024.runs import recording_of, reference_of, survey_of

pytestmark = pytest.mark.slow
"""Whole studies: `make test-slow` runs them, and the nightly part."""

SURVEY = Landmarks.at(np.arange(6, 21), np.random.default_rng(1).uniform(-4.0, 4.0, (15, 2)))


@given(st.integers(0, 2**31))
def test_a_script_keeps_its_promises(seed: int) -> None:
    script = draw_script(SURVEY, 6, seed)
    there = np.isfinite(script.position_m[:, :, 0])
    np.testing.assert_array_equal(script.position_m[0], SURVEY.position_m)
    last = SURVEY.position_m.copy()
    for k in range(1, 6):
        was, now = there[k - 1], there[k]
        step = np.linalg.norm(script.position_m[k] - last, axis=1)
        assert np.sum(was & now & (step > 0.0)) == 3
        assert np.sum(was & ~now) == 1
        assert np.sum(~was & now) == (1 if k > 1 else 0)
        moved = step[now & (step > 0.0)]
        assert np.all((moved >= 0.3) & (moved <= 2.0))
        last[now] = script.position_m[k, now]
        assert np.all(np.linalg.norm(last - SURVEY.position_m, axis=1) <= 2.0)
        # whoever moved or came back stands clear of all others; where the survey put the others is not ours
        apart = np.linalg.norm(last[now][:, None] - last[now][None], axis=2) + 9.0 * np.eye(now.sum())
        assert np.all(apart[step[now] > 0.0] >= CLEAR_M)


def test_scripts_differ_by_seed_and_a_longer_one_begins_like_a_shorter_one() -> None:
    short, long, other = (draw_script(SURVEY, n, seed) for n, seed in ((4, 1), (30, 1), (30, 2)))
    np.testing.assert_array_equal(long.position_m[:4], short.position_m)
    assert not np.array_equal(long.position_m[1], other.position_m[1], equal_nan=True)
    world = World((), SURVEY.landmark_id, long.position_m, np.ones((30, 15), dtype=np.int64))
    back = ~world.there[1:-1] & world.there[2:]
    same = np.all(world.last_m[2:] == world.last_m[1:-1], axis=2)[back]
    assert 0.2 < same.mean() < 0.8  # half of those that come back do so to where they stood


def test_a_script_that_cannot_be_is_refused() -> None:
    with pytest.raises(ConfigError, match="too few"):
        draw_script(Landmarks.at([1, 2], [(0.0, 0.0), (1.0, 0.0)]), 3, 0)
    with pytest.raises(ConfigError, match="no free place"):
        draw_script(SURVEY, 3, 0, Unrest(step_m=(3.0, 4.0), stray_m=0.5))


def test_sessions_are_what_the_robots_would_have_seen(made_up_data: Path) -> None:
    """An edited reading misses the new place by as much as the recorded one missed the old place."""
    world = recorded_world(made_up_data, 4, 3)
    originals = [recording_of(made_up_data, 6, robot) for robot in (1, 2, 1, 2)]
    laws = [reference_of(made_up_data, 6, robot).range_law for robot in (1, 2, 1, 2)]
    for k, (session, original, law) in enumerate(zip(world.recordings, originals, laws, strict=True)):
        assert len(session.frames) == len(original.frames)
        late_s = session.frames.stamp_s - original.frames.stamp_s
        assert np.ptp(late_s) < 1e-6
        assert abs(late_s[0] - k * DAY_S) < 60.0
        kept = np.isin(original.detections.source_line, session.detections.source_line)
        new = _misses(session, world.position_m[k], world.landmark_id, law)
        old = _misses(original, survey_of(original).position_m, world.landmark_id, law)[kept]
        np.testing.assert_allclose(new, old, atol=1e-9)
        away = world.landmark_id[~world.there[k]]
        assert not np.isin(session.detections.landmark_id, away).any()
        lost = original.detections.landmark_id[~kept]
        moved = [c.landmark_ids[0] for c in world.changes(k)] if k == 1 else world.landmark_id
        assert np.isin(lost, moved).all()
    np.testing.assert_array_equal(
        world.hits[1], [np.sum(world.recordings[1].detections.landmark_id == i) for i in world.landmark_id]
    )


def _misses(recording: Any, position_m: np.ndarray, ids: np.ndarray, law: tuple[float, float, float]) -> np.ndarray:
    """Reported minus expected readings, by complex numbers."""
    poses = interpolate(recording.truth, recording.frames.stamp_s)[0][recording.detections.frame]
    at = position_m[np.searchsorted(ids, recording.detections.landmark_id)]
    seen = (at[:, 0] + 1j * at[:, 1] - poses[:, 0] - 1j * poses[:, 1]) * np.exp(-1j * poses[:, 2])
    r, b = np.abs(seen), np.angle(seen)
    expected = r * (1.0 + law[0] + law[1] * b + law[2] * b * b)
    turn = se2.wrap(recording.detections.bearing_rad - b)
    return np.column_stack([recording.detections.range_m - expected, turn])


NAN2 = (np.nan, np.nan)
POSITION_M = np.array(
    [
        [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0), NAN2],
        [(0.0, 0.0), (1.0, 1.0), NAN2, (3.0, 0.0)],
        [(0.0, 0.0), NAN2, (2.0, 0.5), (3.0, 0.0)],
    ]
)
"""Landmarks 1 to 4 in three sessions."""


def made_world() -> World:
    stamps = np.arange(20.0)
    paths = [Trajectory(stamps, np.column_stack([0.1 * stamps, 0 * stamps, 0 * stamps]), np.zeros((20, 3, 3)))] * 3
    sessions: Any = tuple(SimpleNamespace(truth=path, frames=SimpleNamespace(stamp_s=stamps)) for path in paths)
    hits = np.array([[5, 5, 5, 0], [5, 5, 0, 0], [5, 0, 5, 5]])
    return World(sessions, np.arange(1, 5), POSITION_M, hits)


def test_changes_and_statements_are_read_off_the_places() -> None:
    world = made_world()
    assert world.changes(0) == ()
    by_kind = {change.kind: change for change in world.changes(1)}
    assert {kind: change.landmark_ids for kind, change in by_kind.items()} == {
        ChangeKind.MOVED: (2,), ChangeKind.VANISHED: (3,), ChangeKind.APPEARED: (4,),
    }  # fmt: skip
    assert by_kind[ChangeKind.MOVED].displacement_m == (0.0, 1.0)
    assert [(c.kind, c.landmark_ids) for c in world.changes(2)] == [
        (ChangeKind.VANISHED, (2,)), (ChangeKind.RETURNED, (3,)),
    ]  # fmt: skip
    assert world.changes(2)[1].displacement_m == (0.0, 0.5)
    np.testing.assert_array_equal(world.changed(2), [2, 3])
    np.testing.assert_array_equal(world.landmarks(1).landmark_id, [1, 2, 4])
    np.testing.assert_array_equal(world.asked(1).landmark_id, [1, 2, 3])  # 4 was never detected until then
    np.testing.assert_array_equal(world.asked(1).position_m, [(0.0, 0.0), (1.0, 1.0), (2.0, 0.0)])


def made_map(places: list[tuple[int, int, float, float, float]]) -> LivingMap:
    """Rows of site, landmark (a clique each), x, y and p."""
    site, landmark, x, y, p = (np.array(column) for column in zip(*places, strict=True))
    ids = np.unique(landmark)
    off = np.zeros(len(ids), dtype=np.bool_)
    none = np.zeros(len(site), dtype=np.int64)
    return LivingMap(
        stamp_s=0.0,
        members=Members(ids, np.full(len(ids), -1), ids, off, off),
        sites=Sites(site, landmark, p, p, np.zeros(len(site)), np.zeros(len(site))),
        places=Places(site, landmark, np.column_stack([x, y]), none, none),
        covariance_m2=np.eye(2 * len(site)),
    )


def made_session(living: LivingMap, path: np.ndarray, changes: tuple[MapChange, ...] = (), placed: bool = True) -> Any:
    slam = SimpleNamespace(
        trajectory=Trajectory(np.arange(20.0), path, np.zeros((20, 3, 3))), step_s=np.full(20, 0.002)
    )
    return SimpleNamespace(living=living, found=placed, changes=changes, slam=slam)


def found(kind: ChangeKind, landmark: int) -> MapChange:
    return MapChange((landmark,), kind, np.nan, 0.0, (0.0, 0.0), 0.0, 1.0)


def test_scores_of_a_session_by_hand() -> None:
    world = made_world()
    living = made_map(
        [
            (0, 1, 0.1, 0.0, 1.0),
            (1, 2, 1.0, 0.0, 0.3),
            (2, 2, 1.0, 1.1, 0.6),
            (3, 3, 2.0, 0.0, 0.2),
            (4, 4, 5.0, 0.0, 0.9),
        ]
    )
    path = np.column_stack([0.1 * np.arange(20.0) + 0.3, np.full(20, 0.4), np.zeros(20)])
    changes = (found(ChangeKind.MOVED, 2), found(ChangeKind.MOVED, 3), found(ChangeKind.APPEARED, 4))
    row = session_scores(made_session(living, path, changes), world, 1, np.zeros(3), LivingConfig(), 0.5)
    assert row["pose_rmse_m"] == pytest.approx(0.5)  # 0.3 and 0.4 off, all the way
    assert row["pose_own_rmse_m"] == pytest.approx(0.0, abs=1e-6)
    # believed and there: 1, 2 and 4, of which 4 is two metres off
    assert row["landmark_rmse_m"] == pytest.approx(np.sqrt((0.01 + 0.01 + 4.0) / 3))
    squared = (1.0 - 1.0) ** 2 + (0.6 - 1.0) ** 2 + (0.2 - 0.0) ** 2
    assert row["existence"] == {
        "n_claims": 3, "n_right": 2, "n_there": 3, "n_statements": 3, "squared_error": pytest.approx(squared),
    }  # fmt: skip
    assert row["forecast"]["n_statements"] == 3
    still = replace(living, sites=replace(living.sites, p_here=np.array([1.0, 0.3, 0.6, 0.2, 0.9])))
    config = LivingConfig(
        existence=False
    )  # nothing changes until the next session, in which 1 stands there, 2 is gone, and 3 is elsewhere
    later = session_scores(made_session(still, path), world, 1, np.zeros(3), config, 0.5)["forecast"]
    assert later["squared_error"] == pytest.approx(0.0 + 0.6**2 + 0.2**2)
    assert session_scores(made_session(living, path), world, 2, np.zeros(3), config, 0.5)["forecast"] is None
    assert row["changes"]["all"] == [3, 3, 2]
    assert row["changes"]["moved"] == [2, 1, 1]
    assert row["changes"]["vanished"] == [0, 1, 0]
    assert (row["landmarks"], row["places"], row["sites"]) == (4, 5, 5)
    assert row["step_p99_ms"] == pytest.approx(2.0)
    assert row.keys() == NOTHING.keys()


def test_the_frame_is_that_of_the_first_map_and_creeping_away_is_wrong() -> None:
    world = made_world()
    pose = np.array([2.0, -1.0, 0.7])
    inverse = se2.inverse(pose)
    at = se2.transform(inverse, POSITION_M[0, :3])
    living = made_map([(k, k + 1, *at[k], 1.0) for k in range(3)])  # type: ignore[misc]
    np.testing.assert_allclose(alignment_of(living, world), pose, atol=1e-9)
    path = world.recordings[1].truth
    assert path is not None
    creeping = se2.compose(inverse, path.pose_world_robot) + [0.2, 0.0, 0.0]
    row = session_scores(made_session(living, creeping), world, 1, pose, LivingConfig(), 0.5)
    assert row["pose_rmse_m"] == pytest.approx(0.2)
    assert row["pose_own_rmse_m"] == pytest.approx(0.0, abs=1e-6)
    lost = session_scores(made_session(living, creeping, placed=False), world, 1, pose, LivingConfig(), 0.5)
    assert not lost["placed"]
    assert lost["pose_rmse_m"] is None
    nothing = Landmarks.at([], np.zeros((0, 2)))
    assert landmark_rmse_m(nothing, world.landmarks(0), pose) is None


def test_the_first_session_has_no_changes_to_find() -> None:
    world = made_world()
    living = made_map([(0, 1, 0.0, 0.0, 1.0), (1, 2, 1.0, 0.0, 1.0)])
    path = world.recordings[0].truth
    assert path is not None
    session = made_session(living, path.pose_world_robot, (found(ChangeKind.APPEARED, 1),))
    assert session_scores(session, world, 0, np.zeros(3), LivingConfig(), 0.5)["changes"] is None
    assert changes_found(session, world, 2)["all"] == [1, 2, 0]
    rows = [{"changes": None}, {"changes": changes_found(session, world, 2)}]
    assert change_counts(rows).recall == 0.0


def test_who_is_told_forgets_what_changed_and_nobody_sees_the_truth(
    made_up_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = recorded_world(made_up_data, 4, 0)
    survey = survey_of(world.recordings[0])
    given: list[Any] = []

    def bring_in(alone: Any, living: LivingMap, config: Any) -> Any:
        given.append((alone, living, config))
        if len(given) == 3:
            raise NumericalError("no finite optimum")
        whole = made_map([(k, int(i), *at, 1.0) for k, (i, at) in enumerate(zip(*_rows(survey), strict=True))])
        path = world.recordings[len(given) - 1].truth
        result = SimpleNamespace(trajectory=path, step_s=np.ones(3), interrupted=False)
        return SimpleNamespace(living=whole, found=True, slam=result, changes=())

    monkeypatch.setattr("evermap.pipeline.solve_alone", lambda recording, living, config: recording)
    monkeypatch.setattr("evermap.pipeline.bring_in", bring_in)
    rows = list(live(world, [CONTENDERS[-1]]))
    assert [row["failure"] for row in rows] == [None, None, "no finite optimum", None]
    assert [row["session"] for row in rows] == [0, 1, 2, 3]
    assert all(recording.truth is None and recording.true_landmarks is None for recording, _, _ in given)
    assert len(given[0][1].members) == 0
    for k in (1, 2):
        left = np.setdiff1d(survey.landmark_id, world.changed(k))
        np.testing.assert_array_equal(given[k][1].members.landmark_id, left)
    # a session that failed leaves the map as it was
    left = np.setdiff1d(left, world.changed(3))
    np.testing.assert_array_equal(given[3][1].members.landmark_id, left)
    assert rows[1]["pose_rmse_m"] == pytest.approx(0.0, abs=1e-9)


def test_sessions_are_solved_once_for_all_who_agree_how(made_up_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    world = recorded_world(made_up_data, 2, 0)
    solved: list[str] = []

    def fail(*_: Any) -> Any:
        raise NumericalError("enough")

    monkeypatch.setattr("evermap.pipeline.solve_alone", lambda _, __, config: solved.append(config.slam.sensor_model))
    monkeypatch.setattr("evermap.pipeline.bring_in", fail)
    rows = list(live(world, ABLATIONS))
    assert len(rows) == 2 * len(ABLATIONS)
    assert {row["contender"] for row in rows} == {contender.name for contender in ABLATIONS}
    assert solved == ["calibrated", "plain"] * 2


def _rows(survey: Landmarks) -> tuple[list[int], list[list[float]]]:
    return survey.landmark_id.tolist(), survey.position_m.tolist()


def test_every_contender_is_a_valid_configuration_and_lacks_what_it_says() -> None:
    from evermap.config import Config

    whole = WHOLE.config().model_dump()
    assert whole == Config().model_dump()
    for contender in (*CONTENDERS, *ABLATIONS):
        dumped = contender.config(lifelong_runs.SIMULATED).model_dump()
        assert dumped["slam"]["calibration"]["fix"] == {"range_slope": 0.0}
        different = [
            key
            for section in ("slam", "living")
            for key, value in dumped[section].items()
            if value != whole[section][key] and key != "calibration"
        ]
        assert len(different) == len(contender.overrides)
    assert all(len(contender.overrides) == 1 for contender in ABLATIONS[1:])
    assert len({contender.name for contender in ABLATIONS}) == len(ABLATIONS)


def test_a_simulated_world_is_that_of_the_simulation() -> None:
    world = simulated_world(2, 5)
    assert len(world) == 4
    for k, recording in enumerate(world.recordings):
        truth = recording.true_landmarks
        assert truth is not None
        np.testing.assert_array_equal(world.landmarks(k).landmark_id, truth.landmark_id)
        np.testing.assert_array_equal(world.landmarks(k).position_m, truth.position_m)
        named = recording.detections.landmark_id
        assert np.all(world.hits[k] <= [np.sum(named == i) for i in world.landmark_id])
    assert world.hits.sum() > 0.9 * sum(len(recording.detections) for recording in world.recordings)


def fake_rows(part: str, sessions: int, contenders: Any, pose_m: dict[str, float]) -> list[dict[str, Any]]:
    counts = {name: [2, 2, 1] for name in ("all", "moved", "vanished", "returned", "appeared")}
    return [
        {
            "part": part,
            "seed": seed,
            "contender": who.name,
            "session": session,
            **NOTHING,
            "placed": True,
            "pose_rmse_m": pose_m.get(who.name, 0.3) + 0.01 * seed,
            "pose_own_rmse_m": 0.05,
            "landmark_rmse_m": 0.04,
            "existence": {"n_claims": 10, "n_right": 9, "n_there": 12, "n_statements": 10, "squared_error": 1.0},
            "forecast": {"n_claims": 0, "n_right": 0, "n_there": 0, "n_statements": 10, "squared_error": 2.0},
            "changes": counts if session else None,
            "landmarks": 15,
            "places": 20,
            "sites": 20,
            "cpu_s": 1.0 + 0.1 * session,
            "step_p50_ms": 1.0,
            "step_p99_ms": 2.0,
        }
        for seed in (0, 1)
        for who in contenders
        for session in range(sessions)
    ]


def test_tables_and_verdicts_say_what_the_rows_say() -> None:
    five = fake_rows("five", 5, CONTENDERS, {WHOLE.name: 0.10, CONTENDERS[-1].name: 0.08})
    fifty = fake_rows("fifty", 10, [WHOLE], {})
    ablation = fake_rows("ablation-recorded", 3, ABLATIONS[:3], {WHOLE.name: 0.1})
    rows = [*five, *fifty, *ablation]
    rows[3] = {**{key: rows[3][key] for key in ("part", "seed", "contender", "session")}, **NOTHING, "failure": "x"}
    said = {row["what"]: row for row in verdicts(rows)}
    ratio = said["pose RMSE of evermap over the oracle's, five sessions"]
    mine, told = (np.sqrt((p**2 + (p + 0.01) ** 2) / 2) for p in (0.10, 0.08))
    assert ratio["measured"] == pytest.approx(mine / told)
    assert not ratio["met"]
    assert said["pose RMSE, last fifth of a long life over the first"]["measured"] == pytest.approx(1.0)
    time = said["time of a session, last fifth over the first"]
    assert time["measured"] == pytest.approx((1.0 + 0.85) / (1.0 + 0.05))
    assert not time["met"]
    text = as_markdown({"rows": rows, "expected": verdicts(rows)})
    assert not re.search(r"\bnan\b|None", text)
    assert "| **evermap** | all of it in one model, and a joint search over what moved | 0.105 ± 0.005 |" in text
    assert "| 8 / 16 / 16 |" in text  # four sessions of two seeds, one of two right
    assert "+0.200 ± 0.000" in text  # the ablations of the made-up rows are 0.2 m worse
    empty = as_markdown({"rows": [], "expected": verdicts([])})
    assert "–" in empty


def test_figures_show_the_rows() -> None:
    five = fake_rows("five", 5, CONTENDERS, {WHOLE.name: 0.1})
    figure = draw_errors(five)
    lines = {line.get_label(): line for line in figure.axes[0].lines}
    assert set(lines) == {contender.name for contender in CONTENDERS}
    np.testing.assert_allclose(lines[WHOLE.name].get_ydata(), 0.105)
    np.testing.assert_array_equal(lines[WHOLE.name].get_xdata(), np.arange(1, 6))
    np.testing.assert_allclose(figure.axes[2].lines[0].get_ydata(), 0.9)
    np.testing.assert_allclose(figure.axes[3].lines[0].get_ydata(), 0.75)
    flat = draw_flat(fake_rows("fifty", 10, [WHOLE], {}))
    dots, mean = flat.axes[1].lines[:2]
    np.testing.assert_allclose(dots.get_ydata(), 20)
    np.testing.assert_array_equal(mean.get_xdata(), np.arange(3, 9))
    np.testing.assert_allclose(flat.axes[3].lines[1].get_ydata(), 1.2 + 0.1 * np.arange(6))


def test_settings_that_cannot_be_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no part six"):
        lifelong.Settings(parts=("six",))
    with pytest.raises(ConfigError, match="seeds"):
        lifelong.Settings(seeds=0)
    with pytest.raises(InputError, match="MRCLAM_Dataset6"):
        lifelong.reproduce(tmp_path, tmp_path / "out", lifelong.Settings(parts=("five",)))
    assert not (tmp_path / "out").exists()


def test_parts_are_run_again_one_by_one(made_up_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole way with the true engine: two robots, six landmarks, three sessions."""
    monkeypatch.setattr(lifelong, "CONTENDERS", (CONTENDERS[0], WHOLE))
    monkeypatch.setattr("evermap_studies.lifelong.script.Unrest", lambda: Unrest(moves=1))
    out = tmp_path / "out"
    once = lifelong.Settings(parts=("five",), seeds=1, short=3)
    table = lifelong.reproduce(made_up_data, out, once)
    assert len(table["rows"]) == 6
    assert json.loads((out / "summary.json").read_text()) == table
    assert sorted(path.name for path in out.iterdir()) == table["outputs"]
    ours = [row for row in table["rows"] if row["contender"] == WHOLE.name]
    assert all(row["placed"] and row["failure"] is None for row in ours)
    assert max(row["pose_own_rmse_m"] for row in ours) < 0.15
    names = [lifelong.CONTENDERS[1].name]
    again = lifelong.reproduce(
        made_up_data, out, replace(once, parts=("fifty",), long=5, long_contenders=tuple(names)), progress=None
    )
    assert {row["part"] for row in again["rows"]} == {"five", "fifty"}
    assert [row for row in again["rows"] if row["part"] == "five"] == table["rows"]
    assert "flat.png" in again["outputs"]


@pytest.mark.slow
@pytest.mark.experiment
def test_five_real_robots_live_in_one_map(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "mrclam"
    if not folder.is_dir():
        pytest.skip(f"recordings are not on this machine: no folder {folder}")
    table = lifelong.reproduce(folder, tmp_path / "out", lifelong.Settings(parts=("five",), seeds=2))
    said = {row["what"]: row for row in table["expected"]}
    assert said["pose RMSE of evermap over the oracle's, five sessions"]["met"]
    assert said["pose RMSE of static SLAM over that of evermap, five sessions"]["measured"] > 2.0
    assert said["precision of the map, five sessions"]["measured"] > 0.95
    assert said["recall of the map, five sessions"]["measured"] > 0.9
    assert all(row["failure"] is None and row["placed"] for row in table["rows"])
