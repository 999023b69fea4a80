"""Audit of the key itself: rows of the truth that all estimates contradict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from evermap_score.episodes import Episodes
from evermap_score.matching import World


@dataclass(frozen=True)
class Contradiction:
    """A row of the truth that all estimates contradict.

    Attributes:
        row: of the truth, from 0.
        landmark_id: of that row.
        distance_m: by how much each estimate is farther than that at its nearest, by name; inf: it is nowhere.
    """

    row: int
    landmark_id: str
    distance_m: dict[str, float]


def audit_key(world: World, estimates: Mapping[str, Episodes]) -> list[Contradiction]:
    """Return the rows of the truth that every estimate contradicts: look at these before the estimates.

    An estimate contradicts a row if at none of the instants within its interval it states the landmark (with
    identities; else anything) within `match_m` of the place. Rows that hold at no instant, and landmarks that were
    never looked at, contradict nothing. One estimate alone is wrong more often than the key is: give several.

    Args:
        world: with the truth.
        estimates: by name, aligned with the truth; their last maps are asked.
    """
    rules = world.rules
    found = []
    for row in range(len(world.truth)):
        name = str(world.truth.landmark_id[row])
        within = world.instants_s[
            (world.truth.t_from_s[row] <= world.instants_s) & (world.instants_s < world.truth.t_to_s[row])
        ]
        if len(within) == 0 or world.count_looks(name) == 0:
            continue
        away: dict[str, float] = {}
        for label, estimate in estimates.items():
            stated = estimate.latest()
            stated = stated[stated.p >= rules.present_p]
            if rules.match == "identity":
                stated = stated[stated.landmark_id == name]
            held = np.array([stated.is_present(stamp_s) for stamp_s in within]).any(axis=0)
            places = stated.position_m[held][:, : rules.dim]
            offset = places - world.truth.position_m[row, : rules.dim]
            away[label] = float(np.linalg.norm(offset, axis=1).min(initial=np.inf))
        if away and all(distance > rules.match_m for distance in away.values()):
            found.append(Contradiction(row, name, away))
    return found
