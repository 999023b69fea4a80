"""What can be seen near the origin."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.tracking.views import View


@pytest.fixture
def here() -> View:
    """All within 100 m of the origin, nine times out of ten."""
    return View(np.zeros(3), 100.0, lambda p: np.full(len(p), 0.9))


@pytest.fixture
def elsewhere() -> View:
    """Nothing near the origin."""
    return View(np.array([1e4, 0.0, 0.0]), 100.0, lambda p: np.zeros(len(p)))
