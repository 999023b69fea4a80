"""The hour of the week in lifetimes: a factor that all hazards have in common, and the clock on which ages are counted.

    log h_c(age, hour) = log h_c(a) + g(hour),     a = tau(now) - tau(arrival),     tau(t) = integral of exp(g)

Ages are measured on a clock that runs as fast as things happen, the *operational time* of renewal processes (Lewis and
Shedler 1979; Lawless 2003, 2.3). So every stay is still one with a hazard by age, its likelihood is exact, and a look
costs as much as before: stamps go through `Rhythm.count_s`, once. MATH.md section 9 has the age on the wall there;
both are the same where the hazard depends on one of the two alone, and over whole weeks, in which tau passes as much.

`exp(g)` has the mean 1 over the week. Given the hazards by age, a stay that was seen over hours of integrated hazards
`w_b`, and whose end lies within hours of `a_b`, has the log likelihood `-w r + log(1 - exp(-a r))`, `r = exp(g)`: that
of what was seen, not of ends at imputed hours, which would support whatever they were imputed by. g is as smooth as the
marginal likelihood wants it (`rhythm.find_smoothness`), and weighed against none by evidence (Laplace). Then hazards
are learned by ages on its clock, and the clock is kept if stays are likelier by these, by more than the factor costs.
Looks at one hour of the day show no hour of an end: `n_dated` is how many ends of a known hour they are worth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from evermap.compiled import single_threaded
from evermap.existence.rhythm import (
    BIN_S,
    HALF_AN_EVENT,
    MONDAY_S,
    WEAK,
    WEEK_S,
    Rhythm,
    find_smoothness,
    week_basis,
    weigh_penalties,
)
from evermap.survival.base import LifetimePrior
from evermap.survival.hazard_posterior import HazardPosterior
from evermap.survival.logmath import log_sum_exp
from evermap.survival.newton import climb, drop_negative, log_determinant
from evermap.types import BoolArray, Clock, FloatArray, IntArray

HOUR_S = 3600.0
HOURS = 168
DAYS = ("Monday", "Tuesday", "Wednesday", "Thursday", "Friday", "Saturday", "Sunday")
LONGEST_S = 4.0 * WEEK_S
"""An end within longer has no hour; later in a stay every hour counts alike."""
LEAST_ENDS = 20.0
LEAST_WEEKS = 2.0
"""Ends and weeks without which nobody asks."""
LEAST_NATS = 3.0
"""Log evidence for a rhythm against none from which there is one."""
MOST_AGAINST = 2.0
"""Nats against the common rhythm from which a class does not follow it; of a class with a stated lifetime, for it."""
ROUGH = tuple(10.0**power for power in range(-2, 7, 2))
"""Weights of penalties of which one shows whether a rhythm is worth a search."""
LEAST = -700.0
"""Log likelihood of an end that a lifetime does not know."""
_SETTLED = 1e-6


@dataclass(frozen=True, slots=True)
class DatedStays:
    """N stays by their stamps, each with J equally probable instants of arrival.

    Attributes:
        begin_s: (N, J) instants of arrival.
        first_s, last_s, gone_s: (N,) first and last sighting, and the look that missed it; inf where it goes on.
        p_gone: (N,) how probably it ended.
        weight: (N,) how many each stands for.
        group: (N,) class of each.
    """

    begin_s: FloatArray
    first_s: FloatArray
    last_s: FloatArray
    gone_s: FloatArray
    p_gone: FloatArray
    weight: FloatArray
    group: IntArray

    @property
    def n_ended(self) -> float:
        """Expected number of ends."""
        return float(np.sum((self.weight * self.p_gone)[np.isfinite(self.gone_s)]))

    def may_show_hours(self) -> bool:
        """Whether there are ends enough, over weeks enough."""
        if not len(self.first_s):
            return False
        span_s = float(np.max(self.last_s) - np.min(self.first_s))
        return self.n_ended >= LEAST_ENDS and span_s >= LEAST_WEEKS * WEEK_S


@dataclass(frozen=True, slots=True)
class HourFit:
    """What stays say of the hours of the week.

    Attributes:
        rhythm: the common factor; None where the evidence is for none.
        follows: (C,) classes that have it.
        n_dated: number of ends of known hour that the looks are worth.
        log_evidence: of the rhythm against none, in nats, before it is asked whether that is enough.
        cost: by how much the log evidence is less than the gain in likelihood, in nats (Occam's factor).
    """

    rhythm: Rhythm | None
    follows: BoolArray
    n_dated: float
    log_evidence: float
    cost: float = 0.0

    def count_s(self, group: IntArray, stamp_s: FloatArray) -> FloatArray:
        """Return stamps (N, ...) on the clock by which ages of classes (N,) are counted."""
        if self.rhythm is None:
            return stamp_s
        follows = self.follows[group].reshape(-1, *(1,) * (np.ndim(stamp_s) - 1))
        return np.where(follows, self.rhythm.count_s(stamp_s), stamp_s)


def describe_hours(
    n_dated: float, log_evidence: float, rhythm: Rhythm | None, clock: Clock, *, follows: bool = True
) -> list[str]:
    """Return lines on what is known of the hours of the week at which stays end.

    Args:
        n_dated: ends of a known hour of the day that the looks are worth.
        log_evidence: for a common factor, against none [nats].
        rhythm: the common factor; None where there is none.
        clock: what stamps count.
        follows: whether the stays that this is about follow it.
    """
    unknown = f"at which hour of the day stays end is open: looks are worth {n_dated:.1f} ends of a known hour"
    if rhythm is None:
        none = f"stays end at all hours of the week alike (evidence for a rhythm {log_evidence:.1f} nats)"
        return [none if n_dated >= LEAST_ENDS else unknown]
    if not follows:
        return ["stays of its class do not follow the hours of the week that others follow"]
    factor, zone = rhythm.hourly_factor, " UTC" if clock is Clock.UNIX else ""
    most, least = (
        f"{DAYS[at // 24]} {at % 24:02d}:00{zone} ({factor[at]:.2g})"
        for at in (int(factor.argmax()), int(factor.argmin()))
    )
    line = f"stays end by the hours of the week, most often on {most}, least often on {least} times the mean rate"
    line += f" (evidence {log_evidence:.1f} nats)"
    return [line] if n_dated >= LEAST_ENDS else [line, unknown]


Posteriors = Sequence[HazardPosterior]
ROUNDS = 2
"""In which hours are learned from hazards by age, and these on the clock of the hours."""


def learn_hours_and_hazards(
    stays: DatedStays, by_age: Posteriors, stated: BoolArray, learn: Callable[[HourFit], Posteriors]
) -> tuple[HourFit | None, Posteriors]:
    """Learn hours of the week, and hazards by age on their clock, in turn.

    Args:
        stays: of C classes.
        by_age: C hazards, or more, by age on the wall.
        stated: (C,) as `learn_hours` takes it.
        learn: returns hazards by age on the clock of a rhythm.

    Returns:
        what is known of the hours, None where nobody can ask; and hazards, `by_age` itself without a rhythm.
    """
    if not stays.may_show_hours():
        return None, by_age
    lifetimes, fit = [one.prior() for one in by_age[: len(stated)]], None
    plain = _log_likelihood(stays, lifetimes, None)
    best, kept = None, by_age
    for _ in range(ROUNDS):
        found = learn_hours(stays, lifetimes, stated, fit)
        if found.rhythm is None:  # what is left of it by ages on its own clock is no evidence against it
            best = best or found
            break
        fit, hazards = found, learn(found)
        lifetimes = [one.prior() for one in hazards[: len(stated)]]
        gain = _log_likelihood(stays, lifetimes, fit) - plain - fit.cost
        if best is None or gain > best.log_evidence:
            best, kept = replace(fit, log_evidence=gain), hazards
    if best is not None and best.rhythm is not None and best.log_evidence < LEAST_NATS:
        return replace(best, rhythm=None, follows=np.zeros_like(stated)), by_age
    return best, kept


def _log_likelihood(stays: DatedStays, lifetimes: Sequence[LifetimePrior], fit: HourFit | None) -> float:
    """Return the log likelihood of stays whose ages are counted by a clock, given that they lasted until first seen."""
    stamps_s = stays.begin_s, stays.first_s, stays.last_s, stays.gone_s
    begin, first, last, gone = stamps_s if fit is None else (fit.count_s(stays.group, at) for at in stamps_s)
    gone = np.where(np.isfinite(gone), gone, last)
    total = 0.0
    for kind, lifetime in enumerate(lifetimes):
        mine = stays.group == kind
        came, seen, until = (np.maximum(at[mine, None] - begin[mine], 0.0) for at in (first, last, gone))
        there = np.asarray(lifetime.log_survival(came))
        lasted = there + lifetime.log_conditional_survival(came, seen)
        ended = lasted + lifetime.log_conditional_death(seen, until)
        on, off = (log_sum_exp(np.maximum(part, LEAST)) - log_sum_exp(there) for part in (lasted, ended))
        p_gone = stays.p_gone[mine] * np.isfinite(stays.gone_s[mine])
        total += float(stays.weight[mine] @ (p_gone * off + (1.0 - p_gone) * on))
    return total


def learn_hours(
    stays: DatedStays, lifetimes: Sequence[LifetimePrior], stated: BoolArray, before: HourFit | None = None
) -> HourFit:
    """Learn the hours of the week from stays, given hazards by age.

    Args:
        stays: of C classes.
        lifetimes: C of them, by age on the clock of `before`.
        stated: (C,) whether a user states the lifetime: then a class needs evidence of its own to follow the rhythm.
        before: what lifetimes were learned under; None for ages on the wall.
    """
    likelihood, n = HourLikelihood.of(stays, lifetimes, before), len(lifetimes)
    n_ended = np.bincount(likelihood.group, likelihood.weight, minlength=n)
    free = ~stated if not np.all(stated) else np.ones(n, dtype=np.bool_)
    best = HourFit(None, np.zeros(n, dtype=np.bool_), likelihood.n_dated, -np.inf)
    for start in (free, np.arange(n) == np.argmax(n_ended))[:n]:  # what all have in common, or what the best known has
        follows, log_factor, log_evidence = _find_followers(likelihood, start, stated)
        if log_evidence >= max(LEAST_NATS, best.log_evidence):
            rhythm = Rhythm(np.repeat(log_factor, round(HOUR_S / BIN_S)))
            gain = float(likelihood.gains(log_factor, n)[follows].sum())
            best = replace(best, rhythm=rhythm, follows=follows, cost=gain - log_evidence)
        best = replace(best, log_evidence=max(best.log_evidence, log_evidence))
    return best


def _find_followers(
    likelihood: HourLikelihood, follows: BoolArray, stated: BoolArray
) -> tuple[BoolArray, FloatArray, float]:
    """Return the classes (C,) that a common factor suits, beginning with some; its logarithm (168,), and evidence."""
    n = len(follows)
    for _ in range(n + 1):
        log_factor, log_evidence = likelihood.of_groups(follows).fit()
        if log_evidence < LEAST_NATS:  # which classes it suits says nothing
            break
        gains = likelihood.gains(log_factor, n)
        after = np.asarray(np.where(stated, gains > MOST_AGAINST, gains > -MOST_AGAINST))
        if (after == follows).all() or not after.any():
            break
        follows = after
    return follows, log_factor, log_evidence


@dataclass(frozen=True, slots=True)
class HourLikelihood:
    """Log likelihood of N stays as a function of log factors (168,).

    Attributes:
        seen: (N, 168) hazard, integrated over the hours in which it was seen, without the factor.
        ending: (N, 168) the same over the hours in which it may have ended; 0 where it goes on.
        weight: (N,) how many ended stays each stands for; weights of `seen` are in it.
        group: (N,) class.
    """

    seen: FloatArray
    ending: FloatArray
    weight: FloatArray
    group: IntArray

    @classmethod
    def of(cls, stays: DatedStays, lifetimes: Sequence[LifetimePrior], before: HourFit | None) -> HourLikelihood:
        """Integrate the hazards of stays by the hour."""
        tau = before.rhythm.count_s if before is not None and before.rhythm is not None else np.asarray
        n = len(stays.first_s)
        seen, ending = np.zeros((2, n, HOURS))
        gone_s = np.where(np.isfinite(stays.gone_s), stays.gone_s, stays.last_s)
        dated = gone_s - stays.last_s <= LONGEST_S
        until_s = np.minimum(stays.last_s, stays.first_s + LONGEST_S)
        for kind in range(len(lifetimes)):
            mine = np.flatnonzero(stays.group == kind)
            on_clock: Callable[[FloatArray], FloatArray] = (
                tau if before is not None and before.follows[kind] else np.asarray
            )
            ends = mine[dated[mine]]
            for table, rows, start_s, stop_s in (
                (seen, mine, stays.first_s, until_s),
                (ending, ends, stays.last_s, gone_s),
            ):
                cells = _cells(start_s[rows], stop_s[rows])
                hazard = _hazards(lifetimes[kind], on_clock, stays.begin_s[rows], *cells)
                np.add.at(table, (rows[cells[0]], cells[3]), hazard)
            late = mine[stays.last_s[mine] > until_s[mine]]
            begin = on_clock(stays.begin_s[late])
            ages = (on_clock(stamp_s[late])[:, None] - begin for stamp_s in (until_s, stays.last_s))
            left = np.asarray(lifetimes[kind].log_conditional_survival(*(np.maximum(age, 0.0) for age in ages)))
            seen[late] -= left.mean(axis=1)[:, None] / HOURS
        ended = stays.weight * stays.p_gone * (ending.sum(axis=1) > 0.0)
        return cls(seen * stays.weight[:, None], ending, ended, stays.group)

    def of_groups(self, follows: BoolArray) -> HourLikelihood:
        """Return that of the stays of some classes (C,)."""
        mine = follows[self.group]
        return HourLikelihood(self.seen[mine], self.ending[mine], self.weight[mine], self.group[mine])

    @property
    def n_dated(self) -> float:
        """Number of ends whose hour is known that the looks are worth: 0 where all are at one hour of the day.

        Of each end the mean resultant length over the hours of the day at which it may lie, squared.
        """
        turn = 2.0 * np.pi * (np.arange(HOURS) % 24 + 0.5) / 24.0
        share = self.ending / np.maximum(self.ending.sum(axis=1, keepdims=True), 1e-300)
        length = np.square(share @ np.cos(turn)) + np.square(share @ np.sin(turn))
        return float(self.weight @ length)

    def values(self, log_factor: FloatArray) -> FloatArray:
        """Return the log likelihood (N,) of each stay."""
        factor = np.exp(log_factor)
        spent = self.ending @ factor
        gone = np.log(-np.expm1(-np.where(self.weight > 0.0, spent, 1.0)))
        return np.asarray(self.weight * gone - self.seen @ factor)

    def curvature(self, log_factor: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the gradient (168,) of the log likelihood, and its negative second derivative (168, 168)."""
        factor, ended = np.exp(log_factor), self.weight > 0.0
        each = self.ending[ended] * factor
        odds = 1.0 / np.expm1(np.clip(each.sum(axis=1), 1e-300, 700.0))
        pull = self.weight[ended] * odds
        slope = pull @ each - self.seen.sum(axis=0) * factor
        return slope, (each.T * (pull * (1.0 + odds))) @ each - np.diag(slope)

    def gains(self, log_factor: FloatArray, n_classes: int) -> FloatArray:
        """Return by how much (C,) the log likelihood of each class is larger with the factor than without."""
        each = self.values(log_factor) - self.values(np.zeros(HOURS))
        return np.bincount(self.group, each, minlength=n_classes).astype(np.float64)

    @single_threaded()
    def fit(self) -> tuple[FloatArray, float]:
        """Return log factors (168,) of mean factor 1, and their log evidence against a constant."""
        basis = week_basis(24, 24)
        columns = np.column_stack([np.ones(HOURS), basis.columns - basis.columns.mean(axis=0)])
        p = columns.shape[1]
        penalties, fixed = (
            [_beside_level(one) for one in basis.penalties],
            WEAK * np.eye(p) + _beside_level(basis.fixed),
        )

        def maximise(beta: FloatArray, penalty: FloatArray) -> tuple[FloatArray, FloatArray]:
            return self._maximise(columns, beta, penalty)[:2]

        level, level_covariance, flat = self._maximise(columns[:, :1], np.zeros(1), fixed[:1, :1])
        start = np.append(level, np.zeros(p - 1))
        nearly = self._weigh_nearly(columns, start, penalties, fixed)
        if nearly < 0.0:  # far from what a rhythm needs
            return np.zeros(HOURS), nearly
        beta, weights, _ = find_smoothness(maximise, start, np.ones(len(penalties)), penalties, fixed)
        penalty = weigh_penalties(weights, penalties, fixed)
        beta, covariance, best = self._maximise(columns, beta, penalty)
        log_evidence = best - flat + 0.5 * (log_determinant(penalty) - log_determinant(fixed[:1, :1]))
        log_evidence += 0.5 * (log_determinant(covariance) - log_determinant(level_covariance))
        log_factor = columns[:, 1:] @ beta[1:]
        return log_factor - np.log(np.mean(np.exp(log_factor))), log_evidence

    def _weigh_nearly(
        self, columns: FloatArray, start: FloatArray, penalties: Sequence[FloatArray], fixed: FloatArray
    ) -> float:
        """Return about the largest log evidence that a factor may have against the constant `start`.

        The likelihood is a quadratic there (a score test), one part at a time has several smoothnesses, and the others
        the largest.
        """
        slope, information = self.curvature(columns @ start)
        slope, information, found = columns.T @ slope, columns.T @ information @ columns, -np.inf
        slope[0] = 0.0  # the level is where it is best
        for part in range(len(penalties)):
            for weight in ROUGH:
                weights = np.where(np.arange(len(penalties)) == part, weight, ROUGH[-1])
                penalty = weigh_penalties(weights, penalties, fixed)[1:, 1:]
                bent = information[1:, 1:] + penalty
                gain = slope[1:] @ np.linalg.solve(bent, slope[1:])
                found = max(found, 0.5 * (float(gain) + log_determinant(penalty) - log_determinant(bent)))
        return found

    def _maximise(
        self, columns: FloatArray, beta: FloatArray, penalty: FloatArray
    ) -> tuple[FloatArray, FloatArray, float]:
        """Return the most probable coefficients (P,), their covariance (P, P), and the penalised log likelihood."""
        during, ended = self.seen.sum(axis=0), self.weight > 0.0
        ending, weight = self.ending[ended], self.weight[ended]
        exposure = during + weight @ ending
        half = HALF_AN_EVENT * exposure / max(float(exposure.sum()), 1e-300)

        def goodness(beta: FloatArray) -> float:
            g = columns @ beta
            with np.errstate(over="ignore", divide="ignore"):
                factor = np.exp(g)
                found = weight @ np.log(-np.expm1(-(ending @ factor))) - during @ factor + half @ g
            found -= 0.5 * float(beta @ penalty @ beta)
            return float(found) if np.isfinite(found) else -np.inf

        def bend(beta: FloatArray) -> tuple[FloatArray, FloatArray]:
            slope, information = self.curvature(columns @ beta)
            pull = columns.T @ (slope + half) - penalty @ beta
            return pull, drop_negative(columns.T @ information @ columns, penalty) + penalty

        beta, hessian, best = climb(goodness, bend, beta, columns, _SETTLED)
        return beta, np.asarray(np.linalg.inv(hessian), dtype=np.float64), best


def _beside_level(matrix: FloatArray) -> FloatArray:
    return np.pad(matrix, ((1, 0), (1, 0)))


def _cells(start_s: FloatArray, stop_s: FloatArray) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
    """Return the row, the start, the stop and the hour of the week of all hours (M,) that spans (N,) touch."""
    first, last = np.floor(start_s / HOUR_S).astype(np.int64), np.ceil(stop_s / HOUR_S).astype(np.int64)
    count = np.maximum(last - first, 0)
    row = np.repeat(np.arange(len(start_s)), count)
    hour = first[row] + np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    start, stop = np.maximum(hour * HOUR_S, start_s[row]), np.minimum((hour + 1) * HOUR_S, stop_s[row])
    return row, start, stop, (hour - round(MONDAY_S / HOUR_S)) % HOURS


def _hazards(
    lifetime: LifetimePrior,
    on_clock: Callable[[FloatArray], FloatArray],
    begin_s: FloatArray,
    row: IntArray,
    start_s: FloatArray,
    stop_s: FloatArray,
    _: IntArray,
) -> FloatArray:
    """Return the hazards (M,) by age, integrated over spans within hours as if the factor were 1, of instants of
    arrival (N, J).
    """
    age = on_clock(0.5 * (start_s + stop_s))[:, None] - on_clock(begin_s)[row]
    half = 0.5 * (stop_s - start_s)[:, None]
    young = np.maximum(age - half, 0.0)
    left = np.asarray(lifetime.log_conditional_survival(young, young + 2.0 * half))
    return np.asarray(np.minimum(-left, 700.0).mean(axis=1))
