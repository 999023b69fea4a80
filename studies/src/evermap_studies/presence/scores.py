"""Scores of the comparison, and how choices are made inside the training data.

Beliefs of all contenders are kept 1e-6 from 0 and 1 before they are scored: one certainty that was wrong would make the
log loss infinite.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from evermap.existence.protocol import Instants, Looks
from evermap.metrics.belief import belief_scores, reliability
from evermap.types import FloatArray
from evermap_studies.presence.models import Believe, Contender
from evermap_studies.presence.tasks import Trial

SURE = 1e-6
HELD_OUT_PART = 0.2
"""The last part of the room's training recording, to choose with."""

Scores = dict[str, float]


def beliefs(believe: Believe, trial: Trial) -> FloatArray:
    """(R, N) probability of presence at every stamp, for each drawing of the looks."""
    return kept(believe(trial.looks, trial.instants)).reshape(trial.drawings, -1)


def kept(belief: FloatArray) -> FloatArray:
    """Beliefs at least `SURE` from 0 and 1."""
    return np.clip(belief, SURE, 1.0 - SURE)


def door_scores(found: Sequence[FloatArray], trials: Sequence[Trial]) -> Scores:
    """Scores of a task, mean over the weeks and the drawings.

    Args:
        found: (R, N) beliefs of each week.
        trials: the weeks.

    Returns:
        `mae`, `brier`, `log_loss`, `balanced_accuracy`; `calibration_error` with ten bins over all weeks of a drawing,
        mean over the drawings; `brier_se`, `log_loss_se` standard errors that the drawings leave, 0 where there is one.
    """
    drawings = []
    for drawing in range(len(found[0])):
        weeks = [belief_scores(p[drawing], t.present) for p, t in zip(found, trials, strict=True)]
        scores = {
            name: float(np.mean([getattr(week, name) for week in weeks]))
            for name in ("mae", "brier", "log_loss", "balanced_accuracy")
        }
        pooled = np.concatenate([p[drawing] for p in found])
        scores["calibration_error"] = reliability(pooled, np.concatenate([t.present for t in trials])).error
        drawings.append(scores)
    mean = {name: float(np.mean([one[name] for one in drawings])) for name in drawings[0]}
    n = len(drawings)
    for name in ("brier", "log_loss"):
        spread = np.std([one[name] for one in drawings], ddof=1) if n > 1 else 0.0
        mean[f"{name}_se"] = float(spread / np.sqrt(n))
    return mean


def week_scores(found: Sequence[FloatArray], trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """Brier score and log loss of each week, mean over the drawings: how much weeks differ."""
    rows = []
    for p_present, week in zip(found, trials, strict=True):
        scores = [belief_scores(one, week.present) for one in p_present]
        rows.append(
            {
                "week": week.name,
                "brier": float(np.mean([one.brier for one in scores])),
                "log_loss": float(np.mean([one.log_loss for one in scores])),
            }
        )
    return rows


def room_scores(belief: FloatArray, present: FloatArray, stamp_s: FloatArray) -> Scores:
    """Scores of a landmark as the authors of the recording have them.

    Args:
        belief: (N,) at every grid time.
        present: (N,) truth.
        stamp_s: (N,) grid times.

    Returns:
        `mae` by the trapezoidal rule, `accuracy`, `f1` and `balanced_accuracy` at 0.5 (recall of a state that never was
        is 0, so the last is 0.5 at most for a landmark that never leaves), `brier`, `log_loss`.
    """
    scores = belief_scores(belief, present)
    there, said = present == 1.0, belief >= 0.5
    hits = float((there & said).sum())
    wrong = float((there != said).sum())
    recalls = [
        (said[is_so] == state).mean() if is_so.any() else 0.0 for state, is_so in ((True, there), (False, ~there))
    ]
    return {
        "mae": float(np.trapezoid(np.abs(present - belief), stamp_s) / (stamp_s[-1] - stamp_s[0])),
        "accuracy": scores.accuracy,
        "f1": 2.0 * hits / (2.0 * hits + wrong) if hits + wrong else float("nan"),
        "balanced_accuracy": float(np.mean(recalls)),
        "brier": scores.brier,
        "log_loss": scores.log_loss,
    }


def mean_scores(scores: Sequence[Scores]) -> Scores:
    """Mean of each score over landmarks."""
    return {name: float(np.mean([one[name] for one in scores])) for name in scores[0]}


def choose_for_week(contender: Contender, early: Any, rehearsal: Trial) -> Any:
    """The option of the smallest log loss in the week held out.

    Args:
        contender: whose options.
        early: what it learned from the rest of the training data.
        rehearsal: the week held out, under the task.
    """
    if len(contender.options) == 1:
        return contender.options[0]
    losses = [
        door_scores([beliefs(contender.believe(early, option), rehearsal)], [rehearsal])["log_loss"]
        for option in contender.options
    ]
    return contender.options[int(np.argmin(losses))]


def choose_by_looks(contender: Contender, looks: Looks) -> Any:
    """The option that predicts the last looks of the training recording best, each from those before it.

    There is no truth to choose with, so what is scored is the probability of the detector's next output.

    Args:
        contender: whose options.
        looks: at one landmark.
    """
    if len(contender.options) == 1:
        return contender.options[0]
    time_s = looks.stamp_s
    late = time_s > time_s[-1] - HELD_OUT_PART * (time_s[-1] - time_s[0])
    early = Looks(
        np.array([0, int((~late).sum())]),
        time_s[~late],
        looks.detected[~late],
        looks.p_miss[~late],
        looks.p_false[~late],
    )
    learned = contender.learn(early)
    before = Instants.same_for_all(1, np.nextafter(time_s[late], -np.inf))
    losses = []
    for option in contender.options:
        p_present = kept(contender.believe(learned, option)(looks, before))
        p_hit = p_present * (1.0 - looks.p_miss[late]) + (1.0 - p_present) * looks.p_false[late]
        losses.append(-np.log(np.where(looks.detected[late] == 1.0, p_hit, 1.0 - p_hit)).mean())
    return contender.options[int(np.argmin(losses))]
