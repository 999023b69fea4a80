"""Kernels of the tree search: UCT over the modes at one landmark's looks.

A node is a sequence of modes up to some look, its children are the modes at the next. The value of a sequence is its
log joint probability; it is normalised to [0, 1] by the lowest and the highest value seen so far in the tree that is
searched, and a sequence that the chain rules out counts as 0. What is passed back is the best value: the sequence of a
rollout can be had as it is, so a node is worth its best one and not, as in a game, the mean of them.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from evermap.types import FloatArray, IntArray
from evermap_studies.nielsen2024.selectors.compiled import kernel

_STEP = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_30, _27, _31, _11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)


class Chain(NamedTuple):
    """What is searched: `tree_search._Task`, with the exponentials that rollouts draw from.

    Attributes:
        log_likelihood, log_start, log_stay, log_leave: as there.
        gone: the column that is never left, or -1.
        psi: (M, K) likelihoods relative to the best of each look; start: (K,), stay, leave: (M, S) probabilities.
    """

    log_likelihood: FloatArray
    log_start: FloatArray
    log_stay: FloatArray
    log_leave: FloatArray
    gone: int
    psi: FloatArray
    start: FloatArray
    stay: FloatArray
    leave: FloatArray


class Tree(NamedTuple):
    """The nodes.

    Attributes:
        child: (N, K) node of each mode at the next look, or -1.
        visits: (N,) how many sequences went through it.
        low, high: (N,) extremes of the values of those that are possible.
    """

    child: IntArray
    visits: IntArray
    low: FloatArray
    high: FloatArray


@kernel
def search(
    log_likelihood: FloatArray,
    log_start: FloatArray,
    mode: int,
    log_stay: FloatArray,
    log_leave: FloatArray,
    gone: int,
    budget: int,
    rollouts: int,
    exploration: float,
    max_nodes: int,
    seed: Any,
    indicator: IntArray,
) -> bool:
    """Decide look after look; False where a look has no mode at all.

    The looks and the chain are those of `tree_search._Task`, `gone` the column that is never left, or -1. Every
    decision between two modes or more takes `budget` iterations with `rollouts` sampled sequences each; `exploration`
    weighs the confidence bound. The tree keeps within `max_nodes`, or what one decision needs. `seed` (uint64) is that
    of the random numbers. Fills `indicator` (M,).
    """
    count, modes = log_likelihood.shape
    psi = np.zeros((count, modes))
    for i in range(count):
        best = log_likelihood[i].max()
        if best == -math.inf:
            return False
        psi[i] = np.exp(log_likelihood[i] - best)
    chain = Chain(
        log_likelihood, log_start, log_stay, log_leave, gone, psi,
        np.exp(log_start), np.exp(log_stay), np.exp(log_leave),
    )  # fmt: skip
    room = max(min(max_nodes, budget * count + 1), budget + 1)
    tree = Tree(
        np.empty((room, modes), dtype=np.int64), np.empty(room, dtype=np.int64), np.empty(room), np.empty(room),
    )  # fmt: skip
    random = np.array([seed], dtype=np.uint64)
    path = np.empty(count + 1, dtype=np.int64)
    root, used = 0, 1
    _clear(tree, root)
    held, stay, value = mode, 0, 0.0
    for i in range(count):
        possible, choice = 0, -1
        for k in range(modes):
            if _step(chain, i, held, stay, k) > -math.inf:
                possible += 1
                choice = k
        if possible == 0:  # the decisions so far rule out all that could follow
            choice = int(np.argmax(log_likelihood[i]))
        if possible > 1:
            if used + budget > room:
                root, used = 0, 1
                _clear(tree, root)
            for _ in range(budget):
                used = _iterate(chain, tree, root, used, i, held, stay, value, rollouts, exploration, random, path)
            choice = _most_visited(tree, root)
        if possible > 0:
            value += _step(chain, i, held, stay, choice)
        if tree.child[root, choice] >= 0:
            root = tree.child[root, choice]
        else:
            root, used = 0, 1
            _clear(tree, root)
        stay = stay if choice == held else i + 1
        held = choice
        indicator[i] = choice
    return True


@kernel
def _iterate(
    chain: Chain,
    tree: Tree,
    root: int,
    used: int,
    i: int,
    held: int,
    stay: int,
    value: float,
    rollouts: int,
    exploration: float,
    random: Any,
    path: IntArray,
) -> int:
    """Selection, expansion, rollouts, back-propagation; returns the number of nodes in use."""
    count, modes = chain.log_likelihood.shape
    path[0], length, node = root, 1, root
    low, spread = tree.low[root], tree.high[root] - tree.low[root]
    expanded = False
    while i < count and not expanded:
        untried, choice = 0, -1
        for k in range(modes):
            if tree.child[node, k] < 0 and _step(chain, i, held, stay, k) > -math.inf:
                untried += 1
                if _uniform(random) * untried < 1.0:  # each of them with the same probability
                    choice = k
        if untried > 0:
            tree.child[node, choice] = used
            _clear(tree, used)
            used += 1
            expanded = True
        else:
            choice = _upper_confidence(tree, node, low, spread, exploration)
            if choice < 0:
                break
        value += _step(chain, i, held, stay, choice)
        stay = stay if choice == held else i + 1
        held = choice
        node = tree.child[node, choice]
        path[length] = node
        length += 1
        i += 1
    for _ in range(rollouts):
        reached = value + _rollout(chain, i, held, stay, random)
        for p in range(length):
            _score(tree, path[p], reached)
    return used


@kernel
def _upper_confidence(tree: Tree, node: int, low: float, spread: float, exploration: float) -> int:
    """The child of largest value plus confidence bound, -1 where there is none."""
    log_visits = math.log(tree.visits[node])
    best, choice = -math.inf, -1
    for k in range(tree.child.shape[1]):
        child = tree.child[node, k]
        if child < 0:
            continue
        worth = max((tree.high[child] - low) / spread, 0.0) if spread > 0.0 else 0.5
        bound = worth + exploration * math.sqrt(log_visits / tree.visits[child])
        if bound > best:
            best, choice = bound, k
    return choice


@kernel
def _most_visited(tree: Tree, root: int) -> int:
    """The decision: the child visited most; of equals the one of larger value."""
    choice, most, best = -1, -1, -math.inf
    for k in range(tree.child.shape[1]):
        child = tree.child[root, k]
        if child < 0:
            continue
        if tree.visits[child] > most or (tree.visits[child] == most and tree.high[child] > best):
            choice, most, best = k, tree.visits[child], tree.high[child]
    return choice


@kernel
def _rollout(chain: Chain, i: int, held: int, stay: int, random: Any) -> float:
    """Log joint probability of the looks from `i` on, each mode drawn from the chain's prior times its likelihood."""
    count, modes = chain.log_likelihood.shape
    wide = chain.log_stay.shape[1] > 1
    value = 0.0
    for row in range(i, count):
        column = stay if wide else 0
        mass = 0.0
        for k in range(modes):
            mass += _weight(chain, row, held, column, k)
        choice = -1
        if mass > 1e-280:
            left = _uniform(random) * mass
            for k in range(modes):
                weight = _weight(chain, row, held, column, k)
                if weight > 0.0:
                    choice = k
                    left -= weight
                    if left < 0.0:
                        break
        else:  # too small for numbers: the best
            best = -math.inf
            for k in range(modes):
                step = _step(chain, row, held, stay, k)
                if step > best:
                    best, choice = step, k
            if choice < 0:
                return -math.inf
        value += _step(chain, row, held, stay, choice)
        stay = stay if choice == held else row + 1
        held = choice
    return value


@kernel
def _step(chain: Chain, i: int, held: int, stay: int, k: int) -> float:
    """Log prior times likelihood of mode `k` at look `i`, after `held` of the stay of that column."""
    prior = -math.inf
    if held < 0:
        prior = chain.log_start[k]
    elif held == chain.gone:
        prior = 0.0 if k == held else prior
    else:
        column = stay if chain.log_stay.shape[1] > 1 else 0
        prior = chain.log_stay[i, column] if k == held else chain.log_leave[i, column]
    return prior + float(chain.log_likelihood[i, k])


@kernel
def _weight(chain: Chain, i: int, held: int, column: int, k: int) -> float:
    """The exponential of `_step`, up to a factor of the look."""
    prior = 0.0
    if held < 0:
        prior = chain.start[k]
    elif held == chain.gone:
        prior = 1.0 if k == held else 0.0
    else:
        prior = chain.stay[i, column] if k == held else chain.leave[i, column]
    return prior * float(chain.psi[i, k])


@kernel
def _clear(tree: Tree, node: int) -> None:
    """A node that nobody has visited."""
    tree.child[node] = -1
    tree.visits[node] = 0
    tree.low[node] = math.inf
    tree.high[node] = -math.inf


@kernel
def _score(tree: Tree, node: int, value: float) -> None:
    tree.visits[node] += 1
    if value > -math.inf:
        tree.low[node] = min(tree.low[node], value)
        tree.high[node] = max(tree.high[node], value)


@kernel
def _uniform(random: Any) -> float:
    """A number in [0, 1) (splitmix64)."""
    random[0] += _STEP
    z = random[0]
    z = (z ^ (z >> _30)) * _MIX_1
    z = (z ^ (z >> _27)) * _MIX_2
    return float((z ^ (z >> _31)) >> _11) * 2.0**-53
