"""What a static map costs in a building where things come and go: `evermap demo`."""

from __future__ import annotations

from evermap.demo.run import run_demo
from evermap.demo.scenario import Scenario

__all__ = ["Scenario", "run_demo"]
