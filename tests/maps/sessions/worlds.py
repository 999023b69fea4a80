"""Small worlds in which a session is laid over a map, and the probability of every assignment, written down densely."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from evermap.geometry.group import PLANE, SPACE
from evermap.maps.bodies import log_evidence_of_motion
from evermap.maps.sessions.overlay import (
    ELSEWHERE,
    USUAL,
    Known,
    Overlay,
    Sighted,
)
from evermap.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class World:
    """A session and a map, and what is true.

    Attributes:
        sighted, known: what `lay_over` is given.
        pose_map_session: (3,) the motion, in space (7,).
        site: (C,) at which site every clique stands, `ELSEWHERE` for a new place.
    """

    sighted: Sighted
    known: Known
    pose_map_session: FloatArray
    site: IntArray


def world(
    random: np.random.Generator,
    sizes: list[int],
    n_sites: list[int],
    site: list[int],
    *,
    sigma_m: float = 0.03,
    drift_m: float = 0.0,
    p_site: list[float] | None = None,
    shift_m: FloatArray | None = None,
    room_m: float = 12.0,
    dim: int = 2,
) -> World:
    """Cliques at random places.

    Args:
        random: of everything.
        sizes: landmarks of every clique.
        n_sites: sites that the map knows of every clique.
        site: (C,) which of its sites every clique truly stands at, `ELSEWHERE` for a new place.
        sigma_m: of session and map, each correlated.
        drift_m: by which landmarks that stand at a site are not quite there.
        p_site: (S,) beliefs; None for even ones, with 0.1 for elsewhere.
        shift_m: (2,) by which those elsewhere stand beside their first site; None for anywhere.
        room_m: sides of the room.
        dim: of the plane or of space; there orientations say something of each site, too.
    """
    group = PLANE if dim == 2 else SPACE
    clique = np.repeat(np.arange(len(sizes)), sizes)
    shape = random.uniform(-0.6, 0.6, (len(clique), dim))

    def pose(low: float = 0.0, high: float = room_m) -> FloatArray:
        turn = [random.uniform(-np.pi, np.pi)] if dim == 2 else Rotation.random(random_state=random).as_quat()
        return np.array([*random.uniform(low, high, dim), *turn])

    rows: list[tuple[int, int]] = []
    at: list[FloatArray] = []
    truth = np.zeros((len(clique), dim))
    names = np.full(len(sizes), ELSEWHERE)
    for c, count in enumerate(n_sites):
        mine = np.flatnonzero(clique == c)
        poses = [pose() for _ in range(count)]
        number = rows[-1][1] + 1 if rows else 0
        for k, stands in enumerate(poses):
            rows += [(int(n), number + k) for n in mine]
            at += list(group.transform(stands, shape[mine]))
        if site[c] == ELSEWHERE:
            new = pose() if shift_m is None else poses[0] + [*shift_m, 0.0]
            truth[mine] = group.transform(new, shape[mine])
        else:
            names[c] = number + site[c]
            off = drift_m * random.normal(size=(len(mine), dim))
            truth[mine] = group.transform(poses[site[c]], shape[mine]) + off
    landmark, of_site = (np.array(column) for column in zip(*rows, strict=True))
    position = np.array(at)
    map_covariance = _covariance(random, len(position), sigma_m, dim)
    session_covariance = _covariance(random, len(truth), sigma_m, dim)
    motion = pose(-30.0, 30.0)
    seen = group.transform(group.inverse(motion), truth)
    seen = seen + random.multivariate_normal(np.zeros(seen.size), session_covariance).reshape(-1, dim)
    position = position + random.multivariate_normal(np.zeros(position.size), map_covariance).reshape(-1, dim)
    of = np.concatenate([[c] * count for c, count in enumerate(n_sites)]).astype(np.int64)
    p = np.array([0.9 / n_sites[c] for c in of]) if p_site is None else np.array(p_site)
    away = np.array([max(1.0 - p[of == c].sum(), 1e-6) for c in range(len(sizes))])
    turned = np.zeros(len(landmark))
    if dim == 3:
        turned[np.unique(of_site, return_index=True)[1]] = random.uniform(-1.0, 1.0, len(p))
    known = Known(position, map_covariance, landmark, of_site, np.log(p), np.log(away), turned)
    return World(Sighted(seen, session_covariance, clique), known, motion, names)


def _covariance(random: np.random.Generator, points: int, sigma_m: float, dim: int) -> FloatArray:
    factor = random.normal(size=(dim * points, points)) / math.sqrt(points)
    return np.asarray(sigma_m**2 * (0.7 * factor @ factor.T + 0.3 * np.eye(dim * points)))


class Densely:
    """The joint probability of an assignment and everything seen, from its definition (MATH.md section 5).

    The difference between where the session sees a landmark and where the map has it is Gaussian: the session's errors,
    the map's, drift, and an unknown motion. What stands elsewhere has the density of a move instead.
    """

    TURNED = 1000
    """Added to a site: the option of being turned in place there."""

    def __init__(self, sighted: Sighted, known: Known, motion: FloatArray) -> None:
        self.sighted, self.known = sighted, known
        self.dim = dim = sighted.position_m.shape[1]
        self.at = sighted.position_m @ _turn(motion[dim:]).T + motion[:dim]
        turn = np.kron(np.eye(len(self.at)), _turn(motion[dim:]))
        middle = self.at.mean(axis=0)

        def moved(step: FloatArray) -> FloatArray:
            return np.asarray((middle + step[:dim] + (self.at - middle) @ _turn(step[dim:]).T).ravel())

        free = np.array([USUAL.free_m] * dim + [USUAL.free_rad] * (3 if dim == 3 else 1))
        slope = np.column_stack([(moved(h) - moved(-h)) / 2e-6 for h in 1e-6 * np.eye(len(free))])
        basis, _ = np.linalg.qr(slope)  # what the session says of its own motion is part of that freedom
        turn = turn - basis @ basis.T @ turn
        self._of_moved = dict[tuple[int, float], float]()
        self.own = turn @ sighted.covariance_m2 @ turn.T
        self.spread = self.own + slope @ np.diag(free**2) @ slope.T
        both = np.vstack([self.at, known.position_m])
        extent = both.max(axis=0) - both.min(axis=0)
        self.room_m2 = max(float(np.prod(extent[:2])), USUAL.smallest_room_m2)
        if dim == 3:
            self.room_m2 *= max(float(extent[2]), 1.0)
        clique = sighted.clique[known.landmark]
        self.sites = [sorted({int(s) for s in known.site[clique == c]}) for c in range(len(known.log_p_elsewhere))]
        self.turned = {  # single landmarks that were perhaps turned in their place, as options of their own
            self.TURNED + s: (int(p[0]), c)
            for c, sites in enumerate(self.sites)
            for s in sites
            if len(p := np.flatnonzero(known.site == s)) == 1 and known.log_turned[p[0]] < 0.0
        }

    def options(self, clique: int) -> list[int]:
        """Sites of a clique, elsewhere, and being turned at those of its sites where it may be."""
        return [*self.sites[clique], ELSEWHERE, *(option for option, (_, c) in self.turned.items() if c == clique)]

    def assignments(self) -> Iterator[IntArray]:
        for chosen in itertools.product(*map(self.options, range(len(self.sites)))):
            yield np.array(chosen)

    def log_probability(self, chosen: IntArray, drift_m: float) -> float:
        known, dim = self.known, self.dim
        rows = np.flatnonzero(np.isin(known.site, chosen[chosen >= 0]))
        turned = [self.turned[int(option)][0] for option in chosen if option >= self.TURNED]
        wider = np.repeat([drift_m**2, drift_m**2 + USUAL.turned_m**2], [dim * len(rows), dim * len(turned)])
        rows = np.append(rows, turned).astype(int)
        total = 0.0
        if len(rows):
            pick = np.zeros((dim * len(rows), dim * len(self.at)))
            for k, landmark in enumerate(known.landmark[rows]):
                pick[dim * k : dim * k + dim, dim * landmark : dim * landmark + dim] = np.eye(dim)
            xy = np.column_stack([dim * rows + axis for axis in range(dim)]).ravel()
            spread = pick @ self.spread @ pick.T + known.covariance_m2[np.ix_(xy, xy)] + np.diag(wider)
            error = (self.at[known.landmark[rows]] - known.position_m[rows]).ravel()
            _, log_volume = np.linalg.slogdet(2.0 * np.pi * spread)
            total -= 0.5 * float(log_volume + error @ np.linalg.solve(spread, error))
        for clique, site in enumerate(chosen):
            if site >= self.TURNED:
                mine = [c for _, c in self.turned.values()].count(clique)
                total += float(known.log_p_elsewhere[clique]) + math.log(USUAL.share_turned / mine)
            elif site >= 0:
                total += float(known.log_p_site[site] + known.log_turned[known.site == site].sum())
            elif self.sites[clique]:
                total += float(known.log_p_elsewhere[clique]) + max(self._moved(s, drift_m) for s in self.sites[clique])
        return total

    def is_this_place(self, chosen: IntArray, drift_m: float) -> bool:
        """Against another place, one session in a thousand, where what stands stands anywhere in the room."""
        moved = sum(max(self._moved(s, drift_m) for s in self.sites[c]) for c, site in enumerate(chosen) if site < 0)
        standing = int(np.isin(self.known.site, chosen[chosen >= 0]).sum() + np.sum(chosen >= self.TURNED))
        return self.log_probability(chosen, drift_m) - moved > math.log(1e-3) - standing * math.log(self.room_m2)

    def best(self) -> tuple[IntArray, float, float]:
        """The most probable assignment, the drift with it, and by how much the next one is less probable.

        Of those in which two landmarks stand: of fewer no motion follows.
        """
        scored = sorted(
            (
                (self.log_probability(chosen, drift) + k * math.log(USUAL.p_coarser), tuple(chosen), drift)
                for chosen in self.assignments()
                if np.isin(self.known.site, chosen[chosen >= 0]).sum() >= 2
                for k, drift in enumerate((*USUAL.drifts_m, *(USUAL.drifts_in_space_m if self.dim == 3 else ())))
            ),
            reverse=True,
        )
        value, chosen, drift = scored[0]
        other = next(v for v, c, _ in scored if c != chosen)
        return np.array(chosen), drift, value - other

    def _moved(self, site: int, drift_m: float) -> float:
        """Density of a body's landmarks beside one of its sites: one rigid motion, of its middle by little or anywhere.

        The evidence of a motion has its own test, against the integral over all of them.
        """
        if (site, drift_m) in self._of_moved:
            return self._of_moved[site, drift_m]
        rows = np.flatnonzero(self.known.site == site)
        spread = np.zeros((len(rows), self.dim, self.dim))
        for k, (row, landmark) in enumerate(zip(rows, self.known.landmark[rows], strict=True)):
            a, b = (slice(self.dim * one, self.dim * one + self.dim) for one in (row, landmark))
            spread[k] = self.known.covariance_m2[a, a] + self.own[b, b] + drift_m**2 * np.eye(self.dim)
        was, now, far_m = self.known.position_m[rows], self.at[self.known.landmark[rows]], 1e5
        near = log_evidence_of_motion(was, now, spread, USUAL.nudge_m)
        density_m = (2.0 * math.pi) ** (0.5 * self.dim) * far_m**self.dim  # of a Gaussian so wide, at its middle
        far = log_evidence_of_motion(was, now, spread, far_m) + math.log(density_m / self.room_m2)
        both = np.logaddexp(math.log(USUAL.share_nudged) + near, math.log(1.0 - USUAL.share_nudged) + far)
        self._of_moved[site, drift_m] = float(both)
        return float(both)


def _turn(angles: FloatArray) -> FloatArray:
    """Rotation matrix of an angle, of a rotation vector or of a quaternion."""
    if len(angles) == 1:
        return Rotation.from_rotvec([0.0, 0.0, float(angles[0])]).as_matrix()[:2, :2]
    turn = Rotation.from_quat(angles) if len(angles) == 4 else Rotation.from_rotvec(angles)
    return np.asarray(turn.as_matrix())


def sites_of(overlay: Overlay, known: Known, sighted: Sighted) -> IntArray:
    """(C,) the site at which `overlay` has every clique; bodies that were taken apart count as elsewhere."""
    site = np.where(overlay.place >= 0, known.site[overlay.place], ELSEWHERE)
    found = np.full(len(known.log_p_elsewhere), ELSEWHERE)
    for c in range(len(found)):
        mine = np.unique(site[sighted.clique == c])
        found[c] = mine[0] if len(mine) == 1 else ELSEWHERE
    return found
