"""Nielsen's methods behind the estimator's seam: causal at every frame, thought over when stock is taken.

At its frame a detection goes to the mode that is most probable by all looks so far, of those that it gates with; where
it gates with none, and those before it hardly did, it starts one. Whenever stock is taken, births, selection and least
squares alternate over the whole session, beginning with the modes so far.
"""

from __future__ import annotations

import numpy as np

from evermap.config import SlamConfig
from evermap.slam.method import Compare, Explanation, Method
from evermap.slam.problem import Estimate, Noise, Problem
from evermap.types import FloatArray, IntArray, Sensor
from evermap_studies.nielsen2024.modes.alternation import ModeModel, explain_with_modes
from evermap_studies.nielsen2024.modes.changes import switches
from evermap_studies.nielsen2024.modes.gating import MOST_MODES, surprised
from evermap_studies.nielsen2024.modes.places import Modes


class MultiHypothesis(Method):
    """The method with the multi-hypothesis map and one of the selectors.

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
        self._surprise = np.zeros(n_landmarks)
        """(L,) how much the latest detections of each landmark speak against all its modes (`surprised`)."""

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

    def revise(self, problem: Problem, estimate: Estimate, noise: Noise, *, heavy: bool, final: bool) -> Explanation:
        """Births and the alternation over everything so far."""
        found = explain_with_modes(
            problem, estimate, noise, self._modes, self._model, self._rng, heavy=heavy, anew=final
        )
        self._modes = found.modes
        current = self._current(found.problem)
        self._log_belief = np.full(len(found.modes.landmark), -self._model.switch_cost)
        self._log_belief[current] = 0.0
        changes = switches(found, self._model.chain)
        if np.array_equal(found.problem.landmark_row, problem.landmark_row):
            return Explanation(problem, estimate, current, changes)
        return Explanation(found.problem, found.estimate, current, changes)

    def _best_of(self, places: IntArray, distance: FloatArray, log_volume: FloatArray) -> int:
        """One step of the forward filter over the modes of one landmark, and where its detection belongs."""
        there = np.isfinite(distance)
        first = int(places[0])
        if not there.any():  # never seen, and not in the prior map
            self._log_belief[first] = 0.0
            return first
        places, distance, log_volume = places[there], distance[there], log_volume[there]
        before = self._log_belief[places] - np.logaddexp.reduce(self._log_belief[places])
        before = np.logaddexp(before, -self._model.switch_cost)
        said = -0.5 * (distance + log_volume)
        self._log_belief[places] = before + said if self._model.chained else said
        gates = distance < self._model.gate
        landmark = int(self._modes.landmark[first])
        self._surprise[landmark] = surprised(self._surprise[landmark], float(distance.min()), self._model.gate)
        if self._surprise[landmark] <= self._model.surprise or len(places) >= MOST_MODES:
            allowed = gates if gates.any() else distance == distance.min()
            return int(places[np.argmax(np.where(allowed, self._log_belief[places], -np.inf))])
        new = len(self._modes.landmark)
        self._modes = self._modes.with_owner(np.array([new]), landmark)
        self._log_belief = np.append(self._log_belief, np.zeros(len(self._modes.landmark) - len(self._log_belief)))
        self._log_belief[new] = self._log_belief[places].max() - self._model.switch_cost
        self._surprise[landmark] = 0.0
        return new

    def _current(self, problem: Problem) -> IntArray:
        """(L,) the mode of every landmark's last detection; its first one where it has none yet."""
        current = np.arange(self._modes.n_landmarks)
        current[self._modes.landmark[problem.landmark_row]] = (
            problem.landmark_row
        )  # sorted by pose: the last one stands
        return current


def from_settings(n_landmarks: int, settings: SlamConfig, sensor: Sensor) -> MultiHypothesis:
    """Return the method that the settings name, for `evermap.plugins`: group 'evermap.methods'."""
    model = ModeModel.from_settings(settings.method, settings.modes, sensor, robust=settings.robust)
    return MultiHypothesis(n_landmarks, model, seed=settings.seed)
