"""False changes: a hand-made world, and a second count over whole studies."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evermap.types import ChangeKind, Landmarks, MapChange, Trajectory
from evermap_studies.demo.claims import REASONS, claim_numbers, claims_of
from evermap_studies.demo.scores import Snapshot
from evermap_studies.demo.study import Visit
from evermap_studies.demo.truth import Truth

IN_PLACE = np.zeros(3)
AWAY = [np.nan, np.nan]


def world(*tracks: list[list[float]], knowable: list[list[int]] | None = None) -> Truth:
    """One landmark a track, one position a session; all of them are detected wherever they stand."""
    position = np.array(tracks, dtype=np.float64).transpose(1, 0, 2)
    there = np.isfinite(position[:, :, 0])
    changed = np.zeros(there.shape, dtype=np.bool_)
    for k in range(1, len(position)):
        changed[k] = [
            not np.array_equal(*pair, equal_nan=True) for pair in zip(position[k - 1], position[k], strict=True)
        ]
    rows = np.array(knowable or [], dtype=np.int64).reshape(-1, 4)
    return Truth(position, position, detected=there, changed=changed, known=there, knowable=rows)


def visit(truth: Truth, session: int, *told: tuple[ChangeKind, float, tuple[int, ...]]) -> Visit:
    """A session of a method that has every landmark where it stands or stood last, and tells some changes."""
    names = np.arange(truth.position_m.shape[1])
    last = np.full((len(names), 2), 99.0)
    for k in range(session + 1):
        last = np.where(np.isfinite(truth.position_m[k]), truth.position_m[k], last)
    changes = tuple(MapChange(who, kind, np.nan, 0.0, (np.nan, np.nan), 0.0, p) for kind, p, who in told)
    path = Trajectory(np.zeros(1), np.zeros((1, 3)), np.zeros((1, 3, 3)))
    nothing = np.zeros(0)
    said = Snapshot(Landmarks.at(names, last), nothing.astype(np.int64), np.zeros((0, 2)), nothing, nothing, 0)
    return Visit(path, True, said, changes, 0.0)


def told_true(truth: Truth, *told: list[tuple[ChangeKind, float, tuple[int, ...]]]) -> list[bool]:
    visits = [visit(truth, k, *what) for k, what in enumerate(told)]
    return claims_of(visits, truth, IN_PLACE).is_true.tolist()


STAYS = [[0.0, 0.0]] * 4
LEAVES = [[0.0, 0.0], [0.0, 0.0], AWAY, AWAY]
RETURNS = [[0.0, 0.0], AWAY, [0.0, 0.0], [0.0, 0.0]]
COMES = [AWAY, AWAY, [0.0, 0.0], [0.0, 0.0]]
MOVES = [[0.0, 0.0], [3.0, 0.0], [3.0, 0.0], [3.0, 0.0]]


@pytest.mark.parametrize(
    ("track", "told", "true"),
    [
        (STAYS, {1: ChangeKind.VANISHED, 2: ChangeKind.RETURNED}, [False, False]),
        (STAYS, {2: ChangeKind.APPEARED}, [False]),
        (STAYS, {3: ChangeKind.MOVED}, [False]),
        (LEAVES, {2: ChangeKind.VANISHED}, [True]),
        (LEAVES, {1: ChangeKind.VANISHED}, [False]),  # too early
        (LEAVES, {3: ChangeKind.VANISHED}, [True]),  # late
        (LEAVES, {2: ChangeKind.VANISHED, 3: ChangeKind.RETURNED}, [True, False]),
        (RETURNS, {1: ChangeKind.VANISHED, 2: ChangeKind.RETURNED}, [True, True]),
        (RETURNS, {2: ChangeKind.VANISHED}, [False]),  # it had left, but is back where the map has it
        (RETURNS, {2: ChangeKind.RETURNED, 3: ChangeKind.MOVED}, [True, False]),
        (COMES, {2: ChangeKind.APPEARED}, [True]),
        (MOVES, {1: ChangeKind.MOVED}, [True]),
        (MOVES, {1: ChangeKind.ROTATED, 2: ChangeKind.MOVED}, [True, False]),
        (MOVES, {1: ChangeKind.VANISHED}, [True]),  # it has left its place
        (MOVES, {1: ChangeKind.VANISHED, 2: ChangeKind.RETURNED}, [True, True]),  # and is found elsewhere
        (MOVES, {1: ChangeKind.VANISHED, 2: ChangeKind.RETURNED, 3: ChangeKind.MOVED}, [True, True, False]),
        (LEAVES, {2: ChangeKind.MOVED}, [False]),  # it is nowhere
    ],
)
def test_what_is_false(track, told, true) -> None:
    truth = world(track, STAYS)
    sessions = [[(told[k], 0.9, (0,))] if k in told else [] for k in range(4)]
    assert told_true(truth, *sessions) == true


def test_numbers_of_a_hand_made_study() -> None:
    """Landmark 0 stays, 1 leaves, 2 moves with 3; names that nothing carries are nobody's."""
    truth = world(STAYS, LEAVES, MOVES, MOVES, knowable=[[1, 1, 2, 4], [2, 1, 1, 4], [3, 1, 3, 4]])
    visits = [
        visit(truth, 0),
        visit(truth, 1, (ChangeKind.MOVED, 0.8, (2, 3)), (ChangeKind.VANISHED, 0.995, (0,))),
        visit(truth, 2, (ChangeKind.RETURNED, 0.5, (0,)), (ChangeKind.MOVED, 1.0, (77,))),
        visit(truth, 3, (ChangeKind.APPEARED, 0.999, (0,))),
    ]
    claims = claims_of(visits, truth, IN_PLACE)
    numbers = claim_numbers(claims, truth, np.ones(4, np.bool_))
    assert (numbers["told"], numbers["false"], numbers["false_certain"]) == (5, 3, 2)
    assert (numbers["never_changed"], numbers["never_changed_certain"]) == (3, 2)
    assert numbers["false_by_reason"] == {"came": 2, "vanished": 1, "moved": 0}
    assert numbers["told_brier"] == pytest.approx((0.2**2 * 2 + 0.995**2 + 0.25 + 0.999**2) / 5)
    assert (numbers["knowable"], numbers["recalled"]) == (3, 2)  # that 1 has left was never told
    second = claim_numbers(claims, truth, np.arange(4) == 1)
    assert (second["told"], second["false"], second["false_share"]) == (3, 1, pytest.approx(1 / 3))
    assert (second["knowable"], second["recalled"]) == (1, 1)
    nothing = claim_numbers(claims, truth, np.arange(4) == 0)
    assert (nothing["told"], nothing["false_share"], nothing["told_brier"], nothing["told_recall"]) == (
        0,
        None,
        None,
        None,
    )


KINDS = [kind for kinds in REASONS.values() for kind in kinds]


@given(st.lists(st.lists(st.tuples(st.sampled_from(KINDS), st.floats(0.0, 1.0)), max_size=2), min_size=4, max_size=4))
def test_in_a_world_that_stands_still_everything_told_is_false(told) -> None:
    truth = world(STAYS, [[5.0, 5.0]] * 4)
    visits = [visit(truth, k, *((kind, p, (0, 1)) for kind, p in what)) for k, what in enumerate(told)]
    numbers = claim_numbers(claims_of(visits, truth, IN_PLACE), truth, np.ones(4, np.bool_))
    assert numbers["told"] == numbers["false"] == numbers["never_changed"] == 2 * sum(map(len, told))
    assert sum(numbers["false_by_reason"].values()) == numbers["false"]
