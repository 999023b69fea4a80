"""What the first edition told: `evermap reproduce partial-views --runs 20` with the engine of commit b4afc46."""

from __future__ import annotations

from typing import Any

BEFORE: dict[str, Any] = {
    "by_patrol": {
        "20 s": {"told": 1600, "never": 0.2256, "never_sure": 0.1206, "false": 0.5669, "brier": 0.4633},
        "40 s": {"told": 4558, "never": 0.2453, "never_sure": 0.1257, "false": 0.6121, "brier": 0.4957},
        "60 s": {"told": 6598, "never": 0.2854, "never_sure": 0.1452, "false": 0.6343, "brier": 0.5116},
        "90 s": {"told": 5026, "never": 0.1628, "never_sure": 0.0846, "false": 0.4425, "brier": 0.3439},
        "165 s": {"told": 3348, "never": 0.0, "never_sure": 0.0, "false": 0.0015, "brier": 0.0021},
        "all but hard": {"told": 21130, "never": 0.1978, "never_sure": 0.1017, "false": 0.4785, "brier": 0.3839},
    },
    "reliability": {
        "all but hard": [
            [0.269, 0.3333, 30],
            [0.3584, 0.3981, 103],
            [0.4564, 0.4541, 185],
            [0.5514, 0.2368, 1246],
            [0.6483, 0.2561, 1304],
            [0.7518, 0.3114, 1445],
            [0.8489, 0.305, 1469],
            [0.9932, 0.6097, 15348],
        ]
    },
}
"""Shares of the changes told, by patrol; and bins of mean probability, share true, and number."""
