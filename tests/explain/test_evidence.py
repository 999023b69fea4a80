"""The log evidence and the score of one more number, against dense algebra on a small linear problem."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from evermap.config import SlamConfig
from evermap.config.slam import NoiseConfig
from evermap.estimate.graph import Border, Graph, Layout, Room, build_structure, grouped
from evermap.estimate.sparse.system import exhaust
from evermap.explain import scores
from evermap.explain.causes.suspect import USUAL_P, Suspect
from evermap.explain.evidence import (
    LOG_2PI,
    DetectionTerms,
    Optimum,
    ScalePrior,
    Screen,
    _in_own_room,
    evidence_at,
    log_evidence,
    price_scales,
    weigh_levels,
)
from evermap.slam.estimate import solve
from evermap.slam.room import ROOM_M

from .worlds import World

N_POSES, N_PLACES = 6, 3


@dataclass(frozen=True)
class LinearBlock:
    """Factors `z = A x + noise` of variance 1."""

    ties: np.ndarray
    jacobian: np.ndarray
    measured: np.ndarray
    pose: np.ndarray

    @property
    def rows(self) -> np.ndarray:
        return np.full(len(self.ties), self.jacobian.shape[1])

    def linearise(self, state: np.ndarray, out: Room) -> Iterator[float]:
        """All numbers are of one dimension."""
        residual = np.einsum("frk,fk->fr", self.jacobian, state[self.ties]) - self.measured
        out.values[:] = np.concatenate([self.jacobian, -residual[..., None]], axis=2).ravel()
        yield 0.0
        return 0.5 * float((residual**2).sum())


@pytest.fixture
def problem() -> tuple[Graph[np.ndarray], np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(3)
    border = N_POSES + N_PLACES
    step = np.arange(N_POSES - 1)
    driven = np.column_stack([step, step + 1, np.full(N_POSES - 1, border)])
    pose, place = np.repeat(np.arange(N_POSES), 2), random.integers(0, N_PLACES, 2 * N_POSES)
    seen = np.column_stack([pose, N_POSES + place, np.full(2 * N_POSES, border)])
    start = np.zeros((1, 1), dtype=np.int64)
    blocks = tuple(
        LinearBlock(ties, random.normal(size=(len(ties), 2, ties.shape[1])), random.normal(size=(len(ties), 2)), at)
        for ties, at in ((driven, step), (seen, pose), (start, np.zeros(1, dtype=np.int64)))
    )
    layout = Layout(
        np.ones(border + 1, dtype=np.int64), np.array([border]), grouped(N_POSES, 2),
        np.column_stack([np.arange(N_POSES), random.normal(size=N_POSES)]).astype(float),
    )  # fmt: skip
    held = np.zeros(border + 1)
    held[N_POSES:border] = 0.25
    prior = Border(np.array([4.0]), lambda state: state[-1:])
    graph = Graph(blocks, exhaust(build_structure(layout, blocks)), prior, held, lambda x, step: (x + step, 0.0))
    rows = [np.zeros(border + 1) for _ in range(2 * sum(len(block.ties) for block in blocks))]
    measured = np.concatenate([block.measured.ravel() for block in blocks])
    at = 0
    for block in blocks:
        for ties, jacobian in zip(block.ties, block.jacobian, strict=True):
            for row in jacobian:
                rows[at][ties] = row
                at += 1
    information = np.append(np.zeros(N_POSES), [0.25] * N_PLACES + [4.0])
    return graph, np.array(rows), measured, information


def test_evidence_is_the_marginal_likelihood_of_a_linear_problem(problem: tuple) -> None:
    graph, dense, measured, information = problem
    # of the poses nothing is known beforehand but what is measured: a wide prior, the same on both sides
    held = graph.held.copy()
    held[:N_POSES] = information[:N_POSES] = 1e-2
    graph = Graph(graph.blocks, graph.structure, graph.border, held, graph.retract)
    hessian = dense.T @ dense + np.diag(information)
    state = np.linalg.solve(hessian, dense.T @ measured)
    now = exhaust(graph.linearised(state))
    free = information[:-1]  # priors of all but the border
    quadratic = 0.5 * float(free @ state[:-1] ** 2)
    peaks = 0.5 * float(np.log(free).sum()) - 0.5 * len(free) * LOG_2PI - 0.5 * len(measured) * LOG_2PI - quadratic
    empty = DetectionTerms(*(np.zeros(0) for _ in range(5)))
    found = evidence_at(Optimum(graph, now, state, empty, peaks, 0.0, 1.0))
    exact = multivariate_normal(cov=np.eye(len(measured)) + dense @ np.diag(1.0 / information) @ dense.T)
    assert found == pytest.approx(float(exact.logpdf(measured)), abs=1e-8)
    solved = exhaust(graph.factorised(now))
    assert solved.log_determinant == pytest.approx(float(np.linalg.slogdet(hessian)[1]), abs=1e-9)


def test_score_is_the_step_of_one_more_number(problem: tuple) -> None:
    graph, dense, measured, information = problem
    random = np.random.default_rng(5)
    state = np.linalg.solve(dense.T @ dense + np.diag(information), dense.T @ measured)
    state = state + 0.01 * random.normal(size=len(state))  # nearly at the optimum, as an iteration ends
    now = exhaust(graph.linearised(state))
    empty = DetectionTerms(*(np.zeros(0) for _ in range(5)))
    screen = Screen.of(Optimum(graph, now, state, empty, 0.0, 0.0, 1.0))
    direction, prior, off = random.normal(size=len(measured)), 3.0, 0.2
    score = screen.score(direction, prior, off)
    wider = np.column_stack([dense, direction])
    whole = wider.T @ wider + np.diag(np.append(information, prior))
    # the priors of what is held pull to where it is, that of the border to its mean
    pull = -wider.T @ (dense @ state - measured)
    pull[-2] -= 4.0 * state[-1]
    pull[-1] -= prior * off
    step = np.linalg.solve(whole, pull)
    assert score.value == pytest.approx(step[-1], rel=1e-6)
    assert score.information == pytest.approx(1.0 / np.linalg.inv(whole)[-1, -1], rel=1e-6)


def test_two_more_numbers_share_what_is_left_of_them_without_all_others(problem: tuple) -> None:
    graph, dense, measured, information = problem
    random = np.random.default_rng(6)
    state = np.linalg.solve(dense.T @ dense + np.diag(information), dense.T @ measured)
    now = exhaust(graph.linearised(state))
    empty = DetectionTerms(*(np.zeros(0) for _ in range(5)))
    screen = Screen.of(Optimum(graph, now, state, empty, 0.0, 0.0, 1.0))
    directions = random.normal(size=(2, len(measured)))
    one, two = (screen.column(each) for each in directions)
    hessian = dense.T @ dense + np.diag(information)
    moves = np.linalg.solve(hessian, dense.T @ directions.T)
    left = directions @ directions.T - directions @ dense @ moves
    found = [[each.information_with(other) for other in (one, two)] for each in (one, two)]
    np.testing.assert_allclose(found, left, rtol=1e-9)
    begin = graph.structure.system.tree.begin[: len(state)]
    np.testing.assert_allclose(one.step()[begin], -moves[:, 0], rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("value", [1e-6, 0.3, 30.0])
def test_the_variance_of_a_slope_is_by_residuals_before_or_after_its_step(problem: tuple, value: float) -> None:
    """Of a long step few rows would make more of what is linear than there is: of the two the smaller holds."""
    graph, dense, measured, information = problem
    state = np.linalg.solve(dense.T @ dense + np.diag(information), dense.T @ measured)
    now = exhaust(graph.linearised(state))
    empty = DetectionTerms(*(np.zeros(0) for _ in range(5)))
    screen = Screen.of(Optimum(graph, now, state, empty, 0.0, 0.0, 1.0))
    column = screen.column(np.random.default_rng(7).normal(size=len(measured)))
    begin = graph.structure.system.tree.begin[: len(state)]
    with_all = column.told + dense @ column.step()[begin]
    before, after = (with_all * screen.residual) ** 2, (with_all * (screen.residual + value * with_all)) ** 2
    assert screen.variance(column, value) == pytest.approx(min(before.sum(), after.sum()), rel=1e-4)
    best = -(with_all @ screen.residual) / (with_all @ with_all)
    after = (with_all * (screen.residual + best * with_all)) ** 2
    assert screen.variance(column, best) == pytest.approx(min(before.sum(), after.sum()), rel=1e-4)


def optimum_with(problem: tuple, *scales: ScalePrior, worth: float = 1.0) -> tuple[Optimum, float, float]:
    """Return the optimum of the problem with scales, what data say of the border, and its standard deviation."""
    graph, dense, measured, information = problem
    hessian = dense.T @ dense + np.diag(information)
    state = np.linalg.solve(hessian, dense.T @ measured)
    now = exhaust(graph.linearised(state))
    empty = DetectionTerms(*(np.zeros(0) for _ in range(5)))
    without = np.linalg.inv(hessian - np.diag(np.append(np.zeros(N_POSES + N_PLACES), 4.0)))
    told = without @ dense.T @ measured  # without the prior of the border
    return Optimum(graph, now, state, empty, 0.0, 0.0, worth, scales), float(told[-1]), float(without[-1, -1] ** 0.5)


@pytest.mark.parametrize("worth", [1.0, 0.25])
@pytest.mark.parametrize("stated", [0.0, 0.7, -30.0])
def test_a_scale_has_the_density_of_what_is_meant_of_it(problem: tuple, stated: float, worth: float) -> None:
    """As stated, as usual, or by a cause: whatever prior it was found with is taken off."""
    state = optimum_with(problem)[0].state[-1]
    scale = ScalePrior(0, float(state - stated), 0.2, 0.3, 5.0)
    optimum, told, sigma = optimum_with(problem, scale, worth=worth)
    meant, found = price_scales(optimum)
    assert found == pytest.approx(norm(0.0, np.hypot(sigma, 0.5)).logpdf(told), rel=1e-9)
    wider = sigma / worth**0.5
    density = sum(
        p * norm(0.0, np.hypot(wider, width)).pdf(told - stated)
        for p, width in ((0.7, 0.0), (0.3, 0.2), (USUAL_P, 5.0))
    )
    assert meant == pytest.approx(np.log(density), rel=1e-6)


def test_a_scale_that_is_held_is_as_stated(problem: tuple) -> None:
    meant, found = price_scales(optimum_with(problem, ScalePrior(0, 0.0, 0.0, 0.3, 5.0))[0])
    assert (meant, found) == (pytest.approx(np.log(0.7)), 0.0)
    assert price_scales(optimum_with(problem)[0]) == (0.0, 0.0)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_longer_metre_gives_places_no_room(dim: int) -> None:
    """All places have the more room the longer lengths are: of each number so much is taken off again."""
    random = np.random.default_rng(2)
    pose, place = random.normal(size=(30, dim)) + 7.0, random.normal(size=(9, dim))
    room = _in_own_room(pose, place)
    assert _in_own_room(1.06 * pose, 1.06 * place) - room == pytest.approx(9 * dim * np.log(1.06))
    everywhere = np.concatenate([pose, place])
    extent = np.median(np.linalg.norm(everywhere - np.median(everywhere, axis=0), axis=1))
    assert room == pytest.approx(9 * dim * np.log(extent / ROOM_M))
    assert np.isfinite(_in_own_room(np.zeros((3, dim)), np.zeros((2, dim))))


def test_what_is_usual_of_odometry_is_marginalised(problem: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    """Exactly, where all is linear; a state of the solution is marginalised already."""
    graph, dense, measured, information = problem
    held = graph.held.copy()
    held[:N_POSES] = information[:N_POSES] = 1e-2
    graph = Graph(graph.blocks, graph.structure, graph.border, held, graph.retract)
    state = np.zeros(len(information))  # nothing pulls there but what was measured
    now = exhaust(graph.linearised(state))
    empty = DetectionTerms(*(np.zeros(0) for _ in range(5)))
    optimum = Optimum(graph, now, state, empty, 0.0, 0.0, 1.0)
    names = ("turn-bias", "turn-scale")
    directions = np.random.default_rng(8).normal(size=(2, len(measured)))
    widths = zip(names, (3.0, 8.0), strict=True)
    usual = [Suspect(name, "odometry", 0.1, lambda one, _: one, str, str, sigma) for name, sigma in widths]

    def list_usual(_: object, screen: Screen, __: object) -> list[scores._Usual]:
        columns = [screen.column(one) for one in directions]
        rows = zip(usual, directions, columns, strict=True)
        return [scores._Usual(one, way, column, screen.pull(column)) for one, way, column in rows]

    monkeypatch.setattr(scores, "_list_usual", list_usual)
    monkeypatch.setattr(scores, "_is_state", lambda *_: False)
    own = np.eye(len(measured)) + dense @ np.diag(1.0 / information) @ dense.T
    sigma = scores.USUAL_SHARE * np.array([3.0, 8.0])
    wider = own + (directions.T * sigma**2) @ directions
    exact = multivariate_normal(cov=wider).logpdf(measured) - multivariate_normal(cov=own).logpdf(measured)
    asked = scores.ScreenedSession(cast("Any", None), cast("Any", None))
    monkeypatch.setattr(scores, "optimum_of", lambda _: optimum)
    assert scores.weigh_usual(asked) == pytest.approx(float(exact), abs=1e-6)
    monkeypatch.setattr(scores, "_is_state", lambda *_: True)
    assert scores.weigh_usual(asked) == 0.0


@pytest.mark.parametrize("seed", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_levels_without_what_was_imagined_are_worth_what_they_gain(seed: int) -> None:
    """As of a solution that imagines next to nothing; its levels are half as large."""
    recording, rules = World(seed=seed, seconds=60.0).plane(), SlamConfig(method="nohyp")

    def imagine(count: float) -> Any:
        return solve(recording, rules.model_copy(update={"noise": NoiseConfig(pseudo_count=count)}))

    usual, free = imagine(1.0), imagine(1e-3)
    assert free.outcome.noise.noise.odometry[2] < 0.6 * usual.outcome.noise.noise.odometry[2]
    gained = log_evidence(free) - log_evidence(usual)
    assert gained > 10.0
    assert weigh_levels(usual) == pytest.approx(gained, rel=0.15)
    assert 0.0 <= weigh_levels(free) < 0.05 * gained
    values = usual.outcome.graph_estimate
    pose = values.pose + np.random.default_rng(seed).normal(0.0, 0.3, values.pose.shape)
    astray = replace(usual.outcome, graph_estimate=replace(values, pose=pose))
    assert weigh_levels(replace(usual, outcome=astray)) < 10.0 * gained  # levels that are of nothing: not thousands
    assert weigh_levels(replace(usual, settings=rules.model_copy(update={"estimate_noise": False}))) == 0.0
