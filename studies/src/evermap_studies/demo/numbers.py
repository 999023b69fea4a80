"""What the study says, as plain values with stable keys: section `demo` of `summary.json`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from evermap.types import BoolArray, FloatArray, IntArray, Trajectory
from evermap_studies.demo.claims import Claims, claim_numbers, claims_of
from evermap_studies.demo.lifetimes import LearnedLife
from evermap_studies.demo.methods import method_named
from evermap_studies.demo.scores import Counts, alignment_of, map_counts, pose_counts
from evermap_studies.demo.study import Study
from evermap_studies.worlds.scores import NEAR_M

WEEK_DAYS = 7
POSE_RATIO_BOUND, EXISTENCE_BOUND, COST_BOUND = 1.15, 0.98, 1.2
"""What is expected of evermap: pose RMSE over the oracle's, precision of claims and cost of last week over first."""
FALSE_BOUND, CERTAIN_BOUND, RECALL_BOUND = 0.03, 0.003, 0.95
"""Of the changes told, those of things that never changed, and those with p > .99; told of what could be known."""
LIFETIME_BOUND = 0.9
"""Share of the true quartiles of lifetimes that lie within the learned 95 % intervals; they are correlated."""

COUNTED = (
    f"poses in the map's frame, tied to the truth once, by the path of the first session; a claim (p_exists >= 0.5) is"
    f" right within {NEAR_M} m; recall over the landmarks that stand where they were really looked at; Brier scores"
    " over 'the landmark stands where it was last detected' of every landmark that was ever detected"
)
FALSE_MEANS = (
    "A told change counts once for each landmark. It is false if nothing had happened to the landmark since the method"
    " last told where it stands (or else since it was first detected), if it is told as vanished and stands where the"
    " method's map had it, or if it is told as come or moved and stands nowhere. A change can be"
    " known where both the old and the new state were really looked at: in range, in view, along a clear line, seen"
    " with a probability of at least .95."
)


@dataclass(frozen=True, slots=True)
class Line:
    """One method over all sessions.

    Attributes:
        counts: one a session.
        claims: the changes that it told.
        pose_truth_map: (3,) alignment by the first session.
    """

    counts: tuple[Counts, ...]
    claims: Claims
    pose_truth_map: FloatArray


def lines_of(study: Study) -> dict[str, Line]:
    """Every method compared with the truth, by name."""
    paths = [session.truth for session in study.building.sessions]
    lines = {}
    for name, visits in study.visits.items():
        pose = alignment_of(visits[0].path, _known(paths[0]))
        counts = tuple(
            pose_counts(visit.path, _known(paths[k]), pose, found=visit.found)
            + map_counts(visit.snapshot, study.truth, k, pose)
            for k, visit in enumerate(visits)
        )
        lines[name] = Line(counts, claims_of(visits, study.truth, pose), pose)
    return lines


def _known(path: Trajectory | None) -> Trajectory:
    assert path is not None  # the simulation knows
    return path


def week_of(study: Study) -> IntArray:
    """(S,) week of every session, from 0."""
    return np.array([truth.day // WEEK_DAYS for truth in study.building.truths])


def lengths_of(study: Study) -> FloatArray:
    """(S,) length that every patrol was drawn to have [s]."""
    drawn = np.array(sorted(set(study.scenario.patrol_lengths_s)))
    took_s = np.array([truth.end_s - truth.start_s for truth in study.building.truths])
    return np.asarray(drawn[np.abs(took_s[:, None] - drawn).argmin(axis=1)])


def ratios(counts: Counts) -> dict[str, float | None]:
    """Scores of summed counts; None where there is nothing to divide by."""
    forecast, share = counts.forecast.brier, _over(counts.n_come_true, counts.forecast.n_statements)
    return {
        "pose_rmse_m": _root(_over(counts.pose_error2_m2, counts.n_poses)),
        "pose_rmse_own_alignment_m": _root(_over(counts.own_error2_m2, counts.n_poses)),
        "lost": counts.n_lost,
        "precision": counts.existence.precision,
        "precision_sure": counts.sure.precision,
        "recall": counts.known.recall,
        "existence_brier": counts.existence.brier,
        "forecast_brier": forecast,
        "forecast_skill_over_as_is": _skill(forecast, counts.as_is.brier),
        "forecast_skill_over_base_rate": _skill(forecast, None if share is None else share * (1.0 - share)),
    }


def demo_dict(study: Study, lines: dict[str, Line], lives: Sequence[LearnedLife], seed: int) -> dict[str, Any]:
    """All numbers that are the same for the same seed."""
    return {
        "scenario": study.scenario.as_dict(),
        "seed": seed,
        "counted": COUNTED,
        "false_means": FALSE_MEANS,
        "sessions": _sessions(study),
        "methods": {name: _method(study, name, line) for name, line in lines.items()},
        "lifetimes": {life.name: _life(life) for life in lives},
        "true_events": len(study.building.events),
        "expected": expected(study, lines, lives),
    }


def expected(study: Study, lines: dict[str, Line], lives: Sequence[LearnedLife]) -> dict[str, dict[str, Any]]:
    """What was expected of the demonstration before it was run, and what came out."""
    week = week_of(study)
    last, whole = (
        {name: ratios(_sum(line.counts, rows)) for name, line in lines.items()}
        for rows in (week == week[-1], week >= 0)
    )
    told = claim_numbers(lines["evermap"].claims, study.truth, week >= 0)
    ratio = _over(last["evermap"]["pose_rmse_m"], last["oracle"]["pose_rmse_m"])
    covers = [covered for life in lives for covered in life.covers]
    return {
        "never_changed": _outcome(
            "of the changes evermap told, those of things that never changed",
            _over(told["never_changed"], told["told"]),
            most=FALSE_BOUND,
        ),
        "never_changed_certain": _outcome(
            "of the changes evermap told, those of things that never changed, with p > .99",
            _over(told["never_changed_certain"], told["told"]),
            most=CERTAIN_BOUND,
        ),
        "told_recall": _outcome(
            "of the changes that could be known, those that evermap told", told["told_recall"], least=RECALL_BOUND
        ),
        "precision_sure": _outcome(
            "precision of evermap's claims with p >= .9", whole["evermap"]["precision_sure"], least=EXISTENCE_BOUND
        ),
        "forecast": _outcome(
            "forecast skill of evermap over a constant", whole["evermap"]["forecast_skill_over_base_rate"], least=0.0
        ),
        "as_good_as_told": _outcome("pose RMSE of evermap over the oracle's, last week", ratio, most=POSE_RATIO_BOUND),
        "lifetimes": _outcome(
            "share of the true quartiles of lifetimes within the learned intervals",
            _over(sum(covers), len(covers)),
            least=LIFETIME_BOUND,
        ),
    }


def cost(study: Study) -> dict[str, Any]:
    """What sessions cost; times differ from run to run, so they are kept apart."""
    week, minutes = week_of(study), lengths_of(study) / 60.0
    cpu_s = {name: np.array([visit.cpu_s for visit in visits]) / minutes for name, visits in study.visits.items()}
    first, last = (float(np.median(cpu_s["evermap"][week == which])) for which in (0, week[-1]))
    return {
        "cpu_s_per_minute": {name: times.tolist() for name, times in cpu_s.items()},
        "expected": {
            "flat_cost": _outcome(
                "median time of evermap for a minute of recording, last week over first", last / first, most=COST_BOUND
            )
        },
    }


def _outcome(
    what: str, value: float | None, *, least: float | None = None, most: float | None = None
) -> dict[str, Any]:
    holds = value is not None and (least is None or value >= least) and (most is None or value <= most)
    return {"what": what, "value": value, "least": least, "most": most, "holds": holds}


def _life(life: LearnedLife) -> dict[str, Any]:
    """What was learned of a class, at the ages of the figure."""
    return {
        "stays": life.n_stays,
        "ended": life.n_ended,
        "age_days": life.age_days.tolist(),
        "true_survival": life.truth.tolist(),
        "survival": life.mean.tolist(),
        "low": life.low.tolist(),
        "high": life.high.tolist(),
        "quartiles_covered": list(life.covers),
    }


def _sessions(study: Study) -> list[dict[str, Any]]:
    """The world, session by session."""
    truth = study.truth
    as_first = np.all(truth.position_m == truth.position_m[0], axis=2)
    return [
        {
            "session": k + 1,
            "day": known.day + 1,
            "start_s": known.start_s,
            "patrol_s": float(length_s),
            "shut_rooms": [study.building.plan.rooms[row].name for row in known.shut_rooms],
            "wing_shut": known.wing_shut,
            "landmarks": int(truth.there[k].sum()),
            "changed": int(truth.changed[k].sum()),
            "known": int(truth.known[k].sum()),
            "where_first_mapped": int(as_first[k].sum()),
        }
        for k, (known, length_s) in enumerate(zip(study.building.truths, lengths_of(study), strict=True))
    ]


def _method(study: Study, name: str, line: Line) -> dict[str, Any]:
    week, length_s, method = week_of(study), lengths_of(study), method_named(name)
    sizes = [{"landmarks": len(v.snapshot.landmarks), "places": len(v.snapshot.place_id), "sites": v.snapshot.n_sites}
             for v in study.visits[name]]  # fmt: skip

    def scores(sessions: BoolArray) -> dict[str, Any]:
        # what the oracle tells are the changes that it was told
        told = None if method.is_told else claim_numbers(line.claims, study.truth, sessions)
        return ratios(_sum(line.counts, sessions)) | {"changes": told}

    return {
        "label": method.label,
        "says": method.says,
        "sessions": [ratios(counts) | size for counts, size in zip(line.counts, sizes, strict=True)],
        "weeks": [scores(week == which) for which in np.unique(week)],
        "by_patrol_s": {f"{length:g}": scores(length_s == length) for length in np.unique(length_s)},
        "whole": scores(week >= 0),
    }


def _sum(counts: tuple[Counts, ...], rows: BoolArray) -> Counts:
    return sum((counts[k] for k in np.flatnonzero(rows)), start=Counts())


def _over(value: float | None, by: float | None) -> float | None:
    return value / by if value is not None and by else None


def _root(square: float | None) -> float | None:
    return None if square is None else float(np.sqrt(square))


def _skill(brier: float | None, reference: float | None) -> float | None:
    """1 for a perfect forecast, 0 for one no better than the reference."""
    return 1.0 - brier / reference if brier is not None and reference else None
