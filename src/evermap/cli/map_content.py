"""What `evermap map` prints of revisions, landmarks and changes, for machines and for people.

How `evermap map why` answers: lines, a table of the sessions, a figure.
"""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evermap.cli.terminal import echo, print_table, write_picture
from evermap.runs.summary import change_dict
from evermap.stamps import between_text, stamp_text
from evermap.types import UNKNOWN, Clock, FloatArray, MapChange, json_number

if TYPE_CHECKING:
    from evermap.maps.living import LivingMap
    from evermap.maps.store import Revision
    from evermap.maps.why import Answer


_AXES = ("x_m", "y_m", "z_m")


def revision_dict(item: Revision) -> dict[str, Any]:
    """Return one line of the history."""
    origin = asdict(item.provenance) | {"kind": item.provenance.kind.value}
    return {
        "revision": item.number,
        "parent": item.parent,
        "restores": item.restores,
        "created_at": item.created_at,
        "evermap_version": item.evermap_version,
        **origin,
        **{name: json_number(origin[name]) for name in ("stamp_from_s", "stamp_to_s", "wall_s")},
        "landmarks": item.n_landmarks,
        "existing": item.n_existing,
        "changes": {kind.value: count for kind, count in item.n_changes.items()},
        "grown": item.n_grown,
    }


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


def landmark_dicts(living: LivingMap, p_ahead: FloatArray) -> list[dict[str, Any]]:
    """Return every landmark at its most probable place.

    Args:
        living: the map.
        p_ahead: (L,) probability that each stands there at the time that was asked for.
    """
    import numpy as np

    from evermap.geometry.chunked import blocks
    from evermap.maps.living import clique_rows

    members, site = living.members, living.site_of()
    place = living.place_row(members.landmark_id, site)
    p_exists = living.p_exists()
    at = np.searchsorted(living.sites.site_id, site)
    own = blocks(living.covariance_m2, living.dim)
    cliques, row_of_site = clique_rows(living.sites)
    n_sites = np.append(np.bincount(row_of_site), 0)[np.searchsorted(cliques, members.clique_id)]
    content = []
    for row in range(len(members)):
        placed = place[row] >= 0
        at_m = living.places.position_m[place[row]].tolist() if placed else [None] * living.dim
        content.append(
            {
                "landmark": int(members.landmark_id[row]),
                "label": living.label(int(members.landmark_id[row])),
                "class": class_name(living, int(members.class_id[row])),
                "clique": int(members.clique_id[row]),
                "p_exists": float(p_exists[row]),
                "p_ahead": json_number(float(p_ahead[row])),
                **dict(zip(_AXES, at_m, strict=False)),
                **({"rotation": _rotation(living, int(place[row]))} if living.dim == 3 else {}),
                "sigma_m": float(np.sqrt(np.trace(own[place[row]]) / living.dim)) if placed else None,
                "since_s": json_number(float(living.sites.since_s[at[row]])) if placed else None,
                "seen_s": json_number(float(living.sites.seen_s[at[row]])) if placed else None,
                "sites": int(n_sites[row]) if placed else 0,
                "hits": int(living.places.n_hits[place[row]]) if placed else 0,
                "misses": int(living.places.n_misses[place[row]]) if placed else 0,
                "pinned": bool(members.pinned[row]),
                "deleted": bool(members.deleted[row]),
            }
        )
    return content


def _rotation(living: LivingMap, place: int) -> list[float] | None:
    """Quaternion of a place in space; None of a point, and where `place` is -1."""
    rotation: list[float] = living.places.rotation[place].tolist() if place >= 0 else [math.nan]
    return None if math.isnan(rotation[0]) else rotation


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
        f"({', '.join(f'{content[axis]:.2f}' for axis in _AXES if axis in content)})" if placed else "-",
        f"{100 * content['sigma_m']:.1f} cm" if placed else "-",
        stamp_text(_or_nan(content["since_s"]), clock),
        stamp_text(_or_nan(content["seen_s"]), clock),
        str(content["sites"]),
        flags,
    ]


def prior_dicts(living: LivingMap) -> list[dict[str, Any]]:
    """Return what users said of lifetimes, by class; '' for all classes of which they said nothing."""
    from evermap.survival.text import prior_text

    return [
        {
            "class": class_name(living, class_id),
            "stay": prior_text(life.stay),
            "absence": prior_text(life.absence) if life.tells_absence else None,
            "worth_stays": life.n_stays,
        }
        for class_id, life in zip(living.lives.prior_class_id.tolist(), living.lives.prior, strict=True)
    ]


def life_dicts(living: LivingMap) -> list[dict[str, Any]]:
    """Return what was learned of how long things stay, by class ('' for all) and chunk (None for the whole floor)."""
    from evermap.maps.lives import EVERYWHERE
    from evermap.survival.text import prior_text

    lives = living.lives
    return [
        {
            "class": class_name(living, class_id),
            "chunk": None if EVERYWHERE in chunk else chunk,
            "chunk_m": lives.chunk_m,
            "stay": prior_text(life.stay),
            "half_gone_s": json_number(life.stay.quantile(0.5)),
            "stays": life.n_stays,
            "stays_that_ended": life.n_ended,
        }
        for class_id, chunk, life in zip(lives.class_id.tolist(), lives.chunk.tolist(), lives.life, strict=True)
    ]


def answer_dict(answer: Answer) -> dict[str, Any]:
    """Return everything behind a 'why', with every look."""
    seen, stays = answer.evidence, answer.stays
    return {
        "landmark": answer.landmark_id,
        "label": answer.label,
        "class": answer.class_name,
        "clique": answer.clique_id,
        "companions": list(answer.companions),
        "p_exists": answer.p_exists,
        "stamp_s": json_number(answer.stamp_s),
        "pinned": answer.pinned,
        "deleted": answer.deleted,
        "headline": answer.headline,
        "reasons": list(answer.reasons),
        "sessions": [
            {
                "revision": visit.revision,
                "recording": visit.recording,
                "stamp_from_s": visit.from_s,
                "stamp_to_s": visit.to_s,
                "looks": visit.n_looks,
                "hits": visit.n_hits,
                "misses": visit.n_misses,
                "expected_hits": json_number(visit.expected),
                "log_odds": json_number(visit.log_odds),
                "p_exists": json_number(visit.p_exists),
            }
            for visit in answer.visits
        ],
        "stays": [
            {
                "site": int(stays.site_id[k]),
                **{
                    name: json_number(float(getattr(stays, name)[k]))
                    for name in ("elsewhere_s", "first_s", "last_s", "gone_s")
                },
            }
            for k in range(len(stays))
        ],
        "changes": [{"revision": revision, **change_dict(change)} for revision, change in answer.changes],
        "edits": [{"revision": revision, "at": when, "what": word} for revision, when, word in answer.edits],
        "looks": {
            "stamp_s": seen.stamp_s.tolist(),
            "hits": seen.n_hits.tolist(),
            "misses": seen.n_misses.tolist(),
            "expected_hits": [json_number(value) for value in seen.expected.tolist()],
            "log_odds": [json_number(value) for value in seen.log_odds.tolist()],
            "p_exists": [json_number(value) for value in seen.p_exists.tolist()],
        },
    }


def class_name(living: LivingMap, class_id: int) -> str:
    """Return '' for a class that is not known, its number for one without a name."""
    if class_id == UNKNOWN:
        return ""
    return living.class_names[class_id] if class_id < len(living.class_names) else str(class_id)


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def print_why(answer: Answer) -> None:
    """Print the answer, what it rests on, and what every session saw."""
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
        print_table("what the sessions saw", rows, head, numbers=(0, 4, 5, 6, 7, 8, 9))


def draw_why(path: Path, answer: Answer) -> None:
    """Draw the same as a figure."""
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
