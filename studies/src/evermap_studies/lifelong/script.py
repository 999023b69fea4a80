"""What happens to the landmarks between sessions: a seeded script of moves, departures and returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.errors import ConfigError
from evermap.types import BoolArray, FloatArray, IntArray, Landmarks

CLEAR_M = 0.15
"""Least distance of two landmarks; in the recordings neighbours stand 0.18 m apart."""
_TRIES = 1000


@dataclass(frozen=True, slots=True)
class Unrest:
    """How much happens before each session but the first.

    Attributes:
        moves: landmarks that stand somewhere else then.
        vanish: landmarks that leave.
        come_back: landmarks that come back, of those that were away in the session before.
        step_m: smallest and largest displacement.
        stray_m: nobody gets farther from its surveyed place than this: edited recordings show a landmark only where
            the robot saw its surveyed place.
        p_same_place: probability that who comes back stands where it stood before.
    """

    moves: int = 3
    vanish: int = 1
    come_back: int = 1
    step_m: tuple[float, float] = (0.3, 2.0)
    stray_m: float = 2.0
    p_same_place: float = 0.5


@dataclass(frozen=True, slots=True)
class Script:
    """S sessions of L landmarks.

    Attributes:
        landmark_id: (L,) sorted.
        position_m: (S, L, 2) where it stands, nan while it is away.
    """

    landmark_id: IntArray
    position_m: FloatArray

    def __len__(self) -> int:
        return len(self.position_m)

    def landmarks(self, session: int) -> Landmarks:
        """What is there during a session."""
        there = np.isfinite(self.position_m[session, :, 0])
        return Landmarks.at(self.landmark_id[there], self.position_m[session, there])


def draw_script(survey: Landmarks, sessions: int, seed: int, unrest: Unrest | None = None) -> Script:
    """Draw what happens; the first sessions of a longer script are those of a shorter one.

    Args:
        survey: where the landmarks stand in the first session.
        sessions: how many.
        seed: same seed, same script.
        unrest: how much happens.

    Raises:
        ConfigError: fewer landmarks than change at a time, or no free place within the bounds.
    """
    unrest = unrest or Unrest()
    if len(survey) < unrest.moves + unrest.vanish + unrest.come_back:
        problem = f"{len(survey)} landmarks are too few for {unrest.moves} moves and {unrest.vanish} departures"
        raise ConfigError(problem, field="unrest")
    rng = np.random.default_rng(seed)
    now_m, now = survey.position_m.copy(), np.ones(len(survey), dtype=np.bool_)
    position_m = [survey.position_m]
    for _ in range(1, sessions):
        back = rng.permutation(np.flatnonzero(~now))[: unrest.come_back]
        leaving = rng.permutation(np.flatnonzero(now))
        moving, gone = np.split(leaving[: unrest.moves + unrest.vanish], [unrest.moves])
        now[gone] = False
        for row in back:
            stands_free = _clear(now_m[row], now_m[now])
            if not stands_free or rng.random() >= unrest.p_same_place:
                now_m[row] = _elsewhere(row, now_m, now, survey, unrest, rng)
            now[row] = True
        for row in moving:
            now_m[row] = _elsewhere(row, now_m, now, survey, unrest, rng)
        position_m.append(np.where(now[:, None], now_m, np.nan))
    return Script(survey.landmark_id, np.stack(position_m))


def _elsewhere(
    row: int, now_m: FloatArray, there: BoolArray, survey: Landmarks, unrest: Unrest, rng: np.random.Generator
) -> FloatArray:
    """(2,) another place of one landmark, within the bounds and clear of the others."""
    others = there & (np.arange(len(there)) != row)
    for _ in range(_TRIES):
        length, direction = rng.uniform(*unrest.step_m), rng.uniform(-np.pi, np.pi)
        place = now_m[row] + length * np.array([np.cos(direction), np.sin(direction)])
        near_home = np.linalg.norm(place - survey.position_m[row]) <= unrest.stray_m
        if near_home and _clear(place, now_m[others]):
            return np.asarray(place)
    raise ConfigError("no free place within the bounds", field="unrest", hint="fewer landmarks, or a larger stray_m")


def _clear(place_m: FloatArray, others_m: FloatArray) -> bool:
    return bool(np.all(np.linalg.norm(others_m - place_m, axis=1) >= CLEAR_M))
