"""What the search computes, written down a second time: dense Gaussians, enumeration, quadrature."""

from __future__ import annotations

from itertools import product
from math import comb, log

import numpy as np
from scipy.stats import multivariate_normal

from evermap.config import ChangesConfig
from evermap.slam.changes.evidence import Comparison, WindowEvidence


def log_normal(e: np.ndarray, covariance: np.ndarray) -> float:
    """`log N(e; 0, covariance)` by scipy."""
    return float(multivariate_normal.logpdf(e, np.zeros(len(e)), covariance))


def random_covariance(rng: np.random.Generator, size: int, scale: float = 0.05) -> np.ndarray:
    """Positive definite, with correlations."""
    root = rng.normal(size=(size, size)) / np.sqrt(size) + 0.3 * np.eye(size)
    return scale**2 * root @ root.T


def slam_like_covariance(rng: np.random.Generator, position: np.ndarray) -> np.ndarray:
    """Of landmarks seen from an unknown start: what moves and turns the whole is known badly."""
    count = len(position)
    shift = np.tile(np.eye(2), (count, 1))
    centred = position - position.mean(axis=0)
    turn = np.column_stack([-centred[:, 1], centred[:, 0]]).ravel()
    gauge = 100.0 * shift @ shift.T + 1.0 * np.outer(turn, turn)
    return gauge + random_covariance(rng, 2 * count, 0.04) + 0.02**2 * np.eye(2 * count)


def static_evidence(position: np.ndarray, n_windows: int = 1) -> WindowEvidence:
    """Copies of all landmarks in all windows, for where only the shape of the arrays matters."""
    count = len(position)
    size = 2 * count * n_windows
    return WindowEvidence(
        landmark=np.tile(np.arange(count), n_windows),
        window=np.repeat(np.arange(n_windows), count),
        position=np.tile(position, (n_windows, 1)),
        information=np.eye(size),
        pull=np.zeros(size),
        log_scale_sigma=0.0,
    )


def comparison_of(e: np.ndarray, covariance: np.ndarray) -> Comparison:
    """Of displacements `e` that have this covariance if nothing moved."""
    precision = np.linalg.inv(covariance)
    precision = 0.5 * (precision + precision.T)
    return Comparison(precision, precision @ e, 0.0, float(len(e)), precision, precision @ e)


def membership(evidence: WindowEvidence, members: np.ndarray, onset: int = 0) -> np.ndarray:
    """(2 R, 2) the columns `B` of a group: one identity for every copy of a member from its window on."""
    moved = np.isin(evidence.landmark, members) & (evidence.window >= onset)
    return np.kron(moved[:, None].astype(float), np.eye(2))


def log_group_prior(prior: ChangesConfig, n_landmarks: int, size: int, *, turns: bool = False) -> float:
    """`log (eps / (1 - eps)) 2^-n / C(N, n)`, and the share of groups that turn or that do not."""
    share = prior.p_rotated if turns else 1.0 - prior.p_rotated
    return log(prior.p_moved / (1 - prior.p_moved) / 2**size / comb(n_landmarks, size)) + log(share)


def all_labellings(count: int, groups: int) -> np.ndarray:
    """(H, count) all sets of at most so many disjoint groups, numbered by their first member; 0 = static."""
    labels = np.array(list(product(range(groups + 1), repeat=count)))
    largest = np.maximum.accumulate(np.column_stack([np.zeros(len(labels), int), labels]), axis=1)[:, :-1]
    return labels[(labels <= largest + 1).all(axis=1)]


def gains_of_all(labels: np.ndarray, comparison: Comparison, prior: ChangesConfig) -> np.ndarray:
    """(H,) closed-form gains of labellings in one window, without turns, all at once.

    A group goes far where its displacement is more probable so, by the prior in which it is not.
    """
    count, groups = labels.shape[1], int(labels.max())
    a = comparison.precision.reshape(count, 2, count, 2)
    b = comparison.pull.reshape(count, 2)
    chosen = (labels[:, :, None] == np.arange(1, groups + 1)).astype(float)  # (H, L, G)
    inner = np.einsum("hlg,lamc->hgamc", chosen, a, optimize=True)
    inner = np.einsum("hgamc,hmk->hgakc", inner, chosen, optimize=True).reshape(len(labels), 2 * groups, 2 * groups)
    right = np.einsum("hlg,la->hga", chosen, b).reshape(len(labels), -1)
    scale = np.full((len(labels), groups), prior.move_sigma_m)
    for _ in range(groups + 1):
        held = inner + np.eye(2 * groups) * np.repeat(scale, 2, axis=1)[:, :, None] ** -2
        solved = np.linalg.solve(held, right[:, :, None])[:, :, 0]
        squared = (solved.reshape(*scale.shape, 2) ** 2).sum(axis=2) / scale**2
        near = scale == prior.move_sigma_m
        far = near & (0.5 * squared * (1.0 - prior.far**-2) > 2.0 * log(prior.far) - log(prior.p_far))
        scale = np.where(far, prior.far * scale, scale)
    gain = 0.5 * (right * solved).sum(axis=1) - 0.5 * np.linalg.slogdet(held)[1] - 2.0 * np.log(scale).sum(axis=1)
    table = np.array([0.0] + [log_group_prior(prior, count, n) for n in range(1, count + 1)])
    price = np.count_nonzero(scale > prior.move_sigma_m, axis=1) * log(prior.p_far)
    return gain + price + table[chosen.sum(axis=1).astype(int)].sum(axis=1)
