"""Which mode holds when, and where everything is, in turns until neither changes (Nielsen 2024 sections 5 and 7).

Given poses and modes, a selector chooses the mode of every look; given those, the problem is plain least squares. No
indicator changes any more after a few rounds, or the rounds come back to a selection that was there before: then the
best one seen counts. Bayes' rule would have poses and indicators sought together; what this alternation cannot find is
why `joint` exists.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from evermap.config import ModesConfig
from evermap.slam.problem import Estimate, Noise, Problem
from evermap.slam.smoother import Smoother
from evermap.survival.text import parse_prior
from evermap.types import IntArray, Sensor
from evermap_studies.nielsen2024.modes.evidence import united
from evermap_studies.nielsen2024.modes.gating import gate_threshold, with_births, with_map_restored
from evermap_studies.nielsen2024.modes.looks import Looks, look_at_modes, news_in_a_miss
from evermap_studies.nielsen2024.modes.places import FREE, Modes, at_places, compacted
from evermap_studies.nielsen2024.selectors.chain import ModeChain
from evermap_studies.nielsen2024.selectors.protocol import Selection, Selector, selector_by_name

SOLVER_ITERATIONS = 4
SOLVER_TOLERANCE = 1e-4
"""Of every round: the next one starts where it ended [m, rad]."""
PASSES = 3
"""Births and alternations, at most; two are enough where the trajectory is not far off."""
LEAST_SWITCH = 1e-300
"""A switch that is ruled out still leaves a filter that can recover."""


@dataclass(frozen=True, slots=True)
class ModeModel:
    """How landmarks are believed to change their modes, and how the modes are selected.

    Attributes:
        selector: chooses modes, given poses and positions.
        chain: how modes change from look to look.
        sensor: field of view and detection probability.
        gate: squared Mahalanobis distance from which a detection is none of a mode.
        switch_cost: nats of one switch, for weighing whether a mode pays for itself.
        weighs: modes must pay for themselves; False takes every mode that is born and selected, as the paper does.
        rounds: of selecting and solving, at most.
        chained: whether the selector knows the chain, or takes every look by itself.
        negative_information: whether misses count in the selection.
        robust: explain outliers, in the selection as in the least squares.
    """

    selector: Selector
    chain: ModeChain
    sensor: Sensor
    gate: float
    switch_cost: float
    weighs: bool
    rounds: int
    chained: bool
    negative_information: bool
    robust: bool

    @property
    def surprise(self) -> float:
        """Nats by which detections must speak against all modes before they start one: a switch each way."""
        return 2.0 * self.switch_cost if self.weighs else 0.0

    @classmethod
    def from_settings(cls, method: str, settings: ModesConfig, sensor: Sensor, *, robust: bool = True) -> ModeModel:
        """By the name of a method, as in `slam.method`; `max-mixture` neither iterates nor looks at misses.

        Raises:
            ConfigError: no such method, or a lifetime that cannot be read.
        """
        plain = method == "max-mixture"
        lifetime = None if settings.lifetime is None else parse_prior(settings.lifetime)
        return cls(
            selector=selector_by_name(method, mcts_budget=settings.mcts_budget, mcts_window_s=settings.mcts_window_s),
            chain=ModeChain(switch_probability=settings.switch_probability, lifetime=lifetime),
            sensor=sensor,
            gate=gate_threshold(settings.gate_probability),
            switch_cost=-math.log(max(settings.switch_probability, LEAST_SWITCH)),
            weighs=settings.births == "evidence",
            rounds=1 if plain else settings.rounds,
            chained=method not in {"max-mixture", "nn"},
            negative_information=not plain,
            robust=robust,
        )


@dataclass(frozen=True, slots=True)
class Explanation:
    """What is where, and which mode held at every look.

    Attributes:
        problem: with every detection at its mode.
        estimate: its optimum.
        modes: whose mode each place is.
        looks: at the landmarks that have several modes.
        selection: their modes.
        settled: no indicator changed in the last round; False where they went in circles or the rounds ran out.
    """

    problem: Problem
    estimate: Estimate
    modes: Modes
    looks: Looks
    selection: Selection
    settled: bool


def explain_with_modes(
    problem: Problem,
    estimate: Estimate,
    noise: Noise,
    modes: Modes,
    model: ModeModel,
    rng: np.random.Generator,
    *,
    heavy: bool = False,
    anew: bool = False,
) -> Explanation:
    """Births, the alternation and the uniting, again and again until a pass changes nothing.

    A pass that ends where it began may still have straightened the trajectory, and then other gates fail: what moved
    together shows when the others have let go of it.

    Args:
        problem: the measurements, with every detection at some mode of its landmark.
        estimate: its optimum.
        noise: the noise levels.
        modes: whose mode each place is.
        model: how modes change and are selected.
        rng: for selectors that draw.
        heavy: outliers have the Cauchy's tails in the least squares.
        anew: selectors with a window decide about everything again.
    """
    estimate = _with_map(problem, estimate, modes)
    miss_weight = news_in_a_miss(problem, estimate, modes, model.sensor) if model.negative_information else 0.0
    most_gain = noise.outlier_log_odds if model.robust else math.inf
    for _ in range(PASSES):
        given = problem.landmark_row
        marginals = Smoother(problem, noise, heavy=heavy, robust=model.robust).marginals(estimate)
        problem, estimate, modes, lost = with_births(
            problem, estimate, marginals, noise, modes, model.gate, surprise=model.surprise
        )
        problem, estimate, modes = with_map_restored(problem, estimate, marginals, modes, model.switch_cost)
        # what a selector with a window may keep: detections that gate with the mode that they were given
        kept = np.where(lost | anew, FREE, given)
        found = _alternate(problem, estimate, noise, modes, model, rng, miss_weight, kept, given, heavy=heavy)
        while model.weighs:
            problem, estimate, modes = _weighed(found, noise, model.switch_cost, most_gain, heavy=heavy)
            if modes is found.modes:
                break
            kept = problem.landmark_row
            found = _alternate(problem, estimate, noise, modes, model, rng, miss_weight, kept, None, heavy=heavy)
        problem, estimate, modes = found.problem, found.estimate, found.modes
        if not found.settled or np.array_equal(problem.landmark_row, given):
            break
        anew = False
    problem, estimate, modes, to = compacted(problem, estimate, modes)
    table = np.where(found.looks.table != FREE, to[found.looks.table], FREE)
    return replace(found, problem=problem, estimate=estimate, modes=modes, looks=replace(found.looks, table=table))


def _weighed(
    found: Explanation, noise: Noise, switch_cost: float, outlier_cost: float, *, heavy: bool
) -> tuple[Problem, Estimate, Modes]:
    """Without the modes that do not pay for themselves."""
    problem, estimate, modes = found.problem, found.estimate, found.modes
    if not len(found.looks.several):
        return problem, estimate, modes
    smoother = Smoother(problem, noise, heavy=heavy, robust=math.isfinite(outlier_cost))
    marginals, weights = smoother.marginals(estimate), smoother.inlier_probability(estimate)
    return united(problem, estimate, marginals, weights, modes, switch_cost=switch_cost, outlier_cost=outlier_cost)


def _with_map(problem: Problem, estimate: Estimate, modes: Modes) -> Estimate:
    """Where the prior map holds a landmark that was seen, but never there, that place is one of its modes too."""
    seen = np.zeros(modes.n_landmarks, dtype=np.bool_)
    seen[modes.landmark[problem.landmark_row]] = True
    unseen = np.flatnonzero(seen & (problem.mapped & ~estimate.known)[: modes.n_landmarks])
    return at_places(estimate, unseen, problem.landmark_mean[unseen]) if len(unseen) else estimate


def _alternate(
    problem: Problem,
    estimate: Estimate,
    noise: Noise,
    modes: Modes,
    model: ModeModel,
    rng: np.random.Generator,
    miss_weight: float,
    kept: IntArray,
    solved: IntArray | None,
    *,
    heavy: bool,
) -> Explanation:
    """Select, solve, and so on with the same modes; the best of all if it does not settle.

    Nothing is solved where the selection is that of which the estimate is the optimum, `solved`.
    """
    best, best_score = None, -np.inf
    seen: set[bytes] = set()
    for _ in range(model.rounds):
        looks = look_at_modes(
            problem, estimate, noise, modes, model.sensor, miss_weight=miss_weight, robust=model.robust
        )
        previous = looks.columns_of(kept)
        selection = model.selector.select(looks.evidence, model.chain, rng, previous=previous)
        problem = looks.assigned(problem, selection.indicator)
        estimate, modes = _without_empty(problem, estimate, modes)
        if solved is not None and np.array_equal(problem.landmark_row, solved):
            return Explanation(problem, estimate, modes, looks, selection, settled=True)
        solved = kept = problem.landmark_row
        smoother = Smoother(problem, noise, heavy=heavy, robust=model.robust)
        estimate = smoother.optimum(estimate, iterations=SOLVER_ITERATIONS, tolerance=SOLVER_TOLERANCE)
        score = looks.prior_score(selection.indicator, selection.log_joint) - smoother.cost(estimate)
        if best is None or score > best_score:
            best = Explanation(problem, estimate, modes, looks, selection, settled=False)
            best_score = score
        if problem.landmark_row.tobytes() in seen:
            break
        seen.add(problem.landmark_row.tobytes())
    assert best is not None
    return best


def _without_empty(problem: Problem, estimate: Estimate, modes: Modes) -> tuple[Estimate, Modes]:
    """Without the modes that no detection holds: never selected, never again. The prior map's stay, seen or not."""
    count = np.bincount(problem.landmark_row, minlength=len(modes.landmark))
    empty = np.flatnonzero((modes.landmark != FREE) & estimate.known & ~problem.mapped & (count == 0))
    if len(empty) == 0:
        return estimate, modes
    return at_places(estimate, empty, np.nan), modes.without(empty)
