"""A run from Python: beliefs, forecasts and scores against the filter of one feature and against plain loops."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evermap.cli.options import priors_by_class
from evermap.config import PersistConfig
from evermap.errors import ConfigError, DataError, EvermapError, InputError
from evermap.existence.models import NamedModels, save_models
from evermap.existence.one_stay import OneStay, PersistenceFilter
from evermap.existence.phase_type import PhaseType
from evermap.existence.protocol import Instants
from evermap.existence.run_length import RunLength
from evermap.metrics.belief import belief_scores
from evermap.runs.persist.models import ModelOfEach, some_looks
from evermap.runs.persist.run import nice_step, run_persist
from evermap.runs.persist.table import LookTable, read_looks
from evermap.survival import Exponential, parse_prior

PRIOR = "exponential:half-life=5min"


def table(tmp_path: Path, seed: int = 1, *, classes: bool = False, rows: int = 300) -> LookTable:
    """A table in random order with looks, mere questions, and truth."""
    rng = np.random.default_rng(seed)
    columns = ["stamp_s,feature_id,detected,p_miss,present" + (",class_id" if classes else "")]
    for _ in range(rows):
        stamp, who = rng.integers(0, 4000) / 4.0, int(rng.integers(0, 8))
        there = stamp < 120.0 * (who + 1)
        detected = "" if rng.random() < 0.2 else str(int(rng.random() < (0.9 if there else 0.1)))
        kind = f",{'cart' if who % 2 else 'wall'}" if classes else ""
        columns.append(f"{stamp},{who},{detected},{rng.uniform(0.05, 0.3):.3f},{int(there)}{kind}")
    path = tmp_path / "looks.csv"
    path.write_text("\n".join(columns) + "\n")
    return read_looks(path, p_false=0.1)


def by_hand(looks: LookTable, feature: int, instant: float, prior: str) -> float:
    """The filter of one feature, with all its looks up to and including an instant."""
    rows = np.flatnonzero((looks.feature == feature) & looks.looked & (looks.stamp_s <= instant))
    rows = rows[np.argsort(looks.stamp_s[rows], kind="stable")]
    seen = rows[looks.detected[rows] == 1.0]
    if len(seen) == 0:
        return np.nan
    birth = looks.stamp_s[seen[0]]
    filter_ = PersistenceFilter(parse_prior(prior))
    for row in rows[np.flatnonzero(rows == seen[0])[0] + 1 :]:
        filter_.update(looks.stamp_s[row] - birth, bool(looks.detected[row]), looks.p_miss[row], looks.p_false[row])
    return filter_.predict(instant - birth)


def test_beliefs_are_those_of_every_row_in_the_order_of_the_table(tmp_path: Path) -> None:
    looks = table(tmp_path)
    result = run_persist(looks, PersistConfig(prior=PRIOR))
    beliefs = result.beliefs
    np.testing.assert_array_equal(beliefs.stamp_s, looks.stamp_s)
    np.testing.assert_array_equal(beliefs.feature, looks.feature)
    expected = [by_hand(looks, f, t, PRIOR) for f, t in zip(looks.feature, looks.stamp_s, strict=True)]
    np.testing.assert_allclose(beliefs.p_exists, expected, rtol=1e-9)
    assert np.isnan(expected).any()
    assert any("left empty" in remark for remark in result.warnings)


def test_each_class_has_its_own_lifetime(tmp_path: Path) -> None:
    looks = table(tmp_path, classes=True)
    config = PersistConfig(prior=PRIOR, class_priors={"wall": "0.5*never-leaves+0.5*uniform:limit=1h"})
    result = run_persist(looks, config)
    for row in range(0, len(looks), 7):
        prior = config.class_priors["wall"] if looks.feature[row] % 2 == 0 else PRIOR
        expected = by_hand(looks, looks.feature[row], looks.stamp_s[row], prior)
        np.testing.assert_allclose(result.beliefs.p_exists[row], expected, rtol=1e-9)
    assert "class 'wall': 50 % of the features never leave, by the prior" in result.warnings
    last = result.forecasts.p_exists[:, -1]
    for feature in range(looks.n_features):
        prior = config.class_priors["wall"] if feature % 2 == 0 else PRIOR
        expected = by_hand(looks, feature, float(result.forecasts.stamp_s[-1]), prior)
        np.testing.assert_allclose(last[feature], expected, rtol=1e-9)


def test_a_grid_is_regular_and_causal(tmp_path: Path) -> None:
    looks = table(tmp_path)
    result = run_persist(looks, PersistConfig(prior=PRIOR, query="grid", step_s=100.0, horizon_s=300.0))
    start_s = looks.stamp_s.min()
    count = int((looks.stamp_s.max() - start_s) // 100.0) + 1
    np.testing.assert_array_equal(result.beliefs.stamp_s, np.tile(start_s + 100.0 * np.arange(count), 8))
    for k in range(0, len(result.beliefs), 5):
        expected = by_hand(looks, result.beliefs.feature[k], result.beliefs.stamp_s[k], PRIOR)
        np.testing.assert_allclose(result.beliefs.p_exists[k], expected, rtol=1e-9)
    np.testing.assert_allclose(result.forecasts.stamp_s, looks.span.last_look_s + np.array([0.0, 100.0, 200.0, 300.0]))


def test_forecasts_begin_at_the_latest_look_and_say_how_long_things_stay(tmp_path: Path) -> None:
    looks = table(tmp_path)
    result = run_persist(looks, PersistConfig(prior=PRIOR, horizon_s=600.0))
    assert result.forecasts.stamp_s[0] == looks.stamp_s[looks.looked].max()
    assert result.forecasts.stamp_s[-1] == pytest.approx(result.forecasts.stamp_s[0] + 600.0)
    for feature in range(looks.n_features):
        expected = [by_hand(looks, feature, t, PRIOR) for t in result.forecasts.stamp_s]
        np.testing.assert_allclose(result.forecasts.p_exists[feature], expected, rtol=1e-9)
    np.testing.assert_allclose(result.forecasts.median_stay_s, 300.0, rtol=1e-9)  # memoryless


def test_scores_are_those_of_the_rows_that_have_belief_and_truth(tmp_path: Path) -> None:
    looks = table(tmp_path)
    result = run_persist(looks, PersistConfig(prior=PRIOR))
    assert looks.present is not None
    both = ~np.isnan(result.beliefs.p_exists)
    assert result.scores == belief_scores(result.beliefs.p_exists[both], looks.present[both])
    assert result.reliability is not None
    assert result.reliability.count.sum() == both.sum()


def test_the_truth_is_never_seen_by_the_estimate(tmp_path: Path) -> None:
    looks = table(tmp_path)
    blind = run_persist(replace(looks, present=None), PersistConfig(prior=PRIOR))
    assert blind.scores is None
    assert blind.truth is None
    np.testing.assert_array_equal(
        blind.beliefs.p_exists, run_persist(looks, PersistConfig(prior=PRIOR)).beliefs.p_exists
    )


def test_permuting_the_rows_permutes_the_answer(tmp_path: Path) -> None:
    looks = table(tmp_path)
    distinct = np.unique(looks.stamp_s + 1e4 * looks.feature, return_index=True)[1]
    order = np.random.default_rng(0).permutation(distinct)
    columns = ("feature", "stamp_s", "detected", "p_miss", "p_false", "present", "line")

    def rows(which: np.ndarray) -> LookTable:
        return replace(looks, **{name: getattr(looks, name)[which] for name in columns})

    one, other = run_persist(rows(distinct)), run_persist(rows(order))
    where = {row: k for k, row in enumerate(distinct.tolist())}
    back = [where[row] for row in order.tolist()]
    np.testing.assert_array_equal(other.beliefs.p_exists, one.beliefs.p_exists[back])
    np.testing.assert_array_equal(other.changes.decided_s, one.changes.decided_s)


def test_a_model_from_a_file_lets_features_return(tmp_path: Path) -> None:
    looks = table(tmp_path)
    model = PhaseType.two_state(1 / 300, 1 / 200)
    path = save_models(NamedModels({"": model}), tmp_path / "model.json")
    result = run_persist(looks, PersistConfig(model=str(path)))
    for feature in range(looks.n_features):
        rows = np.flatnonzero(looks.feature == feature)
        rows = rows[np.argsort(looks.stamp_s[rows])]
        asked = Instants.same_for_all(1, looks.stamp_s[rows])
        expected = model.track(result.looks.of(feature), asked).p_present
        np.testing.assert_allclose(result.beliefs.p_exists[rows], expected, rtol=1e-12)
    assert np.isnan(result.forecasts.median_stay_s).all()


def test_a_run_length_model_says_when_to_expect_what(tmp_path: Path) -> None:
    looks = table(tmp_path)
    model = RunLength(Exponential(1 / 300), Exponential(1 / 200), 10.0)
    path = save_models(NamedModels({"": model}), tmp_path / "model.json")
    forecasts = run_persist(looks, PersistConfig(model=str(path))).forecasts
    np.testing.assert_allclose(forecasts.mean_stay_s, 300.0, rtol=0.02)  # memoryless, whatever the looks were
    np.testing.assert_allclose(forecasts.mean_absence_s, 200.0, rtol=0.02)


def test_learned_models_follow_their_class(tmp_path: Path) -> None:
    looks = table(tmp_path, classes=True)
    result = run_persist(looks, PersistConfig(recurrent="two-state"))
    assert result.learned is not None
    assert result.learned.per == "class"
    assert result.models.names == ("cart", "wall")
    for number, name in enumerate(result.models.names):
        mine = np.flatnonzero(looks.class_of_feature == looks.class_names.index(name))
        np.testing.assert_array_equal(result.models.of_feature[mine], number)
        part, rows = result.looks.at(mine)
        expected = result.models.models[number].track(part, Instants.of_looks(part)).p_present
        np.testing.assert_allclose(result.p_at_looks[rows], expected, rtol=1e-12)
    assert not np.isnan(result.beliefs.p_exists).any()  # what comes back has no birth


def test_looks_that_teach_nothing_are_an_error_about_the_file(tmp_path: Path) -> None:
    path = tmp_path / "looks.csv"
    path.write_text("stamp_s,feature_id,detected\n0,a,1\n0,b,0\n")
    with pytest.raises(DataError, match=r"looks\.csv: no feature has looks at two instants"):
        run_persist(read_looks(path), PersistConfig(recurrent="two-state", per="all"))


def test_an_impossible_look_is_named_with_feature_and_line(tmp_path: Path) -> None:
    path = tmp_path / "looks.csv"
    path.write_text("stamp_s,feature_id,detected,p_false\n0,box,1,0\n0,other,1,0.1\n90,box,1,0\n")
    looks = read_looks(path)
    message = r"looks\.csv:4: field 'detected': feature 'box' at 90 s: this observation is impossible"
    with pytest.raises(InputError, match=message):
        run_persist(looks, PersistConfig(prior="uniform:limit=1min"))
    path.write_text("stamp_s,feature_id,detected,p_miss,p_false\n0,a,0,0,0.5\n0,b,0,0,1\n")
    save_models(NamedModels({"": PhaseType.two_state(0.1, 0.1)}), tmp_path / "m.json")
    with pytest.raises(InputError, match=r"looks\.csv:3: field 'p_miss': 0 and p_false 1 make 1 or more"):
        run_persist(read_looks(path), PersistConfig(model=str(tmp_path / "m.json")))


def test_features_that_come_back_under_one_stay_are_remarked_on(tmp_path: Path) -> None:
    path = tmp_path / "looks.csv"
    pattern = [1] * 5 + [0] * 5 + [1] * 20
    rows = "".join(f"{10 * k},x,{hit}\n" for k, hit in enumerate(pattern))
    path.write_text("stamp_s,feature_id,detected\n" + rows)
    result = run_persist(read_looks(path))
    np.testing.assert_array_equal(result.changes.returned, [False, True])
    assert "1 feature returned, which lifetimes of one stay rule out: try `recurrent`" in result.warnings


def test_models_by_class_answer_for_a_part_of_the_features() -> None:
    models = ModelOfEach(
        (OneStay.of_text(PRIOR), PhaseType.two_state(0.01, 0.02)), ("", "door"), np.array([0, 1, 0, 1])
    )
    part = models.only(np.array([3, 2]))
    np.testing.assert_array_equal(part.of_feature, [1, 0])
    assert [model["kind"] for model in models.to_dict().values()] == ["one-stay", "phase-type"]


@pytest.mark.parametrize("most", [100, 57, 20, 3])
def test_learning_takes_whole_features_or_the_latest_looks_of_one(tmp_path: Path, most: int) -> None:
    looks = run_persist(table(tmp_path)).looks
    every = np.arange(looks.n_features)
    np.testing.assert_array_equal(some_looks(looks, every, len(looks.stamp_s))[1], np.arange(len(looks.stamp_s)))
    part, rows = some_looks(looks, every, most)
    np.testing.assert_array_equal(part.stamp_s, looks.stamp_s[rows])
    assert 0 < len(part.stamp_s) <= most
    whole = [looks.of(feature).stamp_s.tolist() for feature in range(looks.n_features)]
    for feature in range(part.n_features):
        mine = part.of(feature).stamp_s.tolist()
        if len(mine) == most:
            assert any(stamps[-most:] == mine for stamps in whole)
        else:
            assert mine in whole


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"query": "rows"}, "field 'query': input should be 'times' or 'grid', not 'rows'"),
        ({"step_s": 0.0}, "field 'step_s': input should be greater than 0"),
        ({"horizon_s": -1.0}, "field 'horizon_s': input should be greater than 0"),
        ({"confidence": 0.5}, "field 'confidence': input should be greater than 0.5"),
        ({"prior": "exponential:half-lif=2d"}, r"field 'prior': .*half-lif.*\(try: half-life\)"),
        ({"prior": "hazard:0s=-1/d"}, "field 'prior': .*not negative"),
        ({"class_priors": {"door": PRIOR}}, "field 'class_priors': no feature is of class 'door'"),
        ({"recurrent": "sometimes"}, "field 'recurrent': unknown kind of model 'sometimes'"),
        ({"recurrent": "two-state", "model": "m.json"}, "field 'recurrent': a model from a file is not learned"),
        ({"recurrent": "two-state", "per": "row"}, "field 'per': input should be .* not 'row'"),
        ({"learn_from": 1}, "field 'learn_from': input should be greater than or equal to 2, not 1"),
        ({"model": "/no/such.json"}, "cannot be read"),
        ({"query": "grid", "step_s": 1e-7}, "field 'step_s': .* instants of 8 features"),
        ({"horizon_s": 1e9, "step_s": 1.0}, "field 'horizon_s'"),
    ],
)
def test_choices_that_cannot_be_are_named(tmp_path: Path, config: dict[str, object], message: str) -> None:
    with pytest.raises(EvermapError, match=message):
        run_persist(table(tmp_path), PersistConfig(**config))  # type: ignore[arg-type]


def test_priors_by_class_are_told_from_priors() -> None:
    texts = ["exponential:half-life=2d", "door = 0.5*uniform:limit=1d + 0.5*never-leaves", "big box=never-leaves"]
    common, by_class = priors_by_class(texts)
    assert common == texts[0]
    assert by_class == {"door": "0.5*uniform:limit=1d + 0.5*never-leaves", "big box": "never-leaves"}
    assert priors_by_class(["0.3*exponential:half-life=1h+0.7*never-leaves"])[1] is None
    assert priors_by_class([]) == (None, None)
    for twice in (["never-leaves", PRIOR], ["a=never-leaves", "a=never-leaves"]):
        with pytest.raises(ConfigError, match="given twice"):
            priors_by_class(twice)


def test_nice_steps() -> None:
    assert [nice_step(s) for s in (0.9, 1.0, 1.1, 4.9, 5.5, 432.0, 0.0)] == [1.0, 1.0, 2.0, 5.0, 10.0, 500.0, 1.0]


def test_looks_that_make_beliefs_wrong_are_told(tmp_path: Path) -> None:
    def remarks(rows: str) -> str:
        path = tmp_path / "looks.csv"
        path.write_text(f"stamp_s,feature_id,detected\n{rows}")
        return " ".join(run_persist(read_looks(path)).warnings)

    assert "none of 4 looks is a miss" in remarks("0,a,1\n0,b,1\n9,a,1\n9,b,1\n")
    assert "none of 3 looks is a detection" in remarks("0,a,0\n5,a,0\n9,a,0\n")
    odd = remarks("0,a,1\n0,a,1\n5,a,1\n5,a,0\n5,b,1\n9,b,0\n")
    assert "1 look that repeat another" in odd
    assert "1 look that contradict another" in odd
    assert remarks("0,a,1\n5,a,0\n9,a,1\n") == ""


@pytest.mark.parametrize("rates", [(0.6, 0.6), (0.5, 0.5), (1.0, 0.0)])
def test_an_inverted_detector_is_refused_by_file_option_and_array(tmp_path: Path, rates: tuple[float, float]) -> None:
    path = tmp_path / "looks.csv"
    path.write_text("stamp_s,feature_id,detected\n0,a,1\n5,a,1\n")
    with pytest.raises(ConfigError, match=r"'p_miss': .* make 1 or more"):
        read_looks(path, p_miss=rates[0], p_false=rates[1])
    table = read_looks(path)
    with pytest.raises(InputError, match="make 1 or more"):
        replace(table, p_miss=np.full(2, rates[0]), p_false=np.full(2, rates[1]))
    path.write_text(f"stamp_s,feature_id,detected,p_miss,p_false\n0,a,1,.1,.1\n5,a,1,{rates[0]},{rates[1]}\n")
    with pytest.raises(InputError, match=r"looks\.csv:3: field 'p_miss': .* make 1 or more"):
        read_looks(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stamp_s": np.array([0.0, np.nan])}, "'stamp_s': nan where a finite number"),
        ({"stamp_s": np.array([0.0, 1e12])}, "'stamp_s'.*milli"),
        ({"detected": np.array([1.0, 2.0])}, "'detected': is neither 1 nor 0"),
        ({"detected": np.ones(3)}, "'detected': shape"),
        ({"p_miss": np.array([0.1, -0.1])}, "'p_miss': -0.1 is outside"),
        ({"feature": np.array([0, 7])}, "'feature': there is no such feature"),
        ({"class_of_feature": np.zeros(3, dtype=np.int64)}, "'class_of_feature'"),
    ],
)
def test_a_table_made_in_python_is_held_to_the_same(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    path = tmp_path / "looks.csv"
    path.write_text("stamp_s,feature_id,detected\n0,a,1\n5,a,1\n")
    with pytest.raises(InputError, match=message):
        replace(read_looks(path), **change)


@pytest.mark.parametrize("kind", ["two-state", "phase-type", "run-length", "run-length-rhythm", "auto"])
def test_a_stray_stamp_is_refused_before_it_costs_gigabytes(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "looks.csv"
    rows = "".join(f"{stamp},{name},{stamp % 3 % 2}\n" for name in "ab" for stamp in [*range(600), 9_000_000_000])
    path.write_text(f"stamp_s,feature_id,detected\n{rows}")
    with pytest.raises(DataError, match=r"steps of .* lie between the looks, the longest pause is 9e"):
        run_persist(read_looks(path), PersistConfig(recurrent=kind))
