"""A tracker that is saved and goes on knows what one that never stopped knows."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import evermap as em
from evermap.config import TrackConfig
from evermap.errors import ConfigError, InputError
from evermap.runs.examples import RANGE_M, write_detections
from evermap.survival import GeneralPurpose
from evermap.survival.censored import CensoredLifetimes
from evermap.tracking.detections import read_detections
from evermap.tracking.frame import DetectionTable
from evermap.tracking.record import StaticSpells
from evermap.tracking.run import TrackResult, make_tracker, run_track
from evermap.tracking.views import View

CONFIG = TrackConfig(range_m=RANGE_M)


@pytest.fixture(scope="module")
def yard(tmp_path_factory: pytest.TempPathFactory) -> DetectionTable:
    """Four days in a yard."""
    return read_detections(write_detections(tmp_path_factory.mktemp("yard") / "detections.csv"))


@pytest.fixture(scope="module")
def whole(yard: DetectionTable) -> TrackResult:
    return run_track(yard, CONFIG)


def part_of(table: DetectionTable, first: int, last: int) -> DetectionTable:
    """Frames `first` to before `last`, of the classes that appear in them, as a file of them would be read."""
    rows = slice(int(table.first[first]), int(table.first[last]))
    used = np.unique(table.class_id[rows])
    return replace(
        table,
        stamp_s=table.stamp_s[first:last],
        first=table.first[first : last + 1] - table.first[first],
        position_m=table.position_m[rows],
        class_names=tuple(table.class_names[k] for k in used),
        class_id=np.searchsorted(used, table.class_id[rows]),
        covariance_m2=None if table.covariance_m2 is None else table.covariance_m2[rows],
        appearance=None if table.appearance is None else table.appearance[rows],
        sensor_m=None if table.sensor_m is None else table.sensor_m[first:last],
        line=table.line[rows],
    )


def in_parts(table: DetectionTable, cuts: list[int], state: Path, config: TrackConfig = CONFIG) -> list[TrackResult]:
    """Each part by a tracker that was saved after the one before."""
    results = []
    for first, last in zip([0, *cuts], [*cuts, table.n_frames], strict=True):
        part = part_of(table, first, last)
        tracker = make_tracker(part, config, state=state if first else None)
        results.append(run_track(part, config, tracker=tracker))
        tracker.save(state)
    return results


def test_days_in_parts_are_the_days_in_one(yard: DetectionTable, whole: TrackResult, tmp_path: Path) -> None:
    """Cut within a passage, where objects are followed, and between two days; classes appear one after the other."""
    night = int(np.argmax(np.diff(yard.stamp_s))) + 1
    cuts = sorted({yard.n_frames // 7, night, 3 * yard.n_frames // 4})
    results = in_parts(yard, cuts, tmp_path / "yard.state")
    last = results[-1]
    names, other = whole.table.class_names, last.table.class_names
    assert sorted(other) == sorted(names)
    found = replace(last.spells, class_id=np.array([names.index(other[k]) for k in last.spells.class_id]))
    for item in fields(StaticSpells):
        np.testing.assert_allclose(getattr(found, item.name), getattr(whole.spells, item.name), rtol=1e-12, atol=1e-12)
    assert last.lifetimes is not None
    assert whole.lifetimes is not None
    for item in fields(CensoredLifetimes):
        np.testing.assert_array_equal(getattr(last.lifetimes, item.name), getattr(whole.lifetimes, item.name))
    ids = np.concatenate([result.track_of_detection for result in results])
    told = ids >= 0  # what is confirmed after a cut only is nothing in the part before
    np.testing.assert_array_equal(ids[told], whole.track_of_detection[told])
    assert told.sum() > 0.99 * (whole.track_of_detection >= 0).sum()


def test_the_file_is_the_state(yard: DetectionTable, tmp_path: Path) -> None:
    """Saved, loaded without any choice, and saved again, it is the same to the byte; and so is what comes next."""
    part = part_of(yard, 0, 400)
    tracker = make_tracker(part, CONFIG)
    run_track(part, CONFIG, tracker=tracker)
    one = tracker.save(tmp_path / "one")
    again = em.Tracker.load(one)
    assert again.save(tmp_path / "two").read_bytes() == one.read_bytes()
    assert repr(again) == repr(tracker)
    where = np.array([[1.0, 2.0, 0.0]])
    view = View.ball(np.zeros(3), 30.0, 0.9)
    for k in range(30):
        stamp_s = tracker.stamp_s + 0.1
        a, before = tracker.step(stamp_s, where, view=view)
        b, after = again.step(stamp_s, where, view=view)
        assert a.tolist() == b.tolist(), k
        assert before == after, k
    np.testing.assert_array_equal(again.followed().p_exists, tracker.followed().p_exists)


def test_a_new_class_is_as_likely_as_the_least_likely_known(tmp_path: Path) -> None:
    tracker = em.Tracker(n_classes=2, class_names=["cart", "pallet"], priors=[em_prior(1e-3), em_prior(1e-5)])
    left_behind = np.array([[50.0, 0.0, 0.0]])
    for k in range(60):
        tracker.step(0.1 * k - 8.0, left_behind, np.array([0]))
    for k in range(15):
        tracker.step(0.1 * k - 1.9, np.zeros((0, 3)), view=View.ball(np.zeros(3), 1.0, 0.9))
    for k in range(4):
        tracker.step(0.1 * k, np.zeros((1, 3)), np.array([1]))
    before = tracker.followed().class_p[0]
    path = tracker.save(tmp_path / "state")
    again = em.Tracker.load(path, class_names=["pallet", "bin", "cart"])
    after = again.followed().class_p[0]
    np.testing.assert_allclose(after[[2, 0]] / after.sum(), before / (1.0 + before[0]), rtol=1e-12)
    assert after[1] == after[2]
    assert again.working_set.class_p(again.working_set.rows)[0].argmax() == 2  # the cart that was left behind
    for k in range(4, 9):
        again.step(0.1 * k, np.zeros((1, 3)), np.array([1]))
    assert again.followed().class_p[0].argmax() == 1
    with pytest.raises(ConfigError, match="'cart'"):
        em.Tracker.load(path, class_names=["pallet", "bin"])


def em_prior(rate_hz: float) -> GeneralPurpose:
    return GeneralPurpose(rate_hz, 10.0 * rate_hz)


def test_what_does_not_fit_is_refused_by_name(yard: DetectionTable, tmp_path: Path) -> None:
    part = part_of(yard, 0, 60)
    tracker = make_tracker(part, CONFIG)
    run_track(part, CONFIG, tracker=tracker)
    state = tracker.save(tmp_path / "state")
    with pytest.raises(InputError, match="the state ends at"):
        make_tracker(part, CONFIG, state=state)
    later = part_of(yard, 60, 90)
    with pytest.raises(InputError, match=r"boxes without scores.*those of the state are points without scores"):
        make_tracker(replace(later, box=np.ones((len(later), 4))), CONFIG, state=state)
    with pytest.raises(ConfigError, match="another model of motion"):
        make_tracker(later, CONFIG.model_copy(update={"motion": "velocity"}), state=state)
    with pytest.raises(InputError, match="cannot be read"):
        em.Tracker.load(tmp_path / "none")
    (tmp_path / "other").write_text("stamp_s,x_m\n")
    with pytest.raises(InputError, match="not a tracker's state"):
        em.Tracker.load(tmp_path / "other")
    (tmp_path / "half").write_bytes(state.read_bytes()[:500])
    with pytest.raises(InputError, match="not a tracker's state"):
        em.Tracker.load(tmp_path / "half")
