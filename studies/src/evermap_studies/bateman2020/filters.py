"""The filters of the experiment by name: beliefs of a whole stack of runs, step by step.

The thesis' filters are "updated for all landmarks in a clique if any one of the constituent landmark is visible"
(section 3.4): a look is at all of them, in the field or not. Those beyond the thesis are updated with the landmarks in
the field alone.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from evermap.existence import single
from evermap.existence.single import Belief
from evermap.sensing.profile import Profile
from evermap.survival import Exponential
from evermap.types import BoolArray, FloatArray, IntArray
from evermap_studies.bateman2020 import jff, joint
from evermap_studies.bateman2020.clique_range import nearest_per_clique, range_degraded_miss
from evermap_studies.bateman2020.learned import learned_beliefs
from evermap_studies.bateman2020.runs import Stack
from evermap_studies.bateman2020.settings import LEARNED, ORACLE, SUPPRESSION, TUNED, WARM, FilterSettings
from evermap_studies.bateman2020.suppression import suppressed

State = TypeVar("State")


def beliefs(
    name: str,
    stack: Stack,
    assumed: FilterSettings,
    tuned_p_miss: float | None,
    known_sensor: Profile | None = None,
) -> tuple[FloatArray, IntArray]:
    """What a filter believes after every step.

    Args:
        name: of `bateman2020_settings.FILTERS`.
        stack: of runs.
        assumed: by the filter.
        tuned_p_miss: of `jcf-tuned`, None where that is not asked for.
        known_sensor: that `learned-warm` starts from.

    Returns:
        (F, N) probability that each thing is there, and (N,) the clique that it is (of): all cliques, or landmarks.
    """
    base = name.removesuffix(SUPPRESSION)
    every_clique = np.arange(stack.cliques)
    prior = Exponential.from_mean(assumed.prior_mean_steps)
    if base in {LEARNED, WARM}:
        profile = known_sensor if base == WARM else None
        return np.concatenate([learned_beliefs(run, prior, profile)[0] for run in stack.runs], axis=1), every_clique
    if base == ORACLE:
        return _all_knowing(stack, prior), every_clique
    expected = stack.expected if base == TUNED else stack.in_view[:, stack.clique]
    looks = stack.looks()
    if name.endswith(SUPPRESSION):
        looks[_suppressed(stack, expected, assumed)] = np.nan
    if base == "iff":
        return _independent(stack, stack.tracked(), looks, assumed, prior), every_clique
    if base == "iff-observable":
        rows = stack.observable()
        return _independent(stack, rows, looks, assumed, prior), stack.clique[rows]
    if base == "jff":
        return _pairwise(stack, looks, assumed, prior), stack.clique
    if base == "jff-mixture":
        return _mixture(stack, looks, assumed, prior), stack.clique
    return _joint(base, stack, expected, looks, assumed, prior, tuned_p_miss), every_clique


def _follow(
    state: State,
    look: Callable[[State, FloatArray, int], State],
    predict: Callable[[State, FloatArray], FloatArray],
    stack: Stack,
    looks: FloatArray,
) -> FloatArray:
    """Step by step: look, then ask; a clique that is not born yet is certainly there."""
    age_s = np.maximum(np.arange(len(looks))[:, None] - stack.first, 0).astype(np.float64)
    asked = []
    for step, stamp_s in enumerate(looks):
        state = look(state, stamp_s, step)
        asked.append(predict(state, age_s[step]))
    return np.array(asked)


def _independent(
    stack: Stack, rows: IntArray, looks: FloatArray, assumed: FilterSettings, prior: Exponential
) -> FloatArray:
    """Some landmarks, each by itself, looked at whenever its clique is in view."""
    clique = stack.clique[rows]
    hits = stack.detected[:, rows]

    def look(state: Belief, stamp_s: FloatArray, step: int) -> Belief:
        return joint.iff(state, stamp_s[clique], hits[step], assumed.p_miss, assumed.p_false, True)

    def predict(state: Belief, age_s: FloatArray) -> FloatArray:
        return state.predict(age_s[clique])

    return _follow(single.init(len(rows), prior), look, predict, stack, looks)


def _pairwise(stack: Stack, looks: FloatArray, assumed: FilterSettings, prior: Exponential) -> FloatArray:
    """All landmarks by themselves, each then averaged with its neighbours."""
    averaged = jff.pairwise_weights(
        stack.landmark_m,
        stack.clique,
        own=assumed.pairwise_own,
        neighbours=assumed.pairwise_neighbours,
        reach_m=assumed.pairwise_reach_m,
    )
    alone = _independent(stack, np.arange(len(stack.clique)), looks, assumed, prior)
    return np.asarray(np.clip((averaged @ alone.T).T, 0.0, 1.0))  # weights that sum to 1 but for rounding


def _mixture(stack: Stack, looks: FloatArray, assumed: FilterSettings, prior: Exponential) -> FloatArray:
    def look(state: jff.MixtureBelief, stamp_s: FloatArray, step: int) -> jff.MixtureBelief:
        return jff.update(state, stamp_s, stack.detected[step], assumed.p_miss, assumed.p_false, True)

    start = jff.init(stack.clique, stack.cliques, prior, weight=assumed.mixture_weight)
    return _follow(start, look, jff.predict, stack, looks)


def _joint(
    base: str,
    stack: Stack,
    expected: BoolArray,
    looks: FloatArray,
    assumed: FilterSettings,
    prior: Exponential,
    tuned_p_miss: float | None,
) -> FloatArray:
    """Whole cliques, with one miss rate or another."""
    p_miss: Any = assumed.p_miss
    p_false = assumed.p_false
    if base == "jcfr":
        p_miss = _degraded(stack, assumed)
    elif base == TUNED:
        p_miss, p_false = tuned_p_miss, assumed.tuned_p_false

    def look(state: Belief, stamp_s: FloatArray, step: int) -> Belief:
        missed = p_miss[step] if np.ndim(p_miss) else p_miss
        return joint.jcf(state, stamp_s, stack.detected[step], missed, p_false, expected[step], stack.clique)

    return _follow(single.init(stack.cliques, prior), look, Belief.predict, stack, looks)


def _all_knowing(stack: Stack, prior: Exponential) -> FloatArray:
    """Who knows every probability and nothing of what happened: the exact filter, with whether it is hidden summed out.

    Like the clique filter, with the true probability of each detection, and the chain by which things are hidden.
    """
    world, chance = stack.world, stack.p_detect()
    with np.errstate(divide="ignore"):
        there = np.log(np.where(stack.detected, chance, 1.0 - chance))
    gone = np.log(np.where(stack.detected, world.p_false, 1.0 - world.p_false))
    begin = np.searchsorted(stack.clique, np.arange(stack.cliques))
    log_there, log_gone = (np.add.reduceat(np.where(chance > 0.0, each, 0.0), begin, axis=1) for each in (there, gone))
    reveal = 1.0 / world.occluded_steps
    hide = reveal * world.occluded_share / (1.0 - world.occluded_share)
    looks = np.where(np.logical_or.reduceat(chance > 0.0, begin, axis=1), stack.looks(), np.nan)
    hidden = np.full(stack.cliques, world.occluded_share)

    def look(state: Belief, stamp_s: FloatArray, step: int) -> Belief:
        nonlocal hidden
        before = hidden * (1.0 - reveal) + (1.0 - hidden) * hide
        with np.errstate(divide="ignore"):
            mixed = np.logaddexp(np.log1p(-before) + log_there[step], np.log(before) + log_gone[step])
        after = before * np.exp(log_gone[step] - mixed)
        hidden = np.where(np.isnan(stamp_s), before, after)
        return state.observe(stamp_s, mixed, log_gone[step])

    return _follow(single.init(stack.cliques, prior), look, Belief.predict, stack, looks)


def _degraded(stack: Stack, assumed: FilterSettings) -> FloatArray:
    """(F, K) miss rate of every landmark, by the nearest of its clique."""
    length_m = assumed.degradation_factor * assumed.observed_m
    least, most = assumed.degraded_p_miss
    nearest_m = np.array([nearest_per_clique(range_m, stack.clique, stack.cliques) for range_m in stack.range_m])
    return range_degraded_miss(nearest_m, length_m, least=least, most=most)[:, stack.clique]


def _suppressed(stack: Stack, expected: BoolArray, assumed: FilterSettings) -> BoolArray:
    """(F, C) looks that are left out."""
    return np.array(
        [
            suppressed(
                range_m,
                detected,
                wanted,
                stack.clique,
                stack.cliques,
                observed_m=assumed.observed_m,
                range_max_m=stack.world.field.range_max_m,
                share=assumed.suppression_share,
            )
            for range_m, detected, wanted in zip(stack.range_m, stack.detected, expected, strict=True)
        ]
    )
