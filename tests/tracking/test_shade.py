"""What a box hides is missed for no reason of its own: nothing came there, and nothing left."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evermap.config import TrackConfig
from evermap.tracking.frame import DetectionTable
from evermap.tracking.run import TrackResult, make_tracker, run_track
from evermap.tracking.tracker import Tracker
from evermap.tracking.views import View, ViewMemory
from evermap.types import FloatArray

CONFIG = TrackConfig(range_m=25.0, sigma_position_m=0.1)
STEP_S, SPEED_MPS, SENSOR_Z_M, TAKEN_S = 0.1, 2.5, 1.5, 18.4
CAR = np.array([4.0, 1.8, 1.6, 0.0])
NEAR = np.column_stack([np.arange(10.0, 60.0, 8.0), np.full(7, 4.0), np.full(7, 0.8)])
BEHIND = NEAR[:6] + [3.0, 4.0, 0.0]
CARS = np.concatenate([NEAR, BEHIND])
TAKEN = len(NEAR) + 3
P_DETECT = 0.85
STAMP_S = STEP_S * np.arange(300)
EYES = np.column_stack([SPEED_MPS * STAMP_S - 8.0, 0.0 * STAMP_S, np.full(len(STAMP_S), SENSOR_Z_M)])
BOXES = np.tile(CAR, (300 * len(CARS), 1))


def is_in_sight(eye: FloatArray, middle: FloatArray, others: FloatArray, box: FloatArray = CAR) -> bool:
    """By points along the line of sight: none lies in a box between."""
    line = eye + np.linspace(0.0, 1.0, 200)[:, None] * (middle - eye)
    off, (cos, sin) = line[:, None] - others, (np.cos(box[3]), np.sin(box[3]))
    own = np.stack([cos * off[..., 0] + sin * off[..., 1], cos * off[..., 1] - sin * off[..., 0], off[..., 2]], axis=-1)
    return not (np.abs(own) < 0.5 * box[:3]).all(axis=2).any()


def drive_past(seed: int, *, taken: int = -1, sensor_z_m: float = SENSOR_Z_M) -> DetectionTable:
    """A row of parked cars, and another one behind it, past which a sensor drives that sees all around."""
    random = np.random.default_rng(seed)
    eyes = EYES + [0.0, 0.0, sensor_z_m - SENSOR_Z_M]
    frames = []
    for now, eye in zip(STAMP_S, eyes, strict=True):
        stands = [k for k in range(len(CARS)) if k != taken or now < TAKEN_S]
        seen = [
            CARS[k]
            for k in stands
            if np.linalg.norm(CARS[k] - eye) < 25.0
            and random.random() < P_DETECT
            and is_in_sight(eye, CARS[k], CARS[[j for j in stands if j != k]])
        ]
        frames.append(np.array(seen).reshape(-1, 3) + 0.05 * random.standard_normal((len(seen), 3)))
    counts = [len(frame) for frame in frames]
    return DetectionTable(
        stamp_s=STAMP_S,
        first=np.concatenate([[0], np.cumsum(counts)]),
        position_m=np.concatenate(frames),
        class_names=("",),
        class_id=np.zeros(sum(counts), dtype=np.int64),
        covariance_m2=None,
        appearance=None,
        sensor_m=eyes,
        line=np.arange(sum(counts)),
        source="",
        box=BOXES[: sum(counts)],
    )


def list_ended(result: TrackResult) -> FloatArray:
    return result.spells.position_m[np.isfinite(result.spells.gone_s)]


@pytest.mark.parametrize("sensor_z_m", [SENSOR_Z_M, 6.0])
def test_what_comes_out_from_behind_a_parked_car_has_not_arrived(sensor_z_m: float) -> None:
    """Nor has it left when it is hidden again; a sensor on a mast sees it all the time."""
    result = run_track(drive_past(1, sensor_z_m=sensor_z_m), CONFIG)
    assert len(result.spells) == len(CARS)
    assert np.isinf(result.spells.elsewhere_s).sum() >= len(CARS) - 1
    assert len(list_ended(result)) == 0


@pytest.mark.parametrize(("range_m", "why"), [(25.0, "not observed before"), (None, "without `range_m`")])
def test_it_is_told_why_no_beginning_is_known(range_m: float | None, why: str) -> None:
    """Without a range nothing is a look: who wants lifetimes has to state it."""
    result = run_track(drive_past(1), CONFIG.model_copy(update={"range_m": range_m}))
    (told,) = [remark for remark in result.warnings if "beginning has no bound" in remark]
    assert why in told
    assert told.startswith(f"{np.isinf(result.spells.elsewhere_s).sum()} spells")


@pytest.mark.parametrize("sensor_z_m", [SENSOR_Z_M, 6.0])
def test_what_leaves_is_gone_once_its_place_is_in_sight(sensor_z_m: float) -> None:
    result = run_track(drive_past(1, taken=TAKEN, sensor_z_m=sensor_z_m), CONFIG)
    np.testing.assert_allclose(list_ended(result), CARS[[TAKEN]], atol=0.15)


def sees(view: View, *at_m: tuple[float, float, float]) -> list[bool]:
    return (view.probability(np.array(at_m)) > 0.5).tolist()


def test_a_box_hides_what_is_behind_it_and_nothing_else() -> None:
    ball = View.ball(np.array([1.0, 0.0, 1.5]), 40.0, 0.9)
    turned = np.array([[4.0, 2.0, 1.6, 0.5 * np.pi]])  # 4 m across the line of sight
    view = ball.hide_behind(np.array([[11.0, 0.0, 0.8]]), turned)
    behind, beside, before, above, itself = (
        (21.0, 3.5, 0.8),
        (21.0, 4.6, 0.8),
        (8.0, 0.0, 0.8),
        (21.0, 0.0, 3.0),
        (11.0, 0.0, 0.8),
    )
    assert sees(view, behind, beside, before, above, itself) == [False, True, True, True, True]
    below = ball.hide_behind(np.array([[11.0, 0.0, 3.0]]), turned)  # a bridge
    assert sees(below, behind) == [True]
    back = ball.hide_behind(np.array([[-9.0, 0.0, 0.8]]), turned)  # its bearings lie on both sides of half a turn
    assert sees(back, (-19.0, 1.0, 0.8), (-19.0, -1.0, 0.8), behind) == [False, False, True]
    assert sees(ball.hide_behind(np.array([[1.2, 0.0, 1.0]]), turned), behind, before) == [True, True]  # on the sensor
    both = view.hide_behind(np.array([[-9.0, 0.0, 0.8]]), turned)
    assert sees(both, behind, (-19.0, 1.0, 0.8), beside) == [False, False, True]


def test_what_a_turned_box_hides_is_what_lines_of_sight_through_it_lead_to() -> None:
    random, eye, found = np.random.default_rng(3), np.array([1.0, -2.0, 1.0]), list[bool]()
    for _ in range(60):
        yaw, away = random.uniform(-np.pi, np.pi, 2)
        box = np.array([5.0, 2.0, 1.5, yaw])
        middle = eye + [9.0 * np.cos(away), 9.0 * np.sin(away), 0.2]
        turn = away + random.uniform(-0.5, 0.5, 10)
        at = eye + np.column_stack([20.0 * np.cos(turn), 20.0 * np.sin(turn), np.zeros(10)])
        view = View.ball(eye, 40.0, 0.9).hide_behind(middle[None], box[None])
        hidden = [not is_in_sight(eye, one, middle[None], box) for one in at]
        found.append((view.probability(at) == 0.0).tolist() == hidden)
    assert np.mean(found) > 0.95  # points along a line miss what it cuts by a corner


def test_a_saved_tracker_knows_what_it_did_not_see(tmp_path: Path) -> None:
    """Also a memory of views without shades is read, as older ones are."""
    memory, again, older = (ViewMemory(3.0, n_recent=2) for _ in range(3))
    shaded = View.ball(np.zeros(3), 30.0, 0.9).hide_behind(np.array([[10.0, 0.0, 0.0]]), CAR[None])
    for k in range(8):
        memory.add(float(k), shaded)
    again.restore(memory.columns())
    older.restore({name: of for name, of in memory.columns().items() if "shade" not in name})
    hidden, clear = np.array([20.0, 0.0, 0.0]), np.array([0.0, 20.0, 0.0])
    assert [one.last_empty_s(hidden, 99.0) for one in (memory, again)] == [-np.inf, -np.inf]
    assert [one.last_empty_s(clear, 99.0) for one in (memory, again, older)] == [6.0, 6.0, 6.0]
    assert older.last_empty_s(hidden, 99.0) == 6.0
    table = drive_past(1)
    tracker = make_tracker(table, CONFIG)
    run_track(table, CONFIG, tracker=tracker)
    saved = tracker.save(tmp_path / "state")
    assert Tracker.load(saved).save(tmp_path / "again").read_bytes() == saved.read_bytes()
