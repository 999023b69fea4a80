"""What the first edition told (engine of commit b4afc46): one building, seed 1, ten patrols of 60 s."""

from __future__ import annotations

from typing import Any

BEFORE: dict[str, Any] = {
    "by_patrol": {"60 s": {"told": 400, "never": 0.3225, "never_sure": 0.18, "false": 0.62, "brier": 0.518}},
    "reliability": {
        "all but hard": [
            (0.548, 0.360, 25),
            (0.660, 0.138, 29),
            (0.754, 0.509, 57),
            (0.855, 0.355, 31),
            (0.991, 0.384, 258),
        ]
    },
}
"""Shares of the changes told, by patrol; and bins of mean probability, share true, and number."""
