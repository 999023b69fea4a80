"""Chains of modes by enumerating every sequence, straight from the definition, and random looks to try them on."""

from __future__ import annotations

import itertools
import math

import numpy as np
from hypothesis import strategies as st

from evermap.survival import Exponential, GeneralPurpose, Uniform, Weibull
from evermap_studies.nielsen2024.selectors.chain import ModeChain, ModeLooks

CHAINS = {
    "constant": ModeChain(0.1),
    "constant, gone": ModeChain(0.2, gone=True),
    "exponential": ModeChain(lifetime=Exponential(0.05)),
    "general purpose": ModeChain(lifetime=GeneralPurpose(1e-3, 2.0)),
    "ageing": ModeChain(lifetime=Weibull(20.0, 3.0)),
    "ageing, gone": ModeChain(lifetime=Weibull(20.0, 3.0), gone=True),
    "uniform": ModeChain(lifetime=Uniform(500.0)),
}


def log_changes(chain, stamp_s):
    """Log probability (T, T) that a stay which began at look `b` lasts from look `n - 1` to `n`, and that it ends."""
    count = len(stamp_s)
    stay, leave = np.full((count, count), np.nan), np.full((count, count), np.nan)
    for began, n in itertools.combinations(range(count), 2):
        if chain.lifetime is None:
            stay[began, n], leave[began, n] = math.log1p(-chain.switch_probability), math.log(chain.switch_probability)
        else:
            held, until = stamp_s[n - 1] - stamp_s[began], stamp_s[n] - stamp_s[began]
            stay[began, n] = chain.lifetime.log_conditional_survival(held, until)
            leave[began, n] = chain.lifetime.log_conditional_death(held, until)
    return stay.tolist(), leave.tolist()


def log_prior(chain, changes, sequence, n_modes):
    """Of one sequence; `n_modes` counts the columns that exist, 'gone' among them as the last."""
    stay, leave = changes
    gone = n_modes - 1 if chain.gone else None
    if sequence[0] == gone:
        return -math.inf
    value = -math.log(n_modes - 1 if chain.gone else n_modes)
    began = 0
    for n in range(1, len(sequence)):
        before, after = sequence[n - 1], sequence[n]
        if before == gone:
            if after != gone:
                return -math.inf
            continue
        if n_modes == 1:
            continue
        if after == before:
            value += stay[began][n]
        else:
            value += leave[began][n] - math.log(n_modes - 1)
            began = n
    return value


def every_sequence(chain, stamp_s, log_likelihood):
    """All sequences (S, T) over the columns, and the log joint probability (S,) of each."""
    count = len(log_likelihood)
    exists = np.isfinite(log_likelihood).any(axis=0)
    n_modes = int(exists.sum())
    assert exists[:n_modes].all(), "columns that do not exist come last"
    sequences = list(itertools.product(range(n_modes), repeat=count))
    changes = log_changes(chain, stamp_s)
    prior = np.array([log_prior(chain, changes, sequence, n_modes) for sequence in sequences])
    sequences = np.array(sequences)
    return sequences, prior + log_likelihood[np.arange(count), sequences].sum(axis=1)


def log_sum(values):
    top = np.max(values, initial=-np.inf)
    return top if np.isinf(top) else top + math.log(np.exp(values - top).sum())


def random_looks(rng, counts, modes, *, gap_s=4.0, born_late=False, scale=3.0):
    """Landmarks with so many looks each; some gaps are 0, and with `born_late` the second mode exists only later."""
    first = np.concatenate([[0], np.cumsum(counts)])
    stamps, likelihoods = [], []
    for count in counts:
        gap = np.where(rng.random(count) < 0.15, 0.0, rng.exponential(gap_s, count))
        stamps.append(rng.uniform(0, 1000) + np.cumsum(gap))
        value = rng.normal(0.0, scale, (count, modes))
        if born_late and count:
            value[: rng.integers(0, count), 1] = -np.inf
        likelihoods.append(value)
    return ModeLooks(first, np.concatenate(stamps), np.concatenate(likelihoods))


@st.composite
def looks(draw, longest=6):
    """One to three landmarks of up to `longest` looks at two or three modes."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    counts = draw(st.lists(st.integers(1, longest), min_size=1, max_size=3))
    modes = draw(st.integers(2, 3))
    return random_looks(
        rng, counts, modes, born_late=draw(st.booleans()), scale=draw(st.sampled_from([0.3, 3.0, 30.0]))
    )


def of_landmark(looks, row):
    """Stamps and log likelihoods of one landmark."""
    rows = slice(looks.first[row], looks.first[row + 1])
    return rows, looks.stamp_s[rows], looks.log_likelihood[rows]
