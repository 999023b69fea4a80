"""What the first edition told in the same worlds: `evermap reproduce partial-views`, engine of commit b4afc46."""

from __future__ import annotations

from typing import Any

BEFORE: dict[str, Any] = {"by_patrol": {}, "reliability": {}}
"""Shares of the changes told, by patrol; and bins of mean probability, share true, and number."""
