"""The rules of the competition by themselves: who wins, who is tried, what must be explained, what a state costs."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from evermap import run_slam
from evermap.config import Config, SlamConfig
from evermap.explain import competition, screens, seeds, triggers
from evermap.explain.answer import list_causes, weigh_changes
from evermap.explain.causes import list_suspects
from evermap.explain.causes.sizes import suspect_bias_of_one
from evermap.explain.causes.suspect import Inputs, Suspect
from evermap.explain.evidence import Score, weigh_levels
from evermap.explain.screens import FAR
from evermap.explain.trial import (
    Asked,
    SessionSolution,
    Taken,
    Trial,
    _state_evidence,
    _with_last,
    weigh_solution,
    with_information,
)
from evermap.maps.sessions import solve
from evermap.types import Cause, ChangeKind, MapChange

from .worlds import World


def suspect(code: str = "tag-size", subject: str = "5", sigma: float = 0.3, p: float = 0.01) -> Suspect:
    return Suspect(code, subject, p, lambda inputs, _: inputs, str, str, sigma, lambda state: state)


def trial(evidence: float, *taken: Taken, noise: float = 1.0, worth: float = 1.0, result: object = None) -> Trial[Any]:
    return Trial(cast("Any", SimpleNamespace(result=result, inputs=None)), taken, evidence, worth, noise)


def test_a_solution_that_ignores_a_sensor_loses_to_one_that_hears_it() -> None:
    deaf, hears = trial(1000.0, noise=12.0), trial(0.0, noise=2.0)
    assert hears.beats(deaf) > 0.0 > deaf.beats(hears)
    assert trial(1000.0, noise=8.0).beats(hears) > 0.0  # loud, but heard
    assert deaf.beats(trial(0.0, noise=4.0)) > 0.0  # neither is as stated


def test_what_is_not_new_counts_less_but_prices_count_whole() -> None:
    one = Taken(suspect(p=0.01), 0.0)
    price = one.suspect.log_p
    assert price < 0.0
    with_cause, without = trial(50.0 + price, one, worth=0.5), trial(0.0, worth=0.2)
    assert with_cause.beats(without) == pytest.approx(0.2 * 50.0 + price)
    own = replace(without, evidence=-4.0, log_scales=-4.0)  # a scale that it found by itself
    assert with_cause.beats(own) == pytest.approx(0.2 * 50.0 + price + 4.0)


def test_two_of_a_kind_are_tried_and_none_twice() -> None:
    ranked = [(9.0 - row, suspect(subject=str(row)), 0.1) for row in range(4)]
    ranked += [(1.0, suspect("mount", "x"), 0.2), (0.5, suspect("clock", "camera"), 0.3)]
    tried = {("tag-size", "1")}
    found = competition._diverse(ranked, 3, tried)
    assert [(one.code, one.subject) for one, _ in found] == [("tag-size", "0"), ("tag-size", "2"), ("mount", "x")]
    assert ("mount", "x") in tried
    assert ("clock", "camera") not in tried


@pytest.mark.parametrize(
    ("before", "after", "changed", "rejected", "unexplained", "relieves"),
    [
        (("changes", "map"), ("changes",), (3, 3), (0.2, 0.2), (9.0, 9.0), True),
        (("changes",), ("changes",), (3, 2), (0.2, 0.2), (9.0, 9.0), True),
        (("changes",), ("changes",), (3, 3), (0.2, 0.1), (9.0, 9.0), True),
        (("changes",), ("changes",), (3, 3), (0.2, 0.2), (9.0, 5.0), True),
        (("changes",), ("changes",), (3, 3), (0.2, 0.15), (9.0, 8.0), False),
        (
            ("innovations",),
            ("innovations",),
            (3, 3),
            (0.2, 0.2),
            (9.0, 0.0),
            False,
        ),  # more was asked
        (("changes", "map"), ("range_noise_factor",), (3, 0), (0.2, 0.0), (9.0, 0.0), False),  # all fits it
        (("sigma_corner_px", "map"), ("sigma_corner_px",), (3, 3), (0.2, 0.2), (9.0, 9.0), True),
    ],
)
def test_a_cause_must_explain_something_that_was_asked(
    before: tuple[str, ...],
    after: tuple[str, ...],
    changed: tuple[int, int],
    rejected: tuple[float, float],
    unexplained: tuple[float, float],
    relieves: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    best, now = trial(0.0, result=0), trial(1.0, result=1)
    monkeypatch.setattr(competition, "find_symptoms", lambda result, *_: (before, after)[result])
    monkeypatch.setattr(competition, "count_changed", lambda result: changed[result])
    monkeypatch.setattr(competition, "share_rejected", lambda result: rejected[result])
    monkeypatch.setattr("evermap.explain.trial.find_score", lambda solution: unexplained[solution.result])
    monkeypatch.setattr(competition, "contradicts_odometry", lambda result, _: False)
    assert competition._relieves(now, best, SlamConfig()) is relieves


@pytest.mark.parametrize(
    ("before", "after", "relieves"), [(True, False, True), (True, True, False), (False, False, False)]
)
def test_a_cause_relieves_that_makes_a_solution_agree_with_its_odometry(
    before: bool, after: bool, relieves: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though as many landmarks seem to have moved."""
    best, now = trial(0.0, result=0), trial(1.0, result=1)
    monkeypatch.setattr(competition, "find_symptoms", lambda *_: ("changes", "map"))
    monkeypatch.setattr(competition, "count_changed", lambda _: 3)
    monkeypatch.setattr(competition, "share_rejected", lambda _: 0.2)
    monkeypatch.setattr(competition, "contradicts_odometry", lambda result, _: (before, after)[result])
    assert competition._relieves(now, best, SlamConfig()) is relieves


def test_a_state_costs_how_unusual_it_is_and_how_well_it_is_known() -> None:
    one = suspect(sigma=0.3)
    unknown, usual = (_state_evidence(Taken(one, state)) for state in (0.6, 0.0))
    assert usual == pytest.approx(one.log_p)
    assert unknown == pytest.approx(one.log_p - 2.0)
    known = _state_evidence(Taken(one, 0.6, 100.0 / 0.3**2))
    assert known == pytest.approx(unknown - math.log(10.0))
    before = trial(7.0, Taken(one, 0.6))
    after = _with_last(before, Taken(one, 0.6, 100.0 / 0.3**2))
    assert after.evidence == pytest.approx(7.0 - math.log(10.0))


def test_a_cause_names_what_explains_the_same_without_it() -> None:
    nothing = SimpleNamespace(parameters=())
    size, wheels = (Taken(suspect(code, code), 0.05) for code in ("tag-size", "odometry-scale"))
    base, best = trial(-50.0, result=nothing), trial(0.0, size, result=nothing)
    other, both = trial(-1.0, wheels, result=nothing), trial(-0.5, size, wheels, result=nothing)
    (found,) = list_causes(best, [base, best, other], base)
    assert found.probability == pytest.approx(1.0 / (1.0 + math.exp(-1.0)))
    assert found.instead == str(wheels.state)
    assert other.beats(best) == pytest.approx(-1.0)  # the same price
    assert list_causes(best, [base, best], base)[0].instead == ""  # nothing is off
    assert list_causes(best, [best, both], None)[0].instead == ""
    by_code = {one.code: one.instead for one in list_causes(both, [base, best, other, both], base)}
    assert by_code == {"tag-size": str(wheels.state), "odometry-scale": str(size.state)}


def test_causes_that_were_found_in_another_order_are_one_explanation() -> None:
    nothing = SimpleNamespace(parameters=())
    size, wheels, late = (Taken(suspect(code, code), 0.05) for code in ("tag-size", "odometry-scale", "clock"))
    base, best = trial(-50.0, result=nothing), trial(0.0, size, wheels, result=nothing)
    again, other = trial(-0.5, wheels, size, result=nothing), trial(-1.0, size, late, result=nothing)
    first, *_ = list_causes(best, [base, again, best, other], base)
    by_code = {one.code: one.probability for one in list_causes(best, [base, again, best, other], base)}
    assert (first.code, first.probability) == ("tag-size", pytest.approx(1.0))
    assert by_code["odometry-scale"] == pytest.approx(1.0 / (1.0 + math.exp(-1.0)))


def test_scales_that_a_solution_found_by_itself_are_causes_of_it() -> None:
    """What undoes them is the same explanation, and counts once; what explains the same as well is another one."""
    nothing = SimpleNamespace(parameters=())
    ranges, of_map = (Taken(suspect(code, subject), 0.05) for code, subject in (("range-scale", "sensor"), ("map", "")))
    base, undone = trial(0.0, result=nothing), trial(-1.0, ranges, result=nothing)
    other = trial(-0.5, of_map, result=nothing)
    own = Cause("range-scale", "sensor", "ranges are long", 1.05, 0.01, 0.999)
    found_own = {id(base): [own]}

    def list_of(best: Trial[Any], weighed: list[Trial[Any]]) -> tuple[Cause, ...]:
        return list_causes(best, weighed, base, lambda one: found_own.get(id(one), []))

    (cause,) = list_of(base, [base, undone, other])
    expected = 1.0 / (1.0 + math.exp(other.beats(base)))
    assert ranges.suspect.log_p == of_map.suspect.log_p
    assert cause.probability == pytest.approx(expected)
    assert list_of(base, [base, other])[0].probability == pytest.approx(expected)
    assert (cause.code, cause.instead) == ("range-scale", str(of_map.state))
    (cause,) = list_of(other, [base, other])
    assert (cause.code, cause.instead) == ("map", "ranges are long")
    assert list_of(base, [base])[0].probability == 0.999  # by itself it is no surer than the state
    found_own[id(undone)] = [own]
    assert [one.message for one in list_of(undone, [base, undone])] == [str(ranges.state)]  # once


@pytest.mark.parametrize(
    ("own", "code", "gain", "wins"),
    [
        ((), "map-scale", 5.0, False),  # what is as stated is not left for so little
        ((), "map-scale", 7.0, True),
        (("range-scale",), "map-scale", 0.5, True),  # there is a cause either way
        (("range-scale",), "map-scale", -0.5, False),
        (("range-scale",), "range-scale", 5.0, False),  # the same one
    ],
)
def test_a_cause_that_a_solution_has_is_left_for_one_that_is_likelier(
    own: tuple[str, ...], code: str, gain: float, wins: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`lead_nats` are for what is as stated: of two causes both have paid."""
    asked, base = suspect(code, sigma=0.0), trial(0.0)
    tried = trial(gain, Taken(asked, 0.0))
    monkeypatch.setattr(competition, "_find_own", lambda *_: [SimpleNamespace(code=one) for one in own])
    monkeypatch.setattr(competition, "list_suspects", lambda _: [asked])
    monkeypatch.setattr(competition, "_is_metre_known", lambda _: True)
    monkeypatch.setattr(competition, "_rank", lambda *_: [[(gain, asked, 0.0)]])
    monkeypatch.setattr(competition, "solve_trial", lambda *_: tried)
    monkeypatch.setattr(competition, "_relieves", lambda *_: True)
    monkeypatch.setattr(competition, "find_symptoms", lambda *_: ())
    anything = cast("Any", None)
    found = competition._next_cause(base, anything, anything, SlamConfig(), anything, [base], ())
    assert (found is tried) is wins


def test_where_the_distance_of_one_is_odd_sizes_of_some_are_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    every = [suspect("odometry-scale"), replace(suspect(subject="5"), rows=("id", "5")), suspect(subject="all tags")]
    monkeypatch.setattr(screens, "_by_seeds", lambda _, __, asked, ___: [(math.inf, one, 0.1) for one in asked])
    monkeypatch.setattr(screens, "screen_pairs", lambda *_: [])
    anything = cast("Any", None)
    found = screens.screen_plain(anything, anything, every, SlamConfig(), of_some=True)
    assert [one for _, one, _ in found] == [every[1]]
    assert len(screens.screen_plain(anything, anything, every, SlamConfig())) == 3


def test_every_state_pays_for_how_well_it_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """That of a trial that lost, too, which is refined no further."""
    one = suspect(sigma=0.3)
    asked = trial(7.0, Taken(one, 0.6))
    monkeypatch.setattr("evermap.explain.trial._find_step", lambda *_: Score(0.2, 100.0 / 0.3**2, 1.0))
    found = with_information(asked, cast("Any", None))
    assert found.evidence == pytest.approx(7.0 - math.log(10.0))
    assert (found.taken[-1].state, found.taken[-1].information) == (0.6, 100.0 / 0.3**2)
    assert with_information(found, cast("Any", None)) is found
    discrete = trial(7.0, Taken(suspect(sigma=0.0), 0.0))
    assert with_information(discrete, cast("Any", None)) is discrete
    monkeypatch.setattr("evermap.explain.trial._find_step", lambda *_: None)
    assert with_information(asked, cast("Any", None)) is asked


def ranked(plain: Asked, linear: Asked, *, best: Trial[Any] | None) -> list[list[str]]:
    """Names of what is asked, turn by turn."""
    turns = competition._rank(best, cast("Any", None), [], SlamConfig(), (lambda *_: plain, lambda *_: linear))
    return [[one.code for _, one, _ in turn] for turn in turns]


def test_the_cause_that_leads_is_solved_for_before_what_shows_without_a_solution() -> None:
    best, shows = trial(0.0), suspect("tag-size", "all")
    lens, mount = suspect("distortion", "camera"), suspect("mount", "x")
    plain, far = [(math.inf, shows, 0.1)], FAR * lens.sigma
    linear = [(100.0, lens, 0.2), (24.0, mount, 0.1)]
    assert ranked(plain, linear, best=best) == [["distortion"], ["tag-size"], ["distortion", "mount"]]
    assert ranked([], linear, best=best)[0] == ["distortion"]
    first = [[], ["tag-size"], ["distortion", "mount"]]
    assert ranked(plain, [(100.0, lens, 0.2), (26.0, mount, 0.1)], best=best) == first  # which may win
    assert ranked(plain, [(100.0, lens, far), (24.0, mount, 0.1)], best=best) == first  # no linear test reaches it
    assert ranked(plain, [(20.0, lens, 0.2)], best=best)[0] == []  # what gains less than is asked may win, too
    assert ranked(plain, [], best=best) == [[], ["tag-size"], []]
    # the state that shows is the better one
    assert ranked([(math.inf, lens, -0.1)], linear, best=best) == [[], ["distortion"], ["distortion", "mount"]]
    # what is discrete, or far off, is in no linear test; nor is anything without a solution
    as_before = [["tag-size"], ["distortion", "mount"]]
    assert ranked([(math.inf, shows, far)], linear, best=best) == as_before
    assert ranked([(math.inf, suspect("tag-size", "all", sigma=math.nan), 0.0)], linear, best=best) == as_before
    assert ranked(plain, linear, best=None) == as_before


@pytest.mark.parametrize(
    ("state", "symptoms"), [(0.06, ("distance of one",)), (-0.06, ("distance of one",)), (0.04, ())]
)
def test_directions_that_meet_elsewhere_than_ranges_say_are_a_symptom(
    state: float, symptoms: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = World(seed=1, seconds=10.0).plane()
    result, inputs = run_slam(recording), Inputs.of(recording, None)
    assert triggers.find_symptoms(result, inputs, Config().slam) == ()
    monkeypatch.setattr(triggers, "find_single_scales", lambda *_: {3: state, 4: 0.0})
    assert triggers.find_symptoms(result, inputs, Config().slam) == symptoms


@pytest.mark.parametrize(("other", "is_a_size"), [(1.0, True), (1.08, True), (1.4, False)])
def test_a_landmark_has_another_size_only_where_all_sides_say_the_same(other: float, is_a_size: bool) -> None:
    """Seen from two sides, at half of the true distance, and at `other` times that from the second."""
    angle = np.concatenate([np.linspace(0.0, 0.8, 8), np.linspace(2.0, 2.8, 8)])
    eye = 4.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    range_m = np.where(np.arange(16) < 8, 2.0, 2.0 * other)
    found = seeds._where_rays_meet(eye, -eye / 4.0, range_m)
    assert np.isfinite(found) == is_a_size
    if is_a_size:
        assert found == pytest.approx(np.log(2.0) - 0.5 * np.log(other), abs=0.05)


@pytest.mark.parametrize(("long_m", "is_significant"), [(0.8, True), (-0.5, True), (0.0, False)])
def test_what_ranges_are_too_long_by_is_fitted_with_the_place(long_m: float, is_significant: bool) -> None:
    """From a way of 10 m that a radio 6 m beside it sees; some readings are wrong."""
    along = np.linspace(-5.0, 5.0, 200)
    eye = np.column_stack([along, 0.5 * np.sin(along)])
    read_m = np.hypot(along - 1.0, eye[:, 1] - 6.0) + long_m + 0.02 * np.random.default_rng(3).normal(size=200)
    read_m[::20] += 3.0
    found = seeds._fit_bias(eye, read_m, np.array([0.5, 6.5]))
    assert np.isfinite(found) == is_significant
    if is_significant:
        assert found == pytest.approx(long_m, abs=0.1)


@pytest.mark.parametrize(("behind", "named"), [(-1.0, True), (0.5, True), (-4.0, False)])
def test_a_change_is_as_probable_as_a_cause_of_the_same_landmark_leaves_it(behind: float, named: bool) -> None:
    still = run_slam(World(seed=1, seconds=10.0).plane())
    nan = math.nan
    moves = tuple(MapChange((one,), ChangeKind.MOVED, nan, 0.0, (0.3, 0.4), 0.0, 0.95) for one in (6, 9))
    bias = Taken(suspect_bias_of_one("6", ("id", 6.0)), 0.4, 100.0)

    def trial_with(taken: tuple[Taken, ...], changes: tuple[MapChange, ...], evidence: float) -> Trial[Any]:
        asked = cast("Any", None)
        return Trial(SessionSolution(None, asked, replace(still, changes=changes)), taken, evidence, 1.0)

    base, rival = trial_with((), moves, 0.0), trial_with((bias,), moves[1:], behind)
    best, causes = weigh_changes(base, [base, rival], 0.1)
    share = 1.0 / (1.0 + math.exp(behind))
    assert [change.probability for change in best.solution.result.changes] == pytest.approx([0.95 * share, 0.95])
    assert [cause.probability for cause in causes] == ([pytest.approx(1.0 - share)] if named else [])
    assert all(cause.instead == "landmark 6 moved 0.50 m" for cause in causes)
    assert weigh_changes(rival, [base, rival], 0.1) == (rival, [])


def test_only_radios_have_a_bias_of_their_own() -> None:
    recording = World(seed=1, seconds=10.0).plane()
    assert not [one for one in list_suspects(Inputs.of(recording, None)) if one.code == "range-bias"]


@pytest.mark.parametrize("symptom", [triggers.SINGLE, triggers.CHANGES])
def test_what_is_of_all_has_other_symptoms_than_the_distance_of_one(
    symptom: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, base = list[bool](), trial(0.0, result=SimpleNamespace(landmarks=(), changes=()))

    def screen_plain(*_: object, of_some: bool, **__: object) -> Asked:
        asked.append(of_some)
        return []

    monkeypatch.setattr(competition, "screen_plain", screen_plain)
    monkeypatch.setattr(competition, "find_symptoms", lambda *_, **__: (symptom,))
    for name, found in (
        ("find_late_sensor", None), ("count_changed", 0), ("find_score", 0.0), ("weigh_solution", base),
        ("_solve_alone", None), ("_find_own", ()), ("list_suspects", ()), ("_is_metre_known", True),
        ("find_put_right", ()),
    ):  # fmt: skip
        monkeypatch.setattr(competition, name, lambda *_, found=found, **__: found)
    anything = cast("Any", None)
    assert competition.explain(anything, base.solution, anything, SlamConfig()) is not None
    assert asked == [symptom == triggers.SINGLE]


def test_evidence_is_that_at_levels_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    inputs, config = Inputs.of(World(seed=1, seconds=10.0).plane(), None), Config()
    solution = solve.explain_session(inputs, config, ()).best.solution
    asked = solution.asked
    before = weigh_solution(solution, ()).evidence
    gained = weigh_levels(asked.session)
    assert gained > 0.0
    monkeypatch.setattr("evermap.explain.trial.weigh_levels", lambda one: 7.0 if one is asked.session else math.nan)
    assert weigh_solution(solution, ()).evidence == pytest.approx(before - gained + 7.0)
