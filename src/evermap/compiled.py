"""Kept machine code, and when to throw it away."""

from __future__ import annotations

import contextlib
from pathlib import Path


def drop_stale_code(module_file: str) -> None:
    """Delete the kept machine code of a package that is older than any of its sources.

    A compiled function contains the compiled functions that it calls, but its keeper compares it with its own file
    only; after an edit elsewhere in the package old and new formulas would be mixed.

    Args:
        module_file: `__file__` of a module of the package, in which all that its kernels call is defined.
    """
    folder = Path(module_file).parent
    newest = max(path.stat().st_mtime for path in folder.glob("*.py"))
    for index in (folder / "__pycache__").glob("*.nbi"):
        with contextlib.suppress(OSError):  # someone else's installation: its files do not change under us
            if index.stat().st_mtime < newest:
                index.unlink()
