"""Four weeks in a building where things come and go, lived through with every method: `evermap demo`."""

from __future__ import annotations

from evermap.demo.run import run_demo
from evermap.demo.scenario import Scenario

__all__ = ["Scenario", "run_demo"]
