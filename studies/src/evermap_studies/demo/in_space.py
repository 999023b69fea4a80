"""The part of the demonstration in space: a week of patrols with cameras through a building of tags and objects."""

from __future__ import annotations

from html import escape
from typing import Any

from evermap.viz.report import ReportSection
from evermap.viz.style import NamedFigure
from evermap_studies.building.figures import draw_map
from evermap_studies.building.study import COMPARED, live, story_of
from evermap_studies.building.table import summary

MOST_DAYS = 7
SHARE = 4
"""Days of the demonstration for one in space."""


def live_in_space(days: int, seed: int) -> tuple[dict[str, Any], NamedFigure] | None:
    """Return the numbers and the figure of the last sessions in space; None where `days` are too few for two of them.

    Args:
        days: of the demonstration.
        seed: of the simulation.
    """
    sessions = min(days // SHARE, MOST_DAYS)
    if sessions < 2:
        return None
    story = story_of(seed, sessions)
    run, living = live(story, COMPARED[0])
    by_hand = sum(row["by_hand"] for row in run["sessions"])
    caption = (
        "Tags, signs, shelves, pallets and forklifts after the last patrol, faint where they may be gone, with arrows"
        " for what was reported as moved; from above and from the side."
    )
    figure = NamedFigure("demo_space", draw_map(story, living, run), "A building seen by cameras", caption)
    return summary([run]) | {"landmarks": len(living.members), "by_hand": by_hand}, figure


def section_of(numbers: dict[str, Any], figure: NamedFigure) -> ReportSection:
    """Return the paragraph of the report."""
    text = (
        f"The same engine in three dimensions: {numbers['sessions']} patrols with cameras, {numbers['by_hand']} of them"
        f" carried by hand without odometry, see corners of tags and poses of objects. {numbers['told']} changes of"
        f" landmarks were reported, {numbers['false']} of them falsely, and {_of(numbers['recall'])} of those that"
        f" could be known. Of what the map has with a probability of .9 and more, {_of(numbers['sure_right'])} stands"
        f" there. The robot's positions are off by {100.0 * numbers['pose_m']:.1f} cm, landmarks by"
        f" {100.0 * numbers['landmark_m']:.1f} cm."
    )
    return ReportSection("The same in space", f"<p>{escape(text)}</p>", (figure,))


def _of(share: float | None) -> str:
    return "–" if share is None else f"{100.0 * share:.0f} %"
