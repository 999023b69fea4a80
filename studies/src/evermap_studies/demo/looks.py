"""What classes and methods look like in the demonstration's figures: Okabe and Ito's colours, shapes and dashes."""

from __future__ import annotations

from dataclasses import dataclass

from evermap.viz.style import ALERT, ESTIMATE, INK, MUTED, ODOMETRY, ONLINE
from evermap_studies.demo.methods import METHODS

CLASS_LOOKS = (
    (INK, "s"),
    ("#e69f00", "D"),
    ("#009e73", "^"),
    ("#0072b2", "o"),
    ("#cc79a7", "v"),
    ("#56b4e9", "P"),
    ("#882255", "h"),
)
"""Colour and marker by class; shapes tell them apart where colours don't."""


@dataclass(frozen=True, slots=True)
class Look:
    """Of a method's line."""

    label: str
    colour: str
    dash: str | tuple[int, tuple[int, ...]] = "-"
    width: float = 1.5
    order: float = 3.0


_LABELS = {method.name: method.label for method in METHODS}
METHOD_LOOKS = {
    "static": Look(_LABELS["static"], ALERT, width=2.2),
    "rosen2016": Look(_LABELS["rosen2016"], ODOMETRY, "--"),
    "bateman2020": Look(_LABELS["bateman2020"], ONLINE, "-."),
    "nielsen2024": Look(_LABELS["nielsen2024"], "#009e73", (0, (5, 1, 1, 1, 1, 1))),
    "evermap": Look(_LABELS["evermap"], ESTIMATE, width=2.6, order=5.0),
    "oracle": Look(_LABELS["oracle"], MUTED, ":", width=2.2, order=6.0),
}
