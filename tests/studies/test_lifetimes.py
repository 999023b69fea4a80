"""Lifetimes beside the truth: what is drawn, counted and written is what was computed."""

from __future__ import annotations

import gzip
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binomtest
from typer.testing import CliRunner

from evermap.cli.main import app
from evermap.config import TrackerConfig
from evermap.errors import ConfigError, InputError
from evermap.survival import Weibull
from evermap.tracking.tracker import Tracker
from evermap.tracking.views import View
from evermap.types import UNKNOWN
from evermap_studies.lifetimes import figures, truth
from evermap_studies.lifetimes.laws import LAWS
from evermap_studies.lifetimes.moving import track
from evermap_studies.lifetimes.rooms import as_values, study_rooms
from evermap_studies.lifetimes.study import Settings, reproduce
from evermap_studies.lifetimes.truth import ESTIMATORS, NAIVE, SHARES, Stays, chosen_family, coverage, judge
from evermap_studies.worlds.moving import Behaviour, MovingClass, MovingWorld, simulate_moving
from evermap_studies.worlds.patrol_lifetimes import DAY_S, PatrolClass, PatrolPlace, PatrolWorld, simulate_patrols

pytestmark = pytest.mark.slow
"""Whole studies: `make test-slow` runs them, and the nightly part."""

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "presence"
SMALL_MOVING = MovingWorld(
    classes=(
        MovingClass("pallet", Behaviour.PARKED, 10),
        MovingClass("person", Behaviour.CROSSING, 10),
        MovingClass("forklift", Behaviour.LEAVING, 40, (1.5, 3.0), Weibull(scale_s=30.0, shape=2.0)),
    ),
    duration_s=240.0,
    half_extent_m=40.0,
)
SMALL_PATROLS = PatrolWorld(
    classes=(PatrolClass("pallet", Weibull(scale_s=2.0 * DAY_S, shape=1.5)),),
    places=tuple(PatrolPlace(name, 1.0, 0.25 * DAY_S) for name in ("aisle", "dock", "yard")),
    objects=900,
    duration_s=60.0 * DAY_S,
)


def test_the_tracker_knows_of_stays_what_the_sensor_could_know() -> None:
    """Every spell of something that parks and leaves has bounds that hold the truth, but for the filters' delay."""
    tracked = track(simulate_moving(SMALL_MOVING, 0))
    run, spells = tracked.run, tracked.spells
    delay_s = 3.0
    checked = 0
    for k in np.flatnonzero(spells.class_id == 2):
        away = np.linalg.norm(run.position_m[:, :, :2] - spells.position_m[k, :2], axis=2)
        here = (away < 1.0) & run.static & (run.class_id == 2)
        (near,) = np.nonzero(here.any(axis=0))
        if len(near) != 1:
            continue
        began, ended = run.rest_from_s[near[0]], run.rest_until_s[near[0]]
        assert spells.elsewhere_s[k] <= began + delay_s
        assert began <= spells.first_s[k] + delay_s
        assert spells.last_s[k] <= ended + delay_s
        assert ended <= spells.gone_s[k]
        checked += 1
    assert checked >= 10


def test_the_tracker_follows_most_objects() -> None:
    tracked = track(simulate_moving(SMALL_MOVING, 1))
    scores = tracked.scores()
    assert scores.mota > 0.95
    assert scores.motp_m < SMALL_MOVING.sigma_m * np.sqrt(3.0)
    parked = [spell for spell in zip(tracked.spells.class_id, tracked.spells.gone_s, strict=True) if spell[0] == 0]
    assert len(parked) == 10  # each found again wherever it was left
    assert np.isinf([gone for _, gone in parked]).all()
    assert (tracked.spells.class_id != UNKNOWN).all()


def test_tracks_of_patrols_are_the_stays_that_are_drawn_directly() -> None:
    """A robot that stays for 8 s a visit, and misses one detection in ten: visit by visit the same."""
    world = replace(SMALL_PATROLS, places=SMALL_PATROLS.places[:1], objects=60, duration_s=15.0 * DAY_S)
    run = simulate_patrols(world, 5)
    rng = np.random.default_rng(6)
    spot = 4.0 * np.column_stack([np.arange(60) % 8, np.arange(60) // 8, np.zeros(60)])
    centre = spot.mean(axis=0)
    view = View(centre, 50.0, lambda position: np.full(len(position), 0.9))
    away = View(centre + 500.0, 50.0, lambda position: np.zeros(len(position)))
    tracker = Tracker(TrackerConfig(sigma_position_m=0.1))
    visits = run.visit_s[0][np.diff(run.visit_s[0], append=np.inf) > 15.0]
    for visit in visits:
        there = (run.arrival_s <= visit) & (visit <= run.arrival_s + run.lifetime_s)
        for look in range(40):
            seen = there & (rng.random(60) < 0.9)
            tracker.step(visit + 0.2 * look, spot[seen] + rng.normal(0.0, 0.1, (seen.sum(), 3)), view=view)
        for look in range(15):
            tracker.step(visit + 8.0 + 0.2 * look, np.empty((0, 3)), view=away)
    spells = tracker.static_spells()
    drawn = {int(run.object_id[k]): k for k in range(len(run.object_id))}
    off_m = np.linalg.norm(spells.position_m[:, None] - spot[None], axis=2)
    assert off_m.min(axis=1).max() < 0.3
    of = off_m.argmin(axis=1)
    assert sorted(of.tolist()) == sorted(drawn)
    stay = [drawn[k] for k in of]
    for name in ("elsewhere_s", "first_s", "last_s", "gone_s"):
        direct, tracked = getattr(run, name)[stay], getattr(spells, name)
        known = np.isfinite(direct)
        np.testing.assert_array_equal(tracked[~known], direct[~known])
        assert np.abs(tracked[known] - direct[known]).max() <= 8.0


@pytest.mark.slow
def test_coverage_is_counted_as_it_should_be() -> None:
    """Of one class at two like places: the share of bands that hold the truth, once more by hand."""
    world = replace(SMALL_PATROLS, places=SMALL_PATROLS.places[:2])
    values = judge(world, 2, 3, lambda done: None)
    inside = []
    shares = np.array(SHARES)
    for stream in np.random.SeedSequence(3).spawn(2):
        run = simulate_patrols(world, stream)
        for place in range(2):
            t = world.quantile(0, place, shares)
            _, lower, upper = chosen_family(Stays.of(run, 0, place), t)
            inside.append((lower < 1.0 - shares) & (1.0 - shares < upper))
    assert coverage(values, "chosen family") == pytest.approx(np.mean(inside))


@pytest.mark.slow
@pytest.mark.experiment
def test_bands_hold_the_truth_and_naive_ones_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """The median of 120 groups: a Weibull truth, 95 % bands, gaps between visits of an eighth of a lifetime."""
    judged = {name: ESTIMATORS[name] for name in ("chosen family", *NAIVE)}
    monkeypatch.setattr(truth, "ESTIMATORS", judged)
    values = judge(SMALL_PATROLS, 40, 0, lambda done: None)
    for name in judged:
        at_median = [value["coverage"][SHARES.index(0.5)] for value in values if value["estimator"] == name]
        held = round(float(np.mean(at_median)) * 120)
        if name == "chosen family":
            assert binomtest(held, 120, 0.95).pvalue > 1e-3
        elif name in NAIVE:
            assert binomtest(held, 120, 0.95).pvalue < 1e-6


def write_rooms(folder: Path, rooms: list[str]) -> None:
    lines = ["stamp_s,room", *(f"{60 * k},{room}" for k, room in enumerate(rooms))]
    (folder / "aruba_person_room.csv.gz").write_bytes(gzip.compress("\n".join(lines).encode()))


def test_rooms_by_hand(tmp_path: Path) -> None:
    """Stays of 30 and 50 minutes in turn: looks every 15 minutes see all of them, and none is shorter than two."""
    write_rooms(tmp_path, (["A"] * 30 + ["B"] * 50) * 60)
    rooms = study_rooms(tmp_path)
    one = next(r for r in rooms if r.room == "a" and r.every_s == 900.0)
    assert one.full.time_s.tolist() == [1800.0]
    assert one.n_full == one.n_seen == 59  # the first was there at the beginning
    bounds = one.looks["bounds"]
    assert bounds is not None
    assert (bounds.support_left >= 900.0).all()
    assert (bounds.support_right <= 2700.0).all()
    assert one.distance(bounds) == pytest.approx(0.0, abs=1e-9)
    (value,) = [v for v in as_values(rooms) if v["room"] == "b" and v["every_s"] == 300.0]
    assert value["distance"]["bounds"] == pytest.approx(0.0, abs=1e-9)


def test_rooms_that_are_not_there_are_said_so(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"aruba_person_room.csv.gz: no such file"):
        study_rooms(tmp_path)


@pytest.mark.skipif(not SHARED.is_dir(), reason="needs the recordings in ../shared/data/presence")
def test_the_flat_is_read_whole() -> None:
    rooms = study_rooms(SHARED)
    assert {one.every_s for one in rooms} == {120.0, 300.0, 900.0}
    full = {one.room: one.n_full for one in rooms}
    assert full["kitchen"] == 3104  # counted with awk: changes into the kitchen


def test_settings_that_cannot_be_are_refused() -> None:
    with pytest.raises(ConfigError):
        Settings(repetitions=0)
    with pytest.raises(ConfigError):
        Settings(seed=-1)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lifetimes")
    write_rooms(folder, (["A"] * 30 + ["B"] * 50) * 60)
    settings = Settings(
        moving=SMALL_MOVING, moving_runs=1, patrols=SMALL_PATROLS, repetitions=1, law_repetitions=1, law_counts=(30,)
    )
    told: list[tuple[float, float]] = []
    table = reproduce(folder / "out", settings, data=folder, progress=lambda done, total: told.append((done, total)))
    return folder / "out", table, told, settings


def test_everything_is_written(results) -> None:
    out, table, told, _ = results
    files = {path.name for path in out.iterdir()}
    drawn = {f"{name}.{kind}" for name in ("tracks", "moving", "truth", "coverage", "rooms") for kind in ("png", "svg")}
    assert drawn | {"summary.json", "table.md"} <= files
    written = json.loads((out / "summary.json").read_text())
    assert written["coverage"] == table["coverage"]
    assert set(written["outputs"]) == files
    assert told[-1] == (4.0, 4.0)
    text = (out / "table.md").read_text()
    assert f"{table['coverage']['chosen family']:.1%}" in text
    assert {(row["law"], row["truncated"]) for row in table["laws"]} == {
        (law, t) for law in LAWS for t in (False, True)
    }
    (parked,) = [value for value in table["moving"] if "class" in value]
    assert f"| forklift | {parked['stays']} |" in text


def test_same_seed_same_numbers(results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _, table, _, settings = results
    for name in ("draw_scene", "draw_moving", "draw_truth", "draw_coverage"):  # drawn above
        monkeypatch.setattr(figures, name, lambda *_: None)
    monkeypatch.setattr("evermap_studies.frame.save_all", lambda *_: None)
    again = reproduce(tmp_path / "out", settings)
    assert again["truth"] == table["truth"]
    assert again["moving"] == table["moving"]
    assert again["rooms"] == []


def test_options_of_others_are_refused(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["reproduce", "lifetimes", "--world", "nominal", "--out", str(tmp_path / "x")])
    assert done.exit_code == 2
    assert "No such option: --world" in done.output
