"""Which phases there are and between which of them a feature may change: what learning chooses from."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from evermap.errors import ConfigError
from evermap.types import BoolArray


@dataclass(frozen=True, eq=False)
class Structure:
    """A chain without its rates.

    Attributes:
        name: what it is called on the command line and in reports.
        present: (n,) bool, whether a feature in this phase is there.
        changes: (n, n) bool, which changes of phase there are.
    """

    name: str
    present: BoolArray
    changes: BoolArray


def hyperexponential(stays: int, absences: int, name: str = "") -> Structure:
    """Several kinds of stays and of absences; each change is between one of these and one of those."""
    present = np.arange(absences + stays) >= absences
    return Structure(name or f"{stays}+{absences}", present, present[:, None] != present[None, :])


def structure_of(name: str) -> Structure:
    """The structure of a name: 'two-state', 'three-phase' (away, briefly away, there), or '2+3' for two kinds of stays
    and three of absences.

    Raises:
        ConfigError: another name.
    """
    if name == "two-state":
        return hyperexponential(1, 1, name)
    if name == "three-phase":
        return hyperexponential(1, 2, name)
    if parts := re.fullmatch(r"([1-6])\+([1-6])", name):
        return hyperexponential(int(parts[1]), int(parts[2]))
    raise ConfigError(f"'{name}' is no structure", field="phases", hint="auto, two-state, three-phase, or 2+2 to 6+6")
