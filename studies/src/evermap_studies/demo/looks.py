"""What methods look like in the demonstration's figures; classes look as in all figures (`style.class_looks`)."""

from __future__ import annotations

from dataclasses import dataclass

from evermap.viz.style import ALERT, ESTIMATE, LANDMARK, MUTED, ODOMETRY, ONLINE
from evermap_studies.demo.methods import METHODS


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
    "nielsen2024": Look(_LABELS["nielsen2024"], LANDMARK, (0, (5, 1, 1, 1, 1, 1))),
    "evermap": Look(_LABELS["evermap"], ESTIMATE, width=2.6, order=5.0),
    "oracle": Look(_LABELS["oracle"], MUTED, ":", width=2.2, order=6.0),
}
