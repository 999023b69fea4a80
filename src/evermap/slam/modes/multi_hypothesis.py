"""Nielsen's methods behind the estimator's seam: causal at every frame, thought over when stock is taken.

At its frame a detection goes to the mode that is most probable by all looks so far, of those that it gates with; where
it gates with none, it starts a mode. Whenever stock is taken, births, selection and least squares alternate over the
whole session.
"""

from __future__ import annotations

import math

import numpy as np

from evermap.slam.method import Compare, Revision
from evermap.slam.modes.alternation import ModeModel, explain_with_modes
from evermap.slam.modes.changes import switches
from evermap.slam.modes.places import FREE, Modes, at_places, compacted, moved_to
from evermap.slam.problem import Estimate, Noise, Problem
from evermap.types import FloatArray, IntArray

LEAST_SWITCH = 1e-300
"""A switch that is ruled out still leaves a filter that can recover."""


class MultiHypothesis:
    """A `Method` with the multi-hypothesis map and one of the selectors.

    Args:
        n_landmarks: landmarks of the session, with or without a prior map.
        model: how modes change and are selected.
        seed: of selectors that draw.
    """

    def __init__(self, n_landmarks: int, model: ModeModel, *, seed: int = 0) -> None:
        self._model = model
        self._rng = np.random.default_rng(seed)
        self._modes = Modes.one_each(n_landmarks)
        self._log_belief = np.zeros(n_landmarks)
        """(P,) log probability of each place to be where its landmark is, by all looks so far."""

    def assign(self, problem: Problem, row: int, detections: IntArray, compare: Compare) -> IntArray:
        """The most probable mode that each detection gates with, else a new one."""
        del row
        place = problem.landmark_row[detections]
        candidates = [np.flatnonzero(self._modes.landmark == landmark) for landmark in place]
        which = np.repeat(np.arange(len(detections)), [len(mine) for mine in candidates])
        distance, log_volume = compare(detections[which], np.concatenate([*candidates, np.empty(0, np.int64)]))
        for k, mine in enumerate(candidates):
            place[k] = self._best_of(mine, distance[which == k], log_volume[which == k])
        return place

    def unprejudiced(self, problem: Problem, estimate: Estimate) -> tuple[Problem, Estimate]:
        """As they are."""
        return problem, estimate

    def revise(self, problem: Problem, estimate: Estimate, noise: Noise, *, heavy: bool, final: bool) -> Revision:
        """Births and the alternation over everything so far."""
        del final
        static, at, modes = self._static(problem, estimate)
        found = explain_with_modes(static, at, noise, modes, self._model, self._rng, heavy=heavy)
        self._modes = found.modes
        current = self._current(found.problem)
        self._log_belief = np.full(len(found.modes.landmark), self._log_switch)
        self._log_belief[current] = 0.0
        changes = switches(found, self._model.chain)
        if np.array_equal(found.problem.landmark_row, problem.landmark_row):
            return Revision(problem, estimate, current, changes)
        return Revision(found.problem, found.estimate, current, changes)

    def _static(self, problem: Problem, estimate: Estimate) -> tuple[Problem, Estimate, Modes]:
        """Every detection at its landmark's own place again, at the estimate that the modes so far have led to.

        One detection in twenty falls outside its gate. The estimate bends to fit the mode that it starts, and then
        needs it; so every revision has births of its own, which a selector must want with all looks in view.
        """
        owner = self._modes.landmark
        others = np.flatnonzero(np.arange(len(owner)) >= self._modes.n_landmarks)
        problem = moved_to(problem, others, owner[others])
        lost = others[~estimate.known[owner[others]]]  # its own place was given up: it begins at another
        estimate = at_places(estimate, owner[lost], estimate.landmark[lost])
        estimate = at_places(estimate, others, np.nan)
        return compacted(problem, estimate, self._modes.with_owner(others, FREE))[:3]

    @property
    def _log_switch(self) -> float:
        """Of a landmark to be elsewhere at the next look; between frames it is the constant, lifetime or not."""
        return math.log(max(self._model.significance, LEAST_SWITCH))

    def _best_of(self, places: IntArray, distance: FloatArray, log_volume: FloatArray) -> int:
        """One step of the forward filter over the modes of one landmark, and where its detection belongs."""
        there = np.isfinite(distance)
        first = int(places[0])
        if not there.any():  # never seen, and not in the prior map
            self._log_belief[first] = 0.0
            return first
        places, distance, log_volume = places[there], distance[there], log_volume[there]
        before = self._log_belief[places] - np.logaddexp.reduce(self._log_belief[places])
        before = np.logaddexp(before, self._log_switch)
        said = -0.5 * (distance + log_volume)
        self._log_belief[places] = before + said if self._model.chained else said
        gates = distance < self._model.gate
        if gates.any():
            return int(places[np.argmax(np.where(gates, self._log_belief[places], -np.inf))])
        landmark = int(self._modes.landmark[first])
        new = len(self._modes.landmark)
        self._modes = self._modes.with_owner(np.array([new]), landmark)
        self._log_belief = np.append(self._log_belief, np.zeros(len(self._modes.landmark) - len(self._log_belief)))
        self._log_belief[new] = self._log_belief[places].max() + self._log_switch
        return new

    def _current(self, problem: Problem) -> IntArray:
        """(L,) the mode of every landmark's last detection; its first one where it has none yet."""
        current = np.arange(self._modes.n_landmarks)
        current[self._modes.landmark[problem.landmark_row]] = (
            problem.landmark_row
        )  # sorted by pose: the last one stands
        return current
