"""Output of `evermap map` for people: revisions, landmarks and changes.

How `evermap map why` answers: lines, and a table of the sessions.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from evermap.cli.terminal import echo, print_table
from evermap.runs.map_dicts import AXES
from evermap.types import Clock, MapChange, between_text, or_nan, stamp_text

if TYPE_CHECKING:
    from evermap.maps.store import Revision
    from evermap.maps.why import Answer


def revision_row(item: Revision, clock: Clock) -> list[str]:
    """Return the same in words."""
    origin = item.provenance
    changes = [f"{count} {kind.value}" for kind, count in item.n_changes.items()]
    changes += [f"grew by {item.n_grown}"] if item.n_grown else []
    return [
        str(item.number),
        item.created_at.replace("T", " ").removesuffix("+00:00"),
        origin.kind.value,
        origin.note or origin.recording or "-",
        stamp_text(origin.stamp_from_s, clock),
        f"{item.n_existing} of {item.n_landmarks}",
        ", ".join(changes) or "-",
        f"{origin.wall_s:.1f} s" if math.isfinite(origin.wall_s) else "-",
    ]


def change_line(change: MapChange, clock: Clock) -> str:
    """Return 'landmark 5 moved by (+0.50, 0.00) m between 10:02:00 and 10:20:00, probability 97 % (12 hits, 40
    misses)'.
    """
    from evermap.viz.change_words import probability, what

    when = between_text(change.stamp_from_s, change.stamp_to_s, clock)
    return f"{what(change)} {when}, {probability(change.probability)} ({change.n_hits} hits, {change.n_misses} misses)"


def landmark_row(content: dict[str, Any], clock: Clock) -> list[str]:
    """Return the same in words."""
    from evermap.maps.why import probability_text

    placed = content["x_m"] is not None
    flags = " ".join(word for word in ("pinned", "deleted") if content[word])
    ahead = content["p_ahead"]
    return [
        content["label"],
        content["class"] or "-",
        probability_text(content["p_exists"]),
        "-" if ahead is None else probability_text(ahead),
        f"({', '.join(f'{content[axis]:.2f}' for axis in AXES if axis in content)})" if placed else "-",
        f"{100 * content['sigma_m']:.1f} cm" if placed else "-",
        stamp_text(or_nan(content["since_s"]), clock),
        stamp_text(or_nan(content["seen_s"]), clock),
        str(content["sites"]),
        flags,
    ]


def print_why(answer: Answer) -> None:
    """Print the answer, its reasons, and the evidence of every session."""
    from evermap.maps.why import probability_text

    echo(answer.headline)
    for reason in answer.reasons:
        echo(f"  - {reason}")
    for revision, change in answer.changes:
        echo(f"  revision {revision}: {change_line(change, answer.clock)}")
    if answer.visits:
        head = ("revision", "session", "looks from", "to", "frames", "hits", "misses", "expected", "nats", "P(exists)")
        rows = [
            [
                str(visit.revision),
                " of ".join(filter(None, (visit.recording, visit.robot))) or "-",
                stamp_text(visit.from_s, answer.clock),
                stamp_text(visit.to_s, answer.clock),
                str(visit.n_looks),
                str(visit.n_hits),
                str(visit.n_misses),
                f"{visit.expected:.1f}",
                f"{visit.log_odds:+.1f}",
                probability_text(visit.p_exists),
            ]
            for visit in answer.visits
        ]
        print_table("what the sessions saw", rows, head, numbers=(0, 4, 5, 6, 7, 8, 9))
