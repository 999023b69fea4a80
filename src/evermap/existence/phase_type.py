"""Stays and absences of phase type: presence as a Markov chain in continuous time (MATH.md section 4).

Some phases are 'there', the others 'not there'; a feature changes from phase to phase at constant rates, or at rates
that follow the hours of the week. Two phases are exponential stays and absences; more make mixtures (a door that is
closed briefly or for the night). The filter is exact, and its cost does not grow with the past. A `Structure` is a
chain without its rates, which learning chooses from.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from evermap.errors import ConfigError
from evermap.existence.lifetimes import Lifetimes, exponential_mixture_of, lifetime_of_phases
from evermap.existence.protocol import Instants, Looks, Track
from evermap.existence.rhythm import BIN_S, BINS, Rhythm
from evermap.show import Shown
from evermap.survival.base import LifetimePrior
from evermap.types import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from evermap.existence.phase_kernels import PhaseChain


@dataclass(frozen=True, eq=False)
class Structure:
    """A chain without its rates.

    Attributes:
        name: its name on the command line and in reports.
        present: (n,) bool, whether a feature in this phase is there.
        changes: (n, n) bool, which changes of phase there are.
    """

    name: str
    present: BoolArray
    changes: BoolArray


def structure_of(name: str) -> Structure:
    """Return the structure of a name.

    'two-state', 'three-phase' (away, briefly away, there), or '2+3' for two kinds of stays and three of absences.

    Raises:
        ConfigError: another name.
    """
    parts = re.fullmatch(r"([1-6])\+([1-6])", {"two-state": "1+1", "three-phase": "1+2"}.get(name, name))
    if not parts:
        hint = "auto, two-state, three-phase, or 2+2 to 6+6"
        raise ConfigError(f"unknown structure '{name}'", field="phases", hint=hint)
    stays, absences = int(parts[1]), int(parts[2])
    present = np.arange(absences + stays) >= absences
    return Structure(name, present, present[:, None] != present[None, :])


_ENDLESS = 100
"""Doublings of a time after which nothing of its beginning is left: 2^100 ten-minute steps."""
_UNIQUE = 1e-6


@dataclass(frozen=True, eq=False)
class PhaseType(Shown):
    """Presence as a Markov chain of `n` phases.

    Attributes:
        present: (n,) bool, whether a feature in this phase is there.
        rates_hz: (n, n) rate of the change from phase `i` to phase `j` in 1/s; the diagonal is zero.
        start: (n,) probability of each phase at a feature's first look (at its first instant, if it has no look);
            None: as it is in the long run at that time of the week.
        rhythms: factors on rates over the week.
        rhythm_of: (n, n) which of `rhythms` multiplies each rate, -1 for none; None: none anywhere.

    Raises:
        ConfigError: shapes or numbers that cannot be.
    """

    present: BoolArray
    rates_hz: FloatArray
    start: FloatArray | None = None
    rhythms: tuple[Rhythm, ...] = ()
    rhythm_of: IntArray | None = None

    def __post_init__(self) -> None:
        n = len(self.present)
        object.__setattr__(self, "present", np.array(self.present, dtype=np.bool_))
        object.__setattr__(self, "rates_hz", np.array(self.rates_hz, dtype=np.float64))
        which = np.full((n, n), -1) if self.rhythm_of is None else np.array(self.rhythm_of, dtype=np.int64)
        object.__setattr__(self, "rhythm_of", which)
        if not (self.present.any() and not self.present.all()):
            raise ConfigError("some phases must be there and some not", field="present")
        if self.rates_hz.shape != (n, n) or which.shape != (n, n):
            raise ConfigError(f"{n} phases need ({n}, {n}) rates", field="rates_hz")
        if not (np.isfinite(self.rates_hz).all() and (self.rates_hz >= 0.0).all()) or np.diag(self.rates_hz).any():
            raise ConfigError("rates are finite, not negative, and zero on the diagonal", field="rates_hz")
        if not ((which >= -1) & (which < len(self.rhythms))).all():
            raise ConfigError(f"{len(self.rhythms)} rhythms, and an index of another", field="rhythm_of")
        if self.start is not None:
            start = np.array(self.start, dtype=np.float64)
            if start.shape != (n,) or not (start >= 0.0).all() or abs(start.sum() - 1.0) > 1e-9:
                raise ConfigError(f"{n} probabilities of sum 1 are needed", field="start")
            object.__setattr__(self, "start", start / start.sum())

    @classmethod
    def two_state(cls, leave_hz: float, return_hz: float, *, p_present: float | None = None) -> Self:
        """Return exponential stays and absences.

        Args:
            leave_hz: rate at which what is there leaves, in 1/s.
            return_hz: rate at which what is away returns; 0 for never.
            p_present: probability of presence at the first look; None: as in the long run, half where nothing changes.

        Raises:
            ConfigError: a rate or a probability that cannot be, or a feature that never returns without `p_present`.
        """
        if p_present is None and leave_hz > 0.0 and return_hz == 0.0:
            raise ConfigError(
                "a feature that never returns is gone in the long run",
                field="p_present",
                hint="its probability at the first look",
            )
        if p_present is None and leave_hz == return_hz == 0.0:
            p_present = 0.5
        start = None if p_present is None else np.array([1.0 - p_present, p_present])
        return cls(np.array([False, True]), np.array([[0.0, return_hz], [leave_hz, 0.0]]), start)

    @classmethod
    def from_mixtures(cls, stay: LifetimePrior, absence: LifetimePrior) -> Self:
        """Return stays and absences that are mixtures of exponentials, each independent of those before.

        Args:
            stay: exponential, general purpose (unknown rate), or a mixture of such.
            absence: likewise.

        Raises:
            ConfigError: a prior that is not a mixture of exponentials.
        """
        (away_hz, away), (there_hz, there) = exponential_mixture_of(absence), exponential_mixture_of(stay)
        k, m = len(away), len(there)
        rates = np.zeros((k + m, k + m))
        rates[:k, k:] = np.outer(away_hz, there)
        rates[k:, :k] = np.outer(there_hz, away)
        return cls(np.arange(k + m) >= k, rates)

    @property
    def lifetimes(self) -> Lifetimes:
        """Time spent in the phases that are there, and in those that are not; a rhythm counts with its mean rates."""
        rates = self.rates_by_bin.mean(0)
        stay, absence = (lifetime_of_phases(rates, i, self._entered(rates, i)) for i in (self.present, ~self.present))
        return Lifetimes(stay, absence)

    def _entered(self, rates: FloatArray, inside: BoolArray) -> FloatArray:
        """(n,) the phases in which a stay (or an absence) begins: in the long run, else as the start has them."""
        long_run = _stationary(rates)
        flow = np.zeros(self.n_phases) if long_run is None else np.where(inside, 0.0, long_run) @ rates * inside
        if flow.sum() == 0.0 and self.start is not None:
            flow = self.start * inside
        return np.asarray(flow / flow.sum() if flow.sum() > 0.0 else inside / inside.sum(), dtype=np.float64)

    @property
    def n_phases(self) -> int:
        """Number of phases."""
        return len(self.present)

    def track(self, looks: Looks, instants: Instants | None = None) -> Track:
        """Filter every feature's looks in one compiled pass; see `PresenceModel.track`.

        Raises:
            NumericalError: a look that is impossible, whether the feature is there or not.
        """
        asked = Instants.of_looks(looks) if instants is None else instants
        p_present, evidence, _ = self.filtered(looks, asked)
        return Track(p_present, evidence, np.zeros(looks.n_features))

    def filtered(self, looks: Looks, asked: Instants) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return presence at the instants, (F,) evidence, and (F, n) phases at each feature's last look or instant."""
        from evermap.existence.phase_kernels import track_all

        starts = self._long_run if self.start is None else self.start[None]
        p_present, evidence, last, bad = track_all(
            self.chain, starts, self.start is not None, looks.first, looks.columns(), asked.first, asked.stamp_s
        )
        for row in bad[bad >= 0][:1]:
            raise looks.impossible(int(row))
        return p_present, evidence, last

    def stationary(self, stamp_s: float | None = None) -> FloatArray:
        """Return (n,) probability of each phase in the long run, at this local time of the week if there is a rhythm.

        Raises:
            ConfigError: what lasts depends on the beginning, or a rhythm without a time.
        """
        from evermap.existence.phase_kernels import first_belief

        rows = self._long_run
        if len(rows) > 1 and stamp_s is None:
            raise ConfigError("with a rhythm the long run depends on the time of the week", field="stamp_s")
        belief = np.empty(self.n_phases)
        first_belief(rows, self.chain, 0.0 if stamp_s is None else stamp_s, belief, np.empty((3, self.n_phases)))
        return belief

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, for JSON."""
        assert self.rhythm_of is not None  # filled in above
        return {
            "kind": "phase-type",
            "present": self.present.tolist(),
            "rates_hz": self.rates_hz.tolist(),
            "start": None if self.start is None else self.start.tolist(),
            "rhythms": [rhythm.to_dict() for rhythm in self.rhythms],
            "rhythm_of": self.rhythm_of.tolist(),
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """Return the model that `to_dict` wrote."""
        return cls(
            np.array(data["present"], dtype=np.bool_),
            np.array(data["rates_hz"], dtype=np.float64),
            None if data["start"] is None else np.array(data["start"]),
            tuple(Rhythm.from_dict(rhythm) for rhythm in data["rhythms"]),
            np.array(data["rhythm_of"], dtype=np.int64),
        )

    @cached_property
    def chain(self) -> PhaseChain:
        """Rates and transitions for the kernels, made once."""
        from evermap.existence.phase_kernels import PhaseChain, transitions

        rates = self.rates_by_bin
        exits = rates.sum(2)
        whole = transitions(rates, exits, BIN_S) if len(rates) > 1 else np.zeros_like(rates)
        week = np.eye(self.n_phases)
        for matrix in whole:
            week = week @ matrix
        return PhaseChain(rates, exits, whole, week, self.present.astype(np.float64))

    @property
    def rates_by_bin(self) -> FloatArray:
        """(1008, n, n) rates at each ten minutes of the week; (1, n, n) where there is no rhythm."""
        if not self.rhythms:
            return self.rates_hz[None].copy()
        factors = np.vstack([*(rhythm.factor for rhythm in self.rhythms), np.ones(BINS)])
        return np.ascontiguousarray(np.moveaxis(self.rates_hz[..., None] * factors[self.rhythm_of], 2, 0))

    @cached_property
    def _long_run(self) -> FloatArray:
        """Return the (1, n) stationary state, or (1008, n) at the begin of each ten minutes."""
        from evermap.existence.phase_kernels import transitions

        chain = self.chain
        if len(chain.rates_hz) == 1:
            fastest = chain.exit_hz.max()
            power = transitions(chain.rates_hz, chain.exit_hz, 1.0 / fastest)[0] if fastest > 0.0 else np.eye(2)
        else:
            power = chain.week
        for _ in range(_ENDLESS):
            power = power @ power
            power /= power.sum(1, keepdims=True)
        if np.ptp(power, axis=0).max() > _UNIQUE:
            raise ConfigError(
                "the state in the long run depends on the first one", field="start", hint="probabilities to start with"
            )
        rows = [power.mean(0)]
        for matrix in chain.whole[:-1]:
            rows.append(rows[-1] @ matrix)
        return np.array(rows)


def _stationary(rates: FloatArray) -> FloatArray | None:
    """Return the (n,) stationary state of constant rates without subtractions (Grassmann, Taksar and Heyman 1985).

    None where some phase is never left for those before it, so that the beginning may matter.
    """
    a = rates.copy()
    for k in range(len(a) - 1, 0, -1):
        if not (exits := a[k, :k].sum()) > 0.0:
            return None
        a[:k, k] /= exits
        a[:k, :k] += np.outer(a[:k, k], a[k, :k])
    weight = np.ones(len(a))
    for k in range(1, len(a)):
        weight[k] = weight[:k] @ a[:k, k]
    return np.asarray(weight / weight.sum(), dtype=np.float64)
