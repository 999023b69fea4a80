"""Probabilities mean what they say: of what is reported with probability p, the share p is right."""

from __future__ import annotations

import numpy as np
import pytest
from worlds import Move, make_session

from evermap.slam.changes.prior import ChangePrior
from evermap.slam.changes.weigh import MAP_FACTOR_SPREAD, MAP_FACTORS

PRIOR = ChangePrior(p_moved=0.3, move_sigma_m=0.08)
"""Half of the moves are smaller than what one sighting tells, so that probabilities spread."""
SESSIONS = 240
N_LANDMARKS = 10
EDGES = (0.0, 0.5, 0.7, 0.85, 0.95, 1.0)


def drawn_moves(rng: np.random.Generator, last_s: float) -> tuple[Move, ...]:
    """Groups as the prior has them: `odds^k / k!` for k of them, sizes `2^-n`, any members, any time."""
    odds = PRIOR.p_moved / (1.0 - PRIOR.p_moved)
    weight = np.array([1.0, odds, odds**2 / 2.0])
    count = rng.choice(3, p=weight / weight.sum())
    left, moves = list(rng.permutation(N_LANDMARKS)), []
    for _ in range(count):
        size = min(int(rng.geometric(0.5)), len(left))
        if size == 0:
            break
        members, left = tuple(sorted(int(j) for j in left[:size])), left[size:]
        turn = PRIOR.turn_sigma_rad * rng.normal() if size > 1 and rng.random() < PRIOR.p_rotated else 0.0
        by = PRIOR.move_sigma_m * rng.normal(size=2)
        at_s = None if rng.random() < 0.5 else float(rng.uniform(0.05, 0.95) * last_s)
        moves.append(Move(members, (float(by[0]), float(by[1])), turn, at_s))
    return tuple(moves)


def reported_and_right(seed: int) -> tuple[float, bool]:
    rng = np.random.default_rng([seed, 2])
    moves = drawn_moves(rng, 160.0)
    factor = float(np.exp(np.clip(MAP_FACTOR_SPREAD * rng.normal(), *np.log([MAP_FACTORS[0], MAP_FACTORS[-1]]))))
    session = make_session(seed, *moves, n_poses=200, n_landmarks=N_LANDMARKS, map_factor=factor)
    method, _ = session.revised(PRIOR)
    assert method.verdict is not None
    found = {(tuple(int(j) for j in group.members), group.window > 0) for group in method.verdict.groups}
    true = {(move.members, move.at_s is not None) for move in moves}
    return method.verdict.probability, found == true


@pytest.mark.slow
def test_probabilities_are_calibrated() -> None:
    p, right = (np.array(column) for column in zip(*map(reported_and_right, range(SESSIONS)), strict=True))
    bins = np.clip(np.searchsorted(EDGES, p, side="right") - 1, 0, len(EDGES) - 2)
    print(f"right {right.mean():.3f}, expected {p.mean():.3f}, Brier {np.mean((p - right) ** 2):.3f}")
    for k in range(len(EDGES) - 1):
        mine = bins == k
        if not mine.any():
            continue
        expected, spread = p[mine].mean(), np.sqrt((p[mine] * (1 - p[mine])).sum()) / mine.sum()
        print(f"up to {EDGES[k + 1]:.2f}: {mine.sum()} reported {expected:.3f}, right {right[mine].mean():.3f}")
        assert abs(right[mine].mean() - expected) <= 3.0 * spread + 1.0 / mine.sum()
