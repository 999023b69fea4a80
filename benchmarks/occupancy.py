"""The dynamic occupancy model of ecology by the persistence engine: sites that are taken and left between seasons.

    evermap reproduce occupancy ../shared/data/crossbill/looks.csv.gz

MacKenzie et al. (2003): within a season a site stays as it is, and each visit to a taken site sees the species with
probability `p`; between seasons a free site is taken with probability `gamma`, a taken one is left with probability
`epsilon`; in the first season a share `psi` is taken. As a two-state chain with looks at the beginning of each season
that is a model of presence like any other here, and its evidence is that likelihood. There are no false detections.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logit

from evermap.cli.terminal import say
from evermap.existence.phase_type import PhaseType
from evermap.existence.protocol import Looks
from evermap.runs.persist.table import read_looks
from evermap.types import FloatArray

YEAR_D, DAY_S = 365.0, 86400.0
NO_FALSE = 1e-12
"""P(detection | not there), which a look may not have as zero."""


@dataclass(frozen=True, slots=True)
class Occupancy:
    """Maximum likelihood estimates and their standard errors.

    Attributes:
        psi: share of the sites that are taken in the first season.
        gamma: probability that a free site is taken by the next season.
        epsilon: probability that a taken site is free by then.
        p: probability of a detection at a taken site.
        sigma: standard errors of psi, gamma, epsilon and p.
        log_likelihood: of all visits.
    """

    psi: float
    gamma: float
    epsilon: float
    p: float
    sigma: tuple[float, ...]
    log_likelihood: float


def estimate_occupancy(looks: Looks, season_s: float) -> Occupancy:
    """Return the most probable dynamic occupancy model of looks that are in seasons of this length.

    Args:
        looks: at sites; their error probabilities are not used.
        season_s: between the beginnings of two seasons.
    """
    seasons = np.floor(looks.stamp_s / season_s) * season_s

    def log_likelihood(logits: FloatArray) -> float:
        psi, gamma, epsilon, p = expit(logits)
        total = -np.log1p(-min(gamma + epsilon, 1.0 - 1e-9)) / season_s
        leave, come = total * epsilon / (gamma + epsilon), total * gamma / (gamma + epsilon)
        model = PhaseType.two_state(leave, come, p_present=psi)
        n = len(seasons)
        at = Looks(looks.first, seasons, looks.detected, np.full(n, 1.0 - p), np.full(n, NO_FALSE))
        return float(model.track(at).log_evidence.sum())

    start = logit(np.array([0.5, 0.2, 0.2, 0.5]))
    found = minimize(lambda x: -log_likelihood(x), start, method="BFGS", options={"gtol": 1e-4})
    precision = _curvature(log_likelihood, found.x)
    values = expit(found.x)
    sigma = np.sqrt(np.diag(np.linalg.inv(precision))) * values * (1.0 - values)
    psi, gamma, epsilon, p = values.tolist()
    return Occupancy(psi, gamma, epsilon, p, tuple(sigma.tolist()), -float(found.fun))


def _curvature(log_likelihood: Callable[[FloatArray], float], at: FloatArray, step: float = 1e-3) -> FloatArray:
    """Return (n, n) minus the second derivatives, by central differences."""
    n, unit = len(at), step * np.eye(len(at))
    corners = [
        [
            sum(a * b * log_likelihood(at + a * unit[i] + b * unit[j]) for a in (1, -1) for b in (1, -1))
            for j in range(n)
        ]
        for i in range(n)
    ]
    return np.asarray(corners) / (-4.0 * step**2)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the estimates of a table of looks."""
    parser = argparse.ArgumentParser(prog="evermap reproduce occupancy", description=__doc__.split("\n", 1)[0])
    parser.add_argument("table", type=Path, help="looks: stamp_s, feature_id, detected")
    parser.add_argument("--season-d", type=float, default=YEAR_D, help="days between the beginnings of two seasons")
    parser.add_argument("--json", action="store_true", help="print as JSON")
    given = parser.parse_args(arguments)
    table = read_looks(given.table)
    looks = table.looks(table.order())
    found = estimate_occupancy(looks, given.season_d * DAY_S)
    if given.json:
        print(json.dumps(asdict(found)))
        return 0
    for name, sigma in zip(("psi", "gamma", "epsilon", "p"), found.sigma, strict=True):
        say(f"{name:<8} {getattr(found, name):.4f} +- {sigma:.4f}")
    say(f"log likelihood {found.log_likelihood:.4f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
