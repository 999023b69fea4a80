"""`evermap simulate`: recordings of a building in which things move, with the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def simulate(out: Annotated[Path, typer.Argument()]) -> None:
    """x"""
