"""A living map and its history as plain values under stable keys, for `evermap map --json` and the server."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from evermap.io.landmarks import labels_of
from evermap.io.spatial import AT
from evermap.runs.summary import change_dict
from evermap.types import FloatArray, json_number, landmark_label

if TYPE_CHECKING:
    from evermap.maps.diff import Difference
    from evermap.maps.living import LivingMap
    from evermap.maps.store import MapStore, Revision
    from evermap.maps.why import Answer


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


def landmark_dicts(living: LivingMap, p_ahead: FloatArray | None = None) -> list[dict[str, Any]]:
    """Return every landmark at its most probable place; `p_ahead` (L,) is P(exists) at another time than the map's."""
    import numpy as np

    from evermap.geometry.chunked import blocks
    from evermap.maps.living import clique_rows

    members, site = living.members, living.site_of()
    classes = labels_of(members.class_id, living.class_names)
    place = living.place_row(members.landmark_id, site)
    p_exists = living.p_exists()
    p_ahead = p_exists if p_ahead is None else p_ahead
    at = np.searchsorted(living.sites.site_id, site)
    own = blocks(living.covariance_m2, living.dim)
    cliques, row_of_site = clique_rows(living.sites)
    n_sites = np.append(np.bincount(row_of_site), 0)[np.searchsorted(cliques, members.clique_id)]
    names, content = living.landmark_names, []
    for row in range(len(members)):
        placed = place[row] >= 0
        at_m = living.places.position_m[place[row]].tolist() if placed else [None] * living.dim
        content.append(
            {
                "landmark": int(members.landmark_id[row]),
                "label": landmark_label(int(members.landmark_id[row]), names),
                "class": classes[row],
                "clique": int(members.clique_id[row]),
                "p_exists": float(p_exists[row]),
                "p_ahead": json_number(float(p_ahead[row])),
                **dict(zip(AT, at_m, strict=False)),
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


def pose_dicts(store: MapStore, revision: int | None = None, at_s: float = math.inf) -> list[dict[str, Any]]:
    """Return where each robot was in its newest session of a revision until a time, with the path that it had driven.

    Raises:
        DamagedMapError: a path is not what was written.
    """
    from evermap.maps.store import DamagedMapError, RevisionKind
    from evermap.maps.store.content import DamagedError
    from evermap.maps.store.measured import TRAJECTORY, unpack_trajectory

    line = store.lineage(revision)
    kept = {item.revision: item for item in store.attachments(line) if item.name == TRAJECTORY}
    newest: dict[str, tuple[float, int]] = {}
    for item in store.log():
        said = item.provenance
        if item.number in line and said.kind is RevisionKind.SESSION and said.stamp_from_s <= at_s:
            newest[said.robot] = max(newest.get(said.robot, (-math.inf, 0)), (said.stamp_from_s, item.number))
    found = []
    for robot, (_, number) in sorted(newest.items()):
        told: dict[str, Any] = dict.fromkeys(("stamp_s", "x_m", "y_m", "heading_rad")) | {"path_m": []}
        if number in kept:  # an older evermap kept none
            try:
                stamp_s, pose = unpack_trajectory(store.attached(kept[number]))
            except DamagedError as error:
                raise DamagedMapError(f"revision {number}: {error}", path=store.where) from None
            pose, stamp_s = pose[stamp_s <= at_s], stamp_s[stamp_s <= at_s]
            for row in range(len(pose))[-1:]:
                told |= dict(zip(told, [stamp_s[row].item(), *pose[row].tolist()], strict=False))
            told["path_m"] = pose[:, :2].round(3).tolist()
        found.append({"robot": robot, "revision": number, **told})
    return found


def prior_dicts(living: LivingMap) -> list[dict[str, Any]]:
    """Return what users said of lifetimes, by class; '' for all classes of which they said nothing."""
    from evermap.survival.text import prior_text

    names = labels_of(living.lives.prior_class_id, living.class_names)
    return [
        {
            "class": name,
            "stay": prior_text(life.stay),
            "absence": prior_text(life.absence) if life.tells_absence else None,
            "worth_stays": life.n_stays,
        }
        for name, life in zip(names, living.lives.prior, strict=True)
    ]


def life_dicts(living: LivingMap) -> list[dict[str, Any]]:
    """Return the learned lifetimes, by class ('' for all) and chunk (None for the whole floor)."""
    from evermap.maps.lives import EVERYWHERE
    from evermap.survival.text import prior_text

    lives, names = living.lives, labels_of(living.lives.class_id, living.class_names)
    return [
        {
            "class": name,
            "chunk": None if EVERYWHERE in chunk else chunk,
            "chunk_m": lives.chunk_m,
            "stay": prior_text(life.stay),
            "half_gone_s": json_number(life.stay.quantile(0.5)),
            "stays": life.n_stays,
            "stays_that_ended": life.n_ended,
        }
        for name, chunk, life in zip(names, lives.chunk.tolist(), lives.life, strict=True)
    ]


def hours_dict(living: LivingMap) -> dict[str, Any]:
    """Return what is known of the hours of the week at which stays end, under `hours`; {} where nobody could ask.

    `factor` has the factor on hazards for each of the 168 hours from Monday 00:00 on, of the classes in `classes`; None
    where stays end at all hours alike, or looks do not show it.
    """
    lives = living.lives
    if not len(lives.hours_known):
        return {}
    n_dated, nats = lives.hours_known.tolist()
    factor = lives.rhythm.hourly_factor.round(4).tolist() if lives.rhythm else None
    classes = labels_of(lives.hourly_class_id, living.class_names)
    return {"hours": {"ends_dated": n_dated, "evidence_nats": json_number(nats), "factor": factor, "classes": classes}}


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
                "robot": visit.robot,
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


def diff_dict(found: Difference) -> dict[str, Any]:
    """Return what changed between two revisions."""
    return {
        "a": found.a,
        "b": found.b,
        "changes": [*map(change_dict, found.changes)],
        "grown": found.grown.tolist(),
        "edits": [{"landmark": name, "what": word} for name, word in found.edits],
    }
