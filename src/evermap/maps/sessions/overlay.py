"""Alignment of a session with the map: the joint search over changes, for known bodies (MATH.md 5).

A session that was solved alone is a joint Gaussian over its landmarks, in a frame of its own, with trajectory and
calibration marginalised. Laid over the map by an unknown rigid motion, the landmarks that stand at places of the map
differ from these by `e ~ N(0, Sigma + P)`, the motion's freedom included. A body that is not at any of its sites says
nothing about that motion; where it is now has the density of a move. So an assignment of a site, or none, to every
clique has a likelihood in closed form, and given all other cliques the options of one are a conditional Gaussian each:
exact coordinate ascent, one change at a time, from what most landmarks agree on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dpotri

from evermap.align.acceptance import TWO_PLACES, is_this_place, log_density_of, log_room
from evermap.align.candidates import AGREE_M, Matches, are_apart, rank_motions
from evermap.config import GroupingConfig, OverlayConfig
from evermap.geometry import se2
from evermap.geometry.group import PLANE, SPACE
from evermap.geometry.rigid import rigid
from evermap.maps.bodies import log_evidence_of_motion
from evermap.types import FloatArray, IntArray

ELSEWHERE = -1
"""Option of a clique at no known site."""
USUAL = OverlayConfig()
MOST_FLIPS = 400
"""Steps of one ascent, at most: it ends long before."""
ANYWHERE_M = 1e4
"""Standard deviation of a move of which nothing is known, each axis: wider than any room."""


@dataclass(frozen=True, slots=True)
class Sighted:
    """Landmarks of a session that was solved alone.

    Attributes:
        position_m: (L, 2) in the session's frame, in space (L, 3).
        covariance_m2: (2 L, 2 L), in space (3 L, 3 L).
        clique: (L,) row of the clique of each.
    """

    position_m: FloatArray
    covariance_m2: FloatArray
    clique: IntArray


@dataclass(frozen=True, slots=True)
class Known:
    """Candidate places of the session's landmarks in the map.

    Attributes:
        position_m, covariance_m2: (P, 2), (2 P, 2 P), in the map's frame.
        landmark: (P,) row of the session's landmark.
        site: (P,) row of its site.
        log_p_site: (S,) log probability that each site is occupied, before this session.
        log_p_elsewhere: (C,) log probability that a clique occupies none of its sites.
        log_turned: (P,) what the landmark's orientation says for standing there against a move; 0 if unknown.
    """

    position_m: FloatArray
    covariance_m2: FloatArray
    landmark: IntArray
    site: IntArray
    log_p_site: FloatArray
    log_p_elsewhere: FloatArray
    log_turned: FloatArray

    def with_turned(self, clique: IntArray, settings: OverlayConfig) -> Known:
        """Return these with another site for every landmark that seems turned, of cliques (L,): turned in its place."""
        alone = np.bincount(self.site, minlength=len(self.log_p_site))[self.site] == 1
        turned = np.flatnonzero(alone & (self.log_turned < 0.0))
        if not len(turned):
            return self
        of = clique[self.landmark[turned]]
        share = settings.share_turned / np.bincount(of, minlength=len(self.log_p_elsewhere))[of]
        every = np.append(np.arange(len(self.site)), turned)
        rows = se2.xy_rows(every, self.position_m.shape[1])
        return Known(
            self.position_m[every],
            self.covariance_m2[np.ix_(rows, rows)],
            self.landmark[every],
            np.append(self.site, len(self.log_p_site) + np.arange(len(turned))),
            np.append(self.log_p_site, self.log_p_elsewhere[of] + np.log(share)),
            self.log_p_elsewhere,
            np.append(self.log_turned, np.zeros(len(turned))),
        )


@dataclass(frozen=True, slots=True)
class Overlay:
    """Alignment of a session with the map.

    Attributes:
        pose_map_session: (3,) the rigid motion, in space (7,).
        place: (L,) row of the place of each landmark, `ELSEWHERE` if it is at none.
        probability: (L,) of that, given the assignments of the others.
        drift_m: standard deviation of unmoved landmarks between sessions.
        reason: why it isn't accepted, empty where it is.
    """

    pose_map_session: FloatArray
    place: IntArray
    probability: FloatArray
    drift_m: float
    reason: str = ""


def lay_over(
    sighted: Sighted,
    known: Known,
    search: str = "joint",
    settings: OverlayConfig = USUAL,
    motion: FloatArray | None = None,
    p_one_body: float = GroupingConfig().p_one_body,
) -> Overlay | None:
    """Return the most probable assignment of sites to cliques, and its motion.

    Args:
        sighted: the session's landmarks.
        known: their places in the map.
        search: 'joint' weighs every clique with the motion, and all it depends on, marginalised; 'gate' decides each by
            itself, at the motion that most landmarks agree on; 'none' leaves each at its most probable site.
        settings: priors of what moved. Landmarks that nobody moved may be off by one of `drifts_m`: another robot with
            errors of its own, warmth, a sensor that sees another corner.
        motion: where the session lies about; None for where most landmarks agree, in the plane.
        p_one_body: probability that the landmarks of a clique are on one body.

    Returns:
        None where no two landmarks stand to each other as in the map, or where another place explains all better. The
        joint search doesn't accept an alignment if another motion is about as probable.
    """
    if len(known.landmark) < 2:
        return None
    rivals, matches = list[FloatArray](), None
    if motion is None:
        weight = np.exp(known.log_p_site[known.site])
        matches = Matches.of(
            sighted.position_m[known.landmark],
            known.position_m,
            landmark=known.landmark,
            weight=np.maximum(weight, 1e-3),
        )
        ranked = rank_motions(matches)
        if not ranked:
            return None
        motion, agree = ranked[0]
        rivals = [
            other for other, some in ranked[1:] if matches.weight[some].sum() >= 0.5 * matches.weight[agree].sum()
        ]
    options = _Options(sighted, known, motion, settings, p_one_body)
    if search != "joint":
        chosen = options.likeliest_sites() if search == "none" else options.gated(options.agreeing())
        return options.concluded(chosen) if options.n_standing(chosen) >= 2 else None
    best = _search(options)
    options, chosen = best.options, best.chosen
    if options.n_standing(chosen) < 2:
        return None
    if not (options.is_this_place(chosen) and options.outweighs_the_rest(chosen)):
        return None
    found = options.concluded(chosen) if best.whole is None else best.mix()
    for other in (_search(_Options(sighted, known, rival, settings, p_one_body, options)) for rival in rivals):
        if other.options.n_standing(other.chosen) < 2 or other.score <= best.score - settings.lead_nats:
            continue
        rest = other.options.concluded(other.chosen)
        if matches is not None and are_apart(rest.pose_map_session[None], found.pose_map_session, matches)[0]:
            standing = options.n_standing(chosen), other.options.n_standing(other.chosen)
            return replace(found, reason=TWO_PLACES.format(*standing, len(np.unique(known.landmark))))
    return found


class _Found(NamedTuple):
    """The most probable assignment (C,) of options, and its log probability.

    Attributes:
        whole: the same where no body was taken apart, and p_apart: (L,) probability that the body of each landmark is
            none; None where none was.
    """

    options: _Options
    chosen: IntArray
    score: float
    whole: tuple[Overlay, FloatArray] | None = None

    def mix(self) -> Overlay:
        """Return the assignment, by whether bodies that were taken apart are bodies."""
        assert self.whole is not None
        found, (before, p_apart) = self.options.concluded(self.chosen), self.whole
        same = np.where(before.place == found.place, before.probability, 1.0 - before.probability)
        return replace(found, probability=p_apart * found.probability + (1.0 - p_apart) * same)


def _search(options: _Options) -> _Found:
    """Search for the most probable assignment, and take bodies apart whose members contradict each other.

    What did not move with its body was grouped with it wrongly; as long as it is held to it, it bends what stands.
    """
    chosen, score, apart = _joint(options)
    if not (apart > 0.0).any():
        return _Found(options, chosen, score)
    drift_m = options.drift_m
    parted, again, by = options, chosen, score
    for _ in range(2):  # at other drifts, and at the one that is found when these are apart
        cliques = np.flatnonzero(apart > 0.0)
        parted, start = options.take_apart(cliques, chosen)
        again, by, _ = _joint(parted, start)
        options.suppose(parted.drift_m)
        apart = options.log_odds_apart(options.climb(chosen))
        if np.array_equal(cliques, np.flatnonzero(apart > 0.0)):
            break
        if not (apart > 0.0).any():
            by = -math.inf
            break
    if by <= score:
        options.suppose(drift_m)
        return _Found(options, chosen, score)
    p_apart = 1.0 / (1.0 + np.exp(-np.maximum(apart, 0.0)))[options.sighted.clique]
    p_apart[~np.isin(options.sighted.clique, cliques)] = 1.0  # the same landmarks in both
    return _Found(parted, again, by, (options.concluded(options.climb(chosen)), p_apart))


def _joint(options: _Options, start: IntArray | None = None) -> tuple[IntArray, float, FloatArray]:
    """The most probable assignment, and with it how well sessions agree at all; its log probability; and (C,) log odds
    that bodies are none, at most at any degree of agreement: what one landmark does alone looks as if none agreed well.
    """
    settings = options.settings
    more = settings.drifts_in_space_m if options.dim == SPACE.point_dim else ()
    drifts_m = (*settings.drifts_m, *more)
    best, highest, drift_m = options.agreeing() if start is None else start, -math.inf, drifts_m[0]
    apart = np.full(len(options.sites), -np.inf)
    for k, wide_m in enumerate(drifts_m):
        options.suppose(wide_m)
        chosen = options.climb(best)
        score = options.log_probability(chosen)
        # bodies that moved together agree, too, on a motion of their own: what stands may be the rest
        rest = options.climb(options.rest_of(chosen))
        if np.sum(rest != ELSEWHERE) >= 2 and (at := options.log_probability(rest)) > score:  # two tell the motion
            chosen, score = rest, at
        apart = np.maximum(apart, options.log_odds_apart(chosen))
        score += k * math.log(settings.p_coarser)
        if score > highest:  # the next may still be better: with more drift other bodies stay
            best, highest, drift_m = chosen, score, wide_m
    options.suppose(drift_m)
    return best, highest, apart


class _Field:
    """What N chosen places say of all P; the motion by itself, which is so free beside their differences that a joint
    covariance has no digits left for these.

    Args:
        error: (dim N,) differences of the chosen.
        factor: (dim N, dim N) lower Cholesky factor of their covariance for a known motion.
        freedom: (dim N, F) how they change with the motion, in its standard deviations.
        across: (dim P, dim N) covariance of the differences of all places and the chosen.
    """

    def __init__(self, error: FloatArray, factor: FloatArray, freedom: FloatArray, across: FloatArray) -> None:
        inverse = np.tril(dpotri(factor, lower=True)[0]) if len(error) else factor
        self._inverse = inverse + np.tril(inverse, -1).T
        self._across, self._gain = across, across @ self._inverse
        self._drag, self._pull = self._inverse @ freedom, self._inverse @ error
        self._dragged, self._told = across @ self._drag, across @ self._pull
        self._information, self._sum = np.eye(freedom.shape[1]) + freedom.T @ self._drag, self._drag.T @ error

    def log_at(
        self, of: IntArray, error: FloatArray, covariance: FloatArray, freedom: FloatArray, out: IntArray
    ) -> FloatArray:
        """Return (K,) log densities of further places, each by all that are chosen but some.

        Args:
            of: (K, M) rows of all differences.
            error: (K, M) these.
            covariance: (K, M, M) of them, for a known motion.
            freedom: (K, M, F) how they change with it.
            out: (K, B) rows of the chosen that are left out.
        """
        alone, drag, pull = np.linalg.inv(_square(self._inverse, out)), self._drag[out], self._pull[out][..., None]
        back = np.swapaxes(drag, 1, 2) @ alone
        information, mean = self._information - back @ drag, self._sum[:, None] - back @ pull
        through = self._gain[of[:, :, None], out[:, None, :]]
        lost = through @ alone
        lever = freedom - self._dragged[of] + lost @ drag
        swing = np.linalg.solve(information, np.concatenate([np.swapaxes(lever, 1, 2), mean], axis=2))
        off = error - self._told[of] + (lost @ pull - lever @ swing[..., -1:])[..., 0]
        known = self._gain[of] @ np.swapaxes(self._across[of], 1, 2) - lost @ np.swapaxes(through, 1, 2)
        return _log_density(off, covariance - known + lever @ swing[..., :-1])

    def log_there(self, block: IntArray) -> FloatArray:
        """Return (K,) log densities of some of the chosen (K, B), each given the others."""
        drag = self._drag[block]
        swing = np.linalg.solve(self._information, np.swapaxes(drag, 1, 2))
        pull = self._pull[block] - drag @ np.linalg.solve(self._information, self._sum)
        own = np.linalg.inv(_square(self._inverse, block) - drag @ swing)
        return _log_density((own @ pull[..., None])[..., 0], own)


def _square(matrix: FloatArray, rows: IntArray) -> FloatArray:
    """(K, B, B) blocks of a matrix on its diagonal, of rows (K, B)."""
    return np.asarray(matrix[rows[:, :, None], rows[:, None, :]])


def _log_density(off: FloatArray, covariance: FloatArray) -> FloatArray:
    """(K,) log densities of Gaussians; minus infinity where rounding has left none."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + np.swapaxes(covariance, 1, 2)))
    fine, values = values[:, 0] > 0.0, np.maximum(values, 1e-300)
    squared = np.einsum("kab,ka->kb", vectors, off) ** 2 / values
    return np.where(fine, -0.5 * (squared + np.log(2.0 * math.pi * values)).sum(axis=1), -np.inf)


class _Options:
    """Cliques with their options, linearised at one motion; to be compared with others in the same room."""

    def __init__(
        self, sighted: Sighted, known: Known, motion: FloatArray, settings: OverlayConfig, p_one_body: float,
        like: _Options | None = None,
    ) -> None:  # fmt: skip
        self.n_places, self.n_sites = len(known.site), len(known.log_p_site)
        self._given, self._p_one_body, self._log_parted = known, p_one_body, 0.0
        known = known.with_turned(sighted.clique, settings)
        self.settings = settings
        self.sighted, self.known, self.motion = sighted, known, motion
        self.dim = known.position_m.shape[1]
        group = PLANE if self.dim == PLANE.point_dim else SPACE
        self.landmark_m = group.transform(motion, sighted.position_m)
        turn = np.kron(np.eye(len(self.landmark_m)), group.rotation_of(motion))
        # the session turned with the map, without its own rigid motion: that is the motion's freedom
        directions = group.rigid_directions(self.landmark_m - self.landmark_m.mean(axis=0))
        onto = turn - directions @ (np.linalg.pinv(directions) @ turn)
        self._session = onto @ sighted.covariance_m2 @ onto.T
        free = np.repeat([settings.free_m, settings.free_rad], [group.point_dim, group.dim - group.point_dim])
        self._freedom = directions * free
        self._turned_m2 = np.where(np.arange(len(known.site)) < self.n_places, 0.0, settings.turned_m**2)
        room = log_room(self.landmark_m, known.position_m, settings)
        self._log_room: float = room if like is None else like._log_room
        self._log_site = known.log_p_site + np.bincount(known.site, known.log_turned, len(known.log_p_site))
        self.sites: list[list[int]] = [[] for _ in known.log_p_elsewhere]
        order = np.argsort(known.site, kind="stable")
        parts = np.split(order, np.flatnonzero(np.diff(known.site[order])) + 1)
        self._rows = {int(known.site[part[0]]): part for part in parts if len(part)}
        gap = np.linalg.norm(self.landmark_m[known.landmark] - known.position_m, axis=1)
        self._gap_m = {site: float(gap[rows].max()) for site, rows in self._rows.items()}
        for site, rows in self._rows.items():
            self.sites[int(sighted.clique[known.landmark[rows[0]]])].append(site)
        self._of_size = [
            [site for site in self._rows if len(self._rows[site]) == size]
            for size in sorted({len(rows) for rows in self._rows.values()})
        ]
        self.suppose(settings.drifts_m[0])

    def suppose(self, drift_m: float) -> None:
        """Take unmoved landmarks to be off by a standard deviation from session to session."""
        self.drift_m = drift_m
        self._elsewhere: dict[int, float] = {}
        for sites in self._of_size:
            rows = np.array([self._rows[site] for site in sites])
            self._elsewhere |= zip(sites, self._log_elsewhere(rows).tolist(), strict=True)

    def take_apart(self, cliques: IntArray, chosen: IntArray) -> tuple[_Options, IntArray]:
        """Return the options with every member of some cliques by itself, and the assignment (C,) as one of these.

        The first member of each keeps clique and sites; the others get new ones, as probable.
        """
        known, clique = self._given, self.sighted.clique.copy()
        site, of_new, log_p_new, options = known.site.copy(), list[int](), list[float](), list(chosen)
        for c in cliques.tolist():
            for member in np.flatnonzero(self.sighted.clique == c)[1:].tolist():
                clique[member] = len(known.log_p_elsewhere) + len(of_new)
                of_new.append(c)
                options.append(ELSEWHERE)
                for row in np.flatnonzero(known.landmark == member).tolist():
                    if int(chosen[c]) == known.site[row]:
                        options[-1] = self.n_sites + len(log_p_new)
                    site[row] = self.n_sites + len(log_p_new)
                    log_p_new.append(float(known.log_p_site[known.site[row]]))
        # options of being turned in place are numbered after the sites
        options = [o + len(log_p_new) if o >= self.n_sites and k < len(chosen) else o for k, o in enumerate(options)]
        single = replace(
            known,
            site=site,
            log_p_site=np.append(known.log_p_site, log_p_new),
            log_p_elsewhere=np.append(known.log_p_elsewhere, known.log_p_elsewhere[of_new]),
        )
        sighted = replace(self.sighted, clique=clique)
        parted = _Options(sighted, single, self.motion, self.settings, self._p_one_body, self)
        parted._log_parted = len(cliques) * math.log1p(-self._p_one_body)
        options = [o if o in parted._rows else ELSEWHERE for o in options]  # of a turned one another number is its own
        return parted, np.array(options, dtype=np.int64)

    def log_odds_apart(self, chosen: IntArray) -> FloatArray:
        """Return (C,) log odds that the landmarks of each clique are on bodies of their own, given the others."""
        apart = np.full(len(self.sites), -np.inf)
        several = [
            (clique, self._rows[site])
            for clique, sites in enumerate(self.sites)
            for site in sites
            if self._stands(site) and len(self._rows[site]) > 1
        ]
        if not several:
            return apart
        field, blocks = self._field(chosen), self._blocks(chosen)
        scores = self._scores(chosen, field)
        for clique, of in several:
            out = np.tile(blocks[clique], (len(of), 1))
            there = self._log_at(of[:, None], field, out) + self.known.log_turned[of]
            there = there + self.known.log_p_site[self.known.site[of]]
            moved = self._log_elsewhere(of[:, None]) + self.known.log_p_elsewhere[clique]
            total = float(np.logaddexp(there, moved).sum()) + math.log1p(-self._p_one_body)
            values = np.array(list(scores[clique].values()))
            apart[clique] = max(apart[clique], total - float(np.logaddexp.reduce(values)))
        return apart

    def likeliest_sites(self) -> IntArray:
        """Return (C,) for every clique its most probable site; `ELSEWHERE` where it is more probably away."""
        chosen = np.full(len(self.sites), ELSEWHERE, dtype=np.int64)
        for clique, sites in enumerate(self.sites):
            if sites:
                best = max(sites, key=lambda site: float(self.known.log_p_site[site]))
                if self.known.log_p_site[best] > self.known.log_p_elsewhere[clique]:
                    chosen[clique] = best
        return chosen

    def agreeing(self) -> IntArray:
        """Return (C,) for every clique the site that it lies nearest to, if that is near."""
        chosen = np.full(len(self.sites), ELSEWHERE, dtype=np.int64)
        for clique, sites in enumerate(self.sites):
            near = [(self._gap_m[site], site) for site in sites]
            if near and min(near)[0] < AGREE_M:
                chosen[clique] = min(near)[1]
        return chosen

    def rest_of(self, chosen: IntArray) -> IntArray:
        """Return (C,) the complement: moved cliques at their most probable sites, the others elsewhere."""
        likely = self.likeliest_sites()
        return np.asarray(np.where(chosen == ELSEWHERE, likely, ELSEWHERE))

    def climb(self, chosen: IntArray) -> IntArray:
        """Climb from an assignment to one that no change of a single clique makes more probable.

        Two landmarks stay where they stand: of fewer no motion follows, and without one nothing has moved by little.
        """
        chosen = chosen.copy()
        seen = {chosen.tobytes()}
        for _ in range(MOST_FLIPS):
            flips = []
            for c, scores in enumerate(self._scores(chosen)):
                best = max(scores, key=lambda o: scores[o])
                gain = scores[best] - scores[int(chosen[c])]
                if gain > 1e-9 and (self._stands(best) or self._is_alignment(chosen, without=c)):
                    flips.append((gain, c, best))
            if not flips:
                break
            chosen = self._flip_some(chosen, sorted(flips, key=lambda flip: -flip[0]))
            if chosen.tobytes() in seen:  # two that hold each other: the rest of the way leads back
                break
            seen.add(chosen.tobytes())
        return chosen

    def _flip_some(self, chosen: IntArray, flips: list[tuple[float, int, int]]) -> IntArray:
        """Return the assignment with the first flip, and with as many others as make the whole more probable.

        Cliques are taken away one at a time: what contradicts a wrong one is right.
        """
        first, *others = flips
        more = [flip for flip in others if chosen[flip[1]] == ELSEWHERE] if chosen[first[1]] == ELSEWHERE else []

        def after(count: int) -> IntArray:
            flipped = chosen.copy()
            for _, clique, option in (first, *more[:count]):
                flipped[clique] = option
            return flipped

        alone, count = after(0), len(more)
        least = self.log_probability(alone) if count else 0.0
        while count:
            if self.log_probability(flipped := after(count)) > least:
                return flipped
            count //= 2
        return alone

    def gated(self, chosen: IntArray) -> IntArray:
        """Return (C,) every clique by itself, at the motion that was agreed on."""
        table = self._scores(chosen)
        return np.array([max(scores, key=lambda o: scores[o]) for scores in table], dtype=np.int64)

    def log_probability(self, chosen: IntArray) -> float:
        """Return the log probability of an assignment with all that was seen, up to a constant of all assignments."""
        total, _ = self._log_standing(chosen)
        for clique, sites in enumerate(self.sites):
            if sites and chosen[clique] == ELSEWHERE:
                total += max(self._elsewhere[other] for other in sites)
        return total

    def is_this_place(self, chosen: IntArray) -> bool:
        """Return whether the unmoved cliques outweigh the improbability that all others moved."""
        return is_this_place(*self._log_standing(chosen), self._log_room, self.settings.p_another_place)

    def outweighs_the_rest(self, chosen: IntArray) -> bool:
        """Return False if a single body determines the pose, and is less likely to be unmoved than the bodies that it
        contradicts.

        Two that stand to each other as in the map have hardly both moved. One fits itself wherever it is.
        """
        log_odds = {
            c: max(float(self.known.log_p_site[site]) for site in sites) - float(self.known.log_p_elsewhere[c])
            for c, sites in enumerate(self.sites)
            if sites
        }
        stand = [c for c in log_odds if self._stands(chosen[c])]
        denied = [odds for c, odds in log_odds.items() if not self._stands(chosen[c])]
        return len(stand) != 1 or not denied or log_odds[stand[0]] > sum(denied)

    def _log_standing(self, chosen: IntArray) -> tuple[float, int]:
        """Return the log probability of the options, with the density of landmarks at their sites, and their number."""
        rows = self._choose_rows(chosen)
        total = 0.0
        if len(rows):
            total = log_density_of(*self._factorise_gaps(rows), self._free(rows), None)
        for clique, sites in enumerate(self.sites):
            if sites:
                site = int(chosen[clique])
                total += float(self.known.log_p_elsewhere[clique] if site == ELSEWHERE else self._log_site[site])
        return total + self._log_parted, len(rows)

    def n_standing(self, chosen: IntArray) -> int:
        """Return landmarks that are at their places in the map."""
        rows = self._choose_rows(chosen)
        return len(np.unique(self.known.landmark[rows[rows < self.n_places]]))

    def concluded(self, chosen: IntArray) -> Overlay:
        """Return the assignment by landmark."""
        table = self._scores(chosen)
        place = np.full(len(self.landmark_m), ELSEWHERE, dtype=np.int64)
        probability = np.zeros(len(place))
        for clique, scores in enumerate(table):
            values = np.array(list(scores.values()))
            share = np.exp(values - values.max())
            share /= share.sum()
            best, moved = int(chosen[clique]), [not self._stands(option) for option in scores]
            mine = np.flatnonzero(self.sighted.clique == clique)
            if self._stands(best):
                rows = self._rows[best]
                place[self.known.landmark[rows]] = rows
                probability[mine] = share[list(scores).index(best)]
                continue
            probability[mine] = share[moved].sum()
        rows = self._choose_rows(chosen)
        rows = rows[rows < self.n_places]
        matched = self.known.landmark[rows]
        motion = self.motion
        if len(rows) >= 2 and self.dim == PLANE.point_dim:  # in space it is where it was said to be
            motion = rigid(self.sighted.position_m[matched], self.known.position_m[rows])
        return Overlay(motion, place, probability, self.drift_m)

    def _is_alignment(self, chosen: IntArray, without: int) -> bool:
        """Return whether two landmarks stand, or no more than do now, without those of one clique."""
        standing = [len(self._rows[int(o)]) if self._stands(o) else 0 for o in chosen]
        return not standing[without] or sum(standing) - standing[without] >= 2

    def _choose_rows(self, chosen: IntArray) -> IntArray:
        parts = [self._rows[int(site)] for site in chosen if site != ELSEWHERE]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64)

    def _stands(self, option: int) -> bool:
        """Return whether an option of a clique is a site of the map."""
        return ELSEWHERE < option < self.n_sites

    def _scores(self, chosen: IntArray, field: _Field | None = None) -> list[dict[int, float]]:
        """Return the log probability of the options of every clique, given the choices for the others."""
        field, blocks = self._field(chosen) if field is None else field, self._blocks(chosen)
        asked: dict[tuple[int, int], list[tuple[int, IntArray]]] = {}
        there: dict[int, list[tuple[int, IntArray]]] = {}
        for clique, sites in enumerate(self.sites):
            mine, block = int(chosen[clique]), blocks[clique]
            if mine != ELSEWHERE:
                there.setdefault(len(block), []).append((mine, block))
            for site in sites:
                if site != mine:
                    asked.setdefault((len(self._rows[site]), len(block)), []).append((site, block))
        density: dict[int, float] = {}
        for some in there.values():
            density |= zip(
                (site for site, _ in some), field.log_there(np.array([out for _, out in some])).tolist(), strict=True
            )
        for some in asked.values():
            of, out = np.array([self._rows[site] for site, _ in some]), np.array([out for _, out in some])
            density |= zip((site for site, _ in some), self._log_at(of, field, out).tolist(), strict=True)
        table: list[dict[int, float]] = []
        for clique, sites in enumerate(self.sites):
            scores = {site: float(self._log_site[site]) + density[site] for site in sites}
            moved = self._elsewhere[max(sites, key=lambda site: scores[site])] if sites else 0.0
            table.append({ELSEWHERE: float(self.known.log_p_elsewhere[clique]) + moved, **scores})
        return table

    def _blocks(self, chosen: IntArray) -> list[IntArray]:
        """Return the rows of every clique's own differences among those of all that are chosen."""
        size = [0 if site == ELSEWHERE else self.dim * len(self._rows[int(site)]) for site in chosen]
        return np.split(np.arange(sum(size)), np.cumsum(size)[:-1])

    def _log_at(self, of: IntArray, field: _Field, out: IntArray) -> FloatArray:
        """(K,) log densities of places (K, M), being where their landmarks are, by all that are chosen but some."""
        shape, landmark = of.shape, self.known.landmark[of]
        rows, session = (se2.xy_rows(some.ravel(), self.dim).reshape(shape[0], -1) for some in (of, landmark))
        covariance = _square(self._session, session) + _square(self.known.covariance_m2, rows)
        wide = self.drift_m**2 + np.repeat(self._turned_m2[of], self.dim, axis=1)
        covariance += wide[:, :, None] * np.eye(rows.shape[1])
        error = (self.landmark_m[landmark] - self.known.position_m[of]).reshape(rows.shape)
        return field.log_at(rows, error, covariance, self._freedom[session], out)

    def _log_elsewhere(self, of: IntArray) -> FloatArray:
        """(K,) log densities of the landmarks of places (K, M), if one rigid motion moved each body (`maps.bodies`)."""
        landmark, dim = self.known.landmark[of], self.dim
        rows, session = (se2.xy_rows(some.ravel(), dim).reshape(-1, dim) for some in (of, landmark))
        spread = _square(self._session, session) + _square(self.known.covariance_m2, rows)
        spread = (spread + self.drift_m**2 * np.eye(dim)).reshape(*of.shape, dim, dim)
        was, now, share = self.known.position_m[of], self.landmark_m[landmark], float(self.settings.share_nudged)
        near = log_evidence_of_motion(was, now, spread, self.settings.nudge_m)
        far = log_evidence_of_motion(was, now, spread, ANYWHERE_M)
        far = far + 0.5 * dim * math.log(2.0 * math.pi * ANYWHERE_M**2) - self._log_room
        return np.asarray(np.logaddexp(math.log(share) + near, math.log(1.0 - share) + far))

    def _field(self, chosen: IntArray) -> _Field:
        """What all places that are chosen say of the others."""
        rows = self._choose_rows(chosen)
        across = self._covariance(np.arange(len(self.known.site)), rows)
        return _Field(*self._factorise_gaps(rows), self._free(rows), across)

    def _free(self, rows: IntArray) -> FloatArray:
        """Return how differences of places change with the motion, in its standard deviations."""
        return np.asarray(self._freedom[se2.xy_rows(self.known.landmark[rows], self.dim)])

    def _factorise_gaps(self, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Differences of places, and the lower Cholesky factor of their covariance for a known motion."""
        error = (self.landmark_m[self.known.landmark[rows]] - self.known.position_m[rows]).ravel()
        return error, np.asarray(np.linalg.cholesky(self._covariance(rows, rows)))

    def _covariance(self, a: IntArray, b: IntArray) -> FloatArray:
        """Between the differences of two sets of places, for a known motion."""
        la, lb = (se2.xy_rows(self.known.landmark[rows], self.dim) for rows in (a, b))
        pa, pb = se2.xy_rows(a, self.dim)[:, None], se2.xy_rows(b, self.dim)
        both: FloatArray = self._session[la[:, None], lb] + self.known.covariance_m2[pa, pb]
        same = np.nonzero(pa == pb)
        both[same] += self.drift_m**2 + np.repeat(self._turned_m2[a], self.dim)[same[0]]
        return both
