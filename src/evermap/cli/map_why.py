"""How `evermap map why` answers: lines, a table of the sessions, a figure."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from evermap.cli.terminal import echo, print_rows, write_picture

if TYPE_CHECKING:
    from evermap.maps.why import Answer


def print_why(answer: Answer) -> None:
    """The answer, what it rests on, and what every session saw."""
    from evermap.cli.map_content import change_line
    from evermap.maps.why import probability_text
    from evermap.stamps import stamp_text

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
                visit.recording or "-",
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
        print_rows("what the sessions saw", head, rows, numbers=(0, 4, 5, 6, 7, 8, 9))


def draw_why(path: Path, answer: Answer) -> None:
    """The same as a figure."""
    import numpy as np

    from evermap.viz.living_map_figures import LandmarkHistory, plot_why

    seen, stays = answer.evidence, answer.stays
    session = np.repeat([v.revision for v in answer.visits], [v.n_looks for v in answer.visits])
    names = {site: f"site {k + 1}" for k, site in enumerate(dict.fromkeys(stays.site_id.tolist()))}
    columns = zip(stays.site_id.tolist(), stays.elsewhere_s, stays.first_s, stays.last_s, stays.gone_s, strict=True)
    history = LandmarkHistory(
        seen.stamp_s,
        seen.p_exists,
        seen.n_hits,
        seen.n_misses,
        seen.log_odds,
        session.astype(np.int64),
        [(names[site], *map(float, stamps)) for site, *stamps in columns],  # type: ignore[misc]
        answer.stamp_s,
        answer.clock,
    )
    write_picture(path, plot_why(history, title=answer.headline))
