"""Probabilities mean what they say: of what is reported with probability p, the share p is right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from references import static_evidence
from worlds import Move, make_session

from evermap.config import ChangesConfig, RangesConfig
from evermap.estimate.sparse.system import exhaust
from evermap.slam.changes.evidence import compare, landmark_evidence
from evermap.slam.changes.explain import GivenMap
from evermap.slam.changes.weigh import MAP_FACTORS, ChangePosterior, weigh
from evermap.slam.smoother import Smoother

PRIOR = ChangesConfig(p_moved=0.3, move_sigma_m=0.08)
"""A third of the worlds changes, half of them by less than what shows, so that probabilities spread."""
N_LANDMARKS = 10
DURATION_S = 160.0
SIGMA_MAP_M = 0.02
EDGES = (0.0, 0.5, 0.7, 0.85, 0.95, 1.0)


def drawn_moves(rng: np.random.Generator) -> tuple[Move, ...]:
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
        at_s = None if rng.random() < 0.5 else float(rng.uniform(0.05, 0.95) * DURATION_S)
        moves.append(Move(members, (float(by[0]), float(by[1])), turn, at_s))
    return tuple(moves)


def drawn_map_factor(rng: np.random.Generator) -> float:
    """How much worse a map is than it says."""
    return float(np.exp(np.clip(PRIOR.map_factor_spread * rng.normal(), *np.log([MAP_FACTORS[0], MAP_FACTORS[-1]]))))


def is_right(posterior: ChangePosterior, moves: tuple[Move, ...]) -> bool:
    """These groups and no others, and each before the session or within it as it was."""
    found = {(tuple(int(j) for j in group.members), group.window > 0) for group in posterior.groups}
    return found == {(move.members, move.at_s is not None) for move in moves}


def assert_reliable(reports: list[tuple[float, bool]]) -> None:
    """In every bin the share that is right is what was reported, to within three standard errors."""
    p, right = (np.array(column) for column in zip(*reports, strict=True))
    bins = np.clip(np.searchsorted(EDGES, p, side="right") - 1, 0, len(EDGES) - 2)
    print(f"reported {p.mean():.3f}, right {right.mean():.3f}, Brier {np.mean((p - right) ** 2):.3f}")
    apart = []
    for k in range(len(EDGES) - 1):
        mine = bins == k
        if mine.any():
            spread = np.sqrt((p[mine] * (1 - p[mine])).sum()) / mine.sum()
            apart.append(abs(right[mine].mean() - p[mine].mean()) / spread)
            print(
                f"up to {EDGES[k + 1]:.2f}: {mine.sum()} reported {p[mine].mean():.3f}, right {right[mine].mean():.3f}"
            )
    assert max(apart) <= 3.0


def posterior_on_drawn_evidence(seed: int, n_windows: int) -> tuple[float, bool]:
    """A world whose landmarks are measured by 2 cm in every window, from an unknown start."""
    rng = np.random.default_rng([seed, 5])
    moves, factor = drawn_moves(rng), drawn_map_factor(rng)
    if n_windows == 1:
        moves = tuple(replace(move, at_s=None) for move in moves)
    position = rng.uniform(-5.0, 5.0, (N_LANDMARKS, 2))
    plain = static_evidence(position, n_windows)
    e = 0.02 * rng.normal(size=plain.position.shape)
    for move in moves:
        since = 0 if move.at_s is None else int(rng.integers(1, n_windows))
        moved = (plain.window >= since)[:, None]
        e += moved * (move.applied(position) - position)[plain.landmark]
    size = len(plain.pull)
    together = np.tile(np.eye(2), (size // 2, 1))
    information = np.linalg.inv(0.02**2 * np.eye(size) + 100.0 * together @ together.T)
    evidence = replace(plain, position=plain.position + e, information=information)
    mean = position + factor * SIGMA_MAP_M * rng.normal(size=position.shape)
    covariance = np.tile(SIGMA_MAP_M**2 * np.eye(2), (N_LANDMARKS, 1, 1))
    posterior = exhaust(weigh(evidence, GivenMap(mean, covariance, np.ones(N_LANDMARKS, bool)), PRIOR, n_windows))
    return posterior.probability, is_right(posterior, moves)


@pytest.mark.slow
@pytest.mark.experiment
@pytest.mark.parametrize("n_windows", [1, 3])
def test_probabilities_are_reliable_where_the_model_holds(n_windows: int) -> None:
    assert_reliable([posterior_on_drawn_evidence(seed, n_windows) for seed in range(300)])


@pytest.mark.slow
@pytest.mark.experiment
@pytest.mark.xfail(
    reason="of what a session's posterior reports with 0.88 on average, 0.76 is right: changes too small to show weigh "
    "too little against 'nothing moved'",
    strict=False,
)
def test_probabilities_are_reliable_in_sessions() -> None:
    reports = []
    for seed in range(240):
        rng = np.random.default_rng([seed, 2])
        moves, factor = drawn_moves(rng), drawn_map_factor(rng)
        session = make_session(seed, *moves, n_poses=200, n_landmarks=N_LANDMARKS, map_factor=factor)
        method, _ = session.revised(PRIOR)
        assert method.posterior is not None
        reports.append((method.posterior.probability, is_right(method.posterior, moves)))
    assert_reliable(reports)


@pytest.mark.slow
@pytest.mark.experiment
@pytest.mark.parametrize("n_windows", [1, 3])
def test_misfit_of_a_static_world_is_a_chi_square(n_windows: int) -> None:
    """Poses, calibration and size eliminated: what is left of 40 sessions has the spread it says."""
    misfit = freedom = 0.0
    for seed in range(40):
        session = make_session(seed, n_poses=200)
        world, given = session.world, session.given
        assert given is not None
        free = replace(
            session.problem,
            prior=world.problem.prior.without_scale(),
            landmark_information=np.zeros(session.problem.landmark_information.shape),
        )
        estimate = Smoother(free, world.noise).optimum(world.truth)
        bounds = np.linspace(0, 200, n_windows + 1).astype(int)
        evidence = exhaust(
            landmark_evidence(free, estimate, world.noise, world.problem.prior, bounds, 3, RangesConfig())
        )
        comparison = compare(evidence, given.mean, given.covariance, given.given)
        misfit += comparison.misfit
        freedom += comparison.freedom
    assert misfit == pytest.approx(freedom, abs=3.0 * np.sqrt(2.0 * freedom))
