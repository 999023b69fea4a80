"""Kept machine code, and when to throw it away."""

from __future__ import annotations

import contextlib
from pathlib import Path


def drop_stale_code(module_file: str, *called: str) -> None:
    """Delete the kept machine code of a package that is older than any of its sources, or than others that it calls.

    A compiled function contains the compiled functions that it calls, but its keeper compares it with its own file
    only; after an edit elsewhere in the package old and new formulas would be mixed.

    Args:
        module_file: `__file__` of a module of the package.
        called: `__file__` of modules elsewhere whose compiled functions its kernels call.
    """
    folder = Path(module_file).parent
    newest = max(path.stat().st_mtime for path in (*folder.glob("*.py"), *map(Path, called)))
    for index in (folder / "__pycache__").glob("*.nbi"):
        with contextlib.suppress(OSError):  # someone else's installation: its files do not change under us
            if index.stat().st_mtime < newest:
                index.unlink()
