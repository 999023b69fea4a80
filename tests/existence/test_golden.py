"""Posteriors against another implementation of Rosen's filter."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from evermap.existence import single
from evermap.existence.one_stay import PersistenceFilter
from evermap.survival import Exponential, GeneralPurpose, LifetimePrior, Uniform

from .rows import look_exponential, look_general_purpose

PRIORS = {
    "exponential": lambda p: Exponential(p["rate"]),
    "log_uniform": lambda p: GeneralPurpose(p["lambda_l"], p["lambda_u"]),
    "uniform": lambda p: Uniform(p["upper"]),
}
TOLERANCE = 1e-9


@pytest.mark.parametrize("name", PRIORS)
def test_streams(rosen_traces: list[dict[str, Any]], name: str) -> None:
    for sequence in rosen_traces:
        reference = sequence["priors"][name]
        birth = sequence["init_time"]
        times = np.array(sequence["times"]) - birth
        prior: LifetimePrior = PRIORS[name](reference["params"])
        state = single.init(1, prior, evidence=True)
        predicted = [state.predict(t - birth)[0] for t in sequence["pre_times"]]
        np.testing.assert_allclose(predicted, reference["prior_pred"], atol=TOLERANCE)
        feature = np.zeros(len(times), dtype=np.int64)
        state, posterior = state.run(feature, times, sequence["y"], sequence["P_M"], sequence["P_F"])
        np.testing.assert_allclose(posterior, reference["posterior"], atol=TOLERANCE)
        assert state.log_evidence is not None
        np.testing.assert_allclose(state.log_evidence[0], reference["log_evidence"][-1], rtol=TOLERANCE, atol=TOLERANCE)
        future = [state.predict(t - birth)[0] for t in reference["future_times"]]
        np.testing.assert_allclose(future, reference["future"], atol=TOLERANCE)


@pytest.mark.parametrize("name", PRIORS)
def test_one_feature(rosen_traces: list[dict[str, Any]], name: str) -> None:
    for sequence in rosen_traces[:20]:
        reference = sequence["priors"][name]
        birth = sequence["init_time"]
        feature = PersistenceFilter(PRIORS[name](reference["params"]))
        for k, (t, y, p_miss, p_false) in enumerate(
            zip(sequence["times"], sequence["y"], sequence["P_M"], sequence["P_F"], strict=True)
        ):
            assert feature.update(t - birth, bool(y), p_miss, p_false) == pytest.approx(
                reference["posterior"][k], abs=TOLERANCE
            )
            assert feature.log_evidence == pytest.approx(reference["log_evidence"][k], rel=TOLERANCE, abs=TOLERANCE)
            if k < len(sequence["mid_times"]):
                middle = feature.predict(sequence["mid_times"][k] - birth)
                assert middle == pytest.approx(reference["mid"][k], abs=TOLERANCE)


@pytest.mark.parametrize("name", ["exponential", "log_uniform"])
def test_kernels(rosen_traces: list[dict[str, Any]], name: str) -> None:
    """All sequences side by side, one a row."""
    n = len(rosen_traces)
    odds, stamp = np.zeros(n), np.zeros(n)
    for k in range(max(len(s["times"]) for s in rosen_traces)):
        rows = np.array([i for i, s in enumerate(rosen_traces) if k < len(s["times"])])
        chosen = [rosen_traces[i] for i in rows]
        time, miss, false = (np.array([s[key][k] for s in chosen]) for key in ("times", "P_M", "P_F"))
        time -= np.array([s["init_time"] for s in chosen])
        seen = np.array([s["y"][k] for s in chosen]) == 1
        parameters = [s["priors"][name]["params"] for s in chosen]
        if name == "exponential":
            rate = np.array([p["rate"] for p in parameters])
            look = look_exponential(odds[rows], stamp[rows], rate, time, seen, miss, false)
        else:
            low, high = (np.array([p[key] for p in parameters]) for key in ("lambda_l", "lambda_u"))
            look = look_general_purpose(odds[rows], stamp[rows], low, high, time, seen, miss, false)
        odds[rows], stamp[rows] = look.inverse_odds, time
        expected = [s["priors"][name]["posterior"][k] for s in chosen]
        np.testing.assert_allclose(look.probability, expected, atol=TOLERANCE)
