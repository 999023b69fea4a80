"""Figures that a verb writes where the user says."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from evermap.errors import ConfigError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SUFFIXES = (".png", ".svg")


def check_picture(path: Path, field: str, *, inputs: Sequence[str | Path] = ()) -> None:
    """Refuse a file that cannot be drawn, before the work that it shows is done.

    Args:
        path: the file.
        field: the option that named it.
        inputs: files that are read.

    Raises:
        ConfigError: a suffix that is neither .png nor .svg, or the file is an input.
    """
    from evermap.runs.folder import check_output_file

    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"cannot draw a '{path.suffix}' file", path=path, field=field, hint="a name ending in .png")
    check_output_file(path, inputs=inputs)


def write_picture(path: Path, figure: Figure) -> None:
    """Write a figure, whole or not at all."""
    from evermap.io.atomic import write_atomic
    from evermap.viz.style import save_png, save_svg

    content = io.BytesIO()
    (save_svg if path.suffix.lower() == ".svg" else save_png)(figure, content)
    write_atomic(path, content.getvalue())
