"""Rows of motions in machine code: which arrays they take, and that none of these compiles them anew."""

from __future__ import annotations

from types import FunctionType
from typing import Any

import numpy as np
import pytest

from evermap.geometry import se3, se3_kernels

RNG = np.random.default_rng(3)
POSES, OTHERS = (se3.exp(RNG.normal(size=(5, 6))) for _ in range(2))
POINTS = RNG.normal(size=(5, 3))


def signatures() -> dict[str, int]:
    """Return how often each kernel was compiled."""
    public: dict[str, Any] = {name: one for name, one in vars(se3_kernels).items() if hasattr(one, "signatures")}
    return {name: len(one.signatures) for name, one in public.items() if not isinstance(one, FunctionType)}


@pytest.mark.parametrize(("function", "other"), [(se3.compose, OTHERS), (se3.between, OTHERS), (se3.transform, POINTS)])
def test_a_single_row_goes_with_all_of_the_others(function: Any, other: np.ndarray) -> None:
    every = np.stack([function(POSES[2], each) for each in other])
    assert function(POSES[2], other) == pytest.approx(every, abs=1e-15)
    assert function(POSES[2:3], other) == pytest.approx(every, abs=1e-15)
    each = np.stack([[function(one, two) for two in other] for one in POSES])
    assert function(POSES[:, None], other) == pytest.approx(each, abs=1e-15)
    assert function(POSES[:0], other[:0]).shape == other[:0].shape


def test_no_layout_of_rows_waits_for_the_compiler_after_the_warm_up() -> None:
    se3.warm_up()
    before = signatures()
    frozen, strided = POSES.copy(), np.zeros((5, 14))[:, ::2]
    frozen.setflags(write=False)
    strided[:] = POSES
    for rows in (frozen, strided, np.asfortranarray(POSES), POSES.tolist()):
        composed = se3.compose(rows, OTHERS)
        assert composed == pytest.approx(se3.compose(POSES, OTHERS), abs=1e-12)
        assert se3.transform(se3.inverse(rows), se3.transform(rows, POINTS)) == pytest.approx(POINTS, abs=1e-12)
        assert se3.exp(se3.log(se3.between(rows, composed))) == pytest.approx(OTHERS, abs=1e-12)
        assert se3.rotation_of(se3.normalise_poses(rows)) == pytest.approx(se3.rotation_of(POSES), abs=1e-12)
    assert signatures() == before
    assert not frozen.flags.writeable
    assert before["compose"] == 1
