"""How a file says that evermap wrote it."""

from __future__ import annotations

MARK = "written by evermap"
"""Near the beginning of files that a later run may replace without being told to."""
