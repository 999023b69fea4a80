"""Score maps that change: `score(truth, estimate)`; see the README for the table of episodes."""

from __future__ import annotations

from evermap_score.episodes import Episodes, LookTable, episodes_from_rows, read_episodes, read_looks, write_episodes
from evermap_score.errors import ScoreError
from evermap_score.matching import Rules
from evermap_score.report import to_json, to_latex, to_markdown, to_text
from evermap_score.score import EstimateScore, Interval, Report, score

__version__ = "0.1.0"

__all__ = [
    "Episodes",
    "EstimateScore",
    "Interval",
    "LookTable",
    "Report",
    "Rules",
    "ScoreError",
    "__version__",
    "episodes_from_rows",
    "read_episodes",
    "read_looks",
    "score",
    "to_json",
    "to_latex",
    "to_markdown",
    "to_text",
    "write_episodes",
]
