"""The learned detection model once more, slowly: one landmark, one chain and one bin at a time, in log space."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.linalg import expm
from scipy.special import logsumexp

from evermap.sensing.profile import Field, Profile, facing_middles, range_middles
from evermap_studies.worlds.sensors import InField, sight

FACES = np.concatenate([[axis, -axis] for axis in np.eye(3)])
HIGHEST = 0.98
OUT_OF_FIELD = 0.01


def chance_in_field(field: Field, sigma_m: float, sigma_rad: float, view: Any) -> float:
    """Of one landmark; 0 where it is below a hundredth."""
    inside = float(InField(field, sigma_m, sigma_rad).probability(view)[0])
    return inside if inside >= OUT_OF_FIELD else 0.0


@dataclass
class Sums:
    """What a clique's looks would teach the profile."""

    range_hits: Any = field(default_factory=lambda: np.zeros(16))
    range_expected: Any = field(default_factory=lambda: np.zeros(16))
    facing_hits: Any = field(default_factory=lambda: np.zeros(16))
    facing_expected: Any = field(default_factory=lambda: np.zeros(16))
    false_hits: float = 0.0
    false_looks: float = 0.0
    hits_if_gone: float = 0.0
    looks_if_gone: float = 0.0

    def row(self) -> Any:
        rates = (self.range_hits, self.range_expected, self.facing_hits, self.facing_expected)
        return np.concatenate(
            [*rates, [self.false_hits, self.false_looks, self.hits_if_gone, self.looks_if_gone]],
        )


@dataclass
class Seen:
    """Of one clique in one frame."""

    log_there: float
    log_gone: float
    p_occluded: float
    expected: int


class PlainModel:
    """Same laws as `learned`, other arithmetic; cliques are lists of landmark rows."""

    def __init__(self, landmark_m: Any, clique: Any, profile: Profile) -> None:
        self.profile = profile
        self.landmark = np.asarray(landmark_m, dtype=float)
        self.cliques = [np.flatnonzero(clique == c) for c in range(max(clique) + 1)]
        self.outward = np.zeros_like(self.landmark)
        for rows in self.cliques:
            for k in rows:
                away = self.landmark[k] - self.landmark[rows].mean(axis=0)
                self.outward[k] = away / np.linalg.norm(away) if np.linalg.norm(away) > 1e-9 else 0.0
        self.hits = np.full((len(self.landmark), 6), profile.assumed.hits)
        self.expected = self.hits.copy()
        chain = profile.occlusion
        # generators of (free, occluded), and the long-run distribution as the left null vector
        self.generators = [
            np.array([[-come, come], [go, -go]]) for come, go in zip(chain.come_hz, chain.go_hz, strict=True)
        ]
        long_run = [expm(1e6 * q)[0] for q in self.generators]
        self.state = [[np.array(p) for p in long_run] for _ in self.cliques]
        self.log_chain = np.zeros((len(self.cliques), len(self.generators)))
        self.stamp = [math.nan] * len(self.cliques)
        self.sums = [Sums() for _ in self.cliques]

    def look(self, stamp_s: float, position_m: Any, rotation: Any, detected: Any, active: Any) -> list[Seen | None]:
        return [
            self._look_at(c, stamp_s, position_m, rotation, detected) if active[c] else None
            for c in range(len(self.cliques))
        ]

    def _look_at(self, c: int, stamp_s: float, position_m: Any, rotation: Any, detected: Any) -> Seen | None:
        profile, assumed = self.profile, self.profile.assumed
        middles = (range_middles(assumed.field.range_max_m), facing_middles())
        looks = []
        for k in self.cliques[c]:
            view = sight(self.landmark[k][None], self.outward[k][None], np.asarray(position_m), np.asarray(rotation))
            inside = chance_in_field(assumed.field, assumed.sigma_position_m, assumed.sigma_attitude_rad, view)
            if inside == 0.0:
                continue
            at = (view.range_m[0], view.facing[0])
            by_range = float(np.interp(at[0], middles[0], profile.range_rate))
            by_facing = float(np.interp(at[1], middles[1], profile.facing_rate))
            hats = [
                np.array([np.interp(value, middle, bin_) for bin_ in np.eye(16)])
                for value, middle in zip(at, middles, strict=True)
            ]
            face = int(np.argmax(FACES @ view.direction[0]))
            own = self.hits[k, face] / self.expected[k, face]
            looks.append((k, inside, by_range, by_facing, hats, face, own))
        if not looks:
            return None

        log_clear = log_gone = 0.0
        for k, inside, by_range, by_facing, _, _, own in looks:
            p = inside * min(by_range * by_facing * own, HIGHEST)
            alarm = inside * profile.p_false
            both_missing = (1.0 - p) * (1.0 - alarm)
            log_clear += math.log(1.0 - both_missing if detected[k] else both_missing)
            log_gone += math.log(alarm if detected[k] else 1.0 - alarm)

        # all chains, free and occluded, as one table
        elapsed = 0.0 if math.isnan(self.stamp[c]) else stamp_s - self.stamp[c]
        weight = profile.log_weight + self.log_chain[c]
        with np.errstate(divide="ignore"):
            prior = np.log([p @ expm(elapsed * q) for p, q in zip(self.state[c], self.generators, strict=True)])
        joint = (weight - logsumexp(weight))[:, None] + prior + [log_clear, log_gone]
        evidence = float(logsumexp(joint))
        by_chain = logsumexp(joint, axis=1)
        with np.errstate(invalid="ignore"):
            self.state[c] = [np.exp(row - total) for row, total in zip(joint, by_chain, strict=True)]
        self.log_chain[c] += logsumexp(prior + [log_clear, log_gone], axis=1) - evidence
        p_occluded = float(np.exp(logsumexp(joint[:, 1]) - evidence))
        self.stamp[c] = stamp_s

        sums, clear = self.sums[c], 1.0 - p_occluded
        for k, inside, by_range, by_facing, (hat_range, hat_facing), face, own in looks:
            base = by_range * by_facing
            p = min(base * own, HIGHEST)
            if detected[k]:
                true = clear * p / (1.0 - (1.0 - p) * (1.0 - profile.p_false))
                sums.range_hits += true * hat_range
                sums.facing_hits += true * hat_facing
                sums.false_hits += 1.0 - true
                sums.hits_if_gone += 1.0
                self.hits[k, face] += true
            sums.range_expected += clear * inside * by_facing * own * hat_range
            sums.facing_expected += clear * inside * by_range * own * hat_facing
            sums.false_looks += inside * (1.0 - clear * p)
            sums.looks_if_gone += inside
            self.expected[k, face] += clear * inside * base
        return Seen(evidence, log_gone, p_occluded, len(looks))

    def confirm(self, seen: list[Seen | None], probability: Any) -> None:
        """The profile gains what pends of cliques that are sure."""
        start = self.profile
        learned = {name: np.array(getattr(start, name)) for name in _SHARED}
        weight = start.log_weight.copy()
        for c, look in enumerate(seen):
            if look is None:
                continue
            sums = self.sums[c]
            if probability[c] > 0.99 and look.p_occluded < 0.1:
                for name in _SHARED:
                    learned[name] = learned[name] + getattr(sums, name)
                weight = weight + self.log_chain[c]
                self.log_chain[c] = 0.0
                self.sums[c] = Sums()
            elif probability[c] < 0.001:
                learned["false_hits"] = learned["false_hits"] + sums.hits_if_gone
                learned["false_looks"] = learned["false_looks"] + sums.looks_if_gone
                self.sums[c] = Sums()
        self.profile = replace(start, **learned, log_weight=weight - logsumexp(weight))


_SHARED = ("range_hits", "range_expected", "facing_hits", "facing_expected", "false_hits", "false_looks")
