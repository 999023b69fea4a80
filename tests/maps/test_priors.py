"""What users say of lifetimes: in the map, in what it learns, and out of it again as a file."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from random_maps import assert_same, random_map
from scipy import stats
from simulated_stays import DAY_S
from typer.testing import CliRunner

from evermap.cli.main import app
from evermap.errors import ConfigError, InputError
from evermap.existence.lifetimes import Lifetimes
from evermap.existence.models import NamedModels, lifetimes_of, priors_of, save_models
from evermap.existence.run_length import RunLength
from evermap.maps.learning import ClassLives, lifetimes_by_class, with_priors
from evermap.maps.lives import Life
from evermap.maps.living import LivingMap, Stays
from evermap.maps.store.content import Chunk, pack, unpack
from evermap.survival import (
    Exponential,
    LifetimePrior,
    LogNormal,
    Mixture,
    PiecewiseConstantHazard,
    Uniform,
    Weibull,
    gone_daily,
    never_leaves,
)
from evermap.types import UNKNOWN

WEIBULL = Weibull(3.0 * DAY_S, 1.5)
ENDLESS = never_leaves()


def told(**stays: object) -> dict[str, Lifetimes]:
    return {name: Lifetimes(prior, ENDLESS) for name, prior in stays.items()}


def stays_of(class_id: int, lasted_days: list[float], gone: bool = True) -> Stays:
    """Stays that were watched from beginning to end, one clique each."""
    count, last = len(lasted_days), 100.0 * DAY_S
    first = last - np.array(lasted_days) * DAY_S
    names = np.arange(count)
    return Stays(
        names, names, np.full(count, class_id), np.zeros((count, 2)), first - 60.0, first, np.full(count, last),
        np.full(count, last + 60.0 if gone else np.inf), np.full(count, float(gone)),
    )  # fmt: skip


def test_before_anything_is_learned_a_prior_holds_as_it_was_said() -> None:
    living = with_priors(LivingMap(), told(cart=WEIBULL), ["cart", "wall"], worth=20)
    assert living.class_names == ("cart", "wall")
    assert living.lives.of(0, np.zeros(2)).stay == WEIBULL
    assert living.lives.of(0).absence == Life().absence  # nothing was said of absences
    assert living.lives.of(1) == Life()
    everything = with_priors(living, {"": Lifetimes(Exponential.from_mean(DAY_S), Exponential.from_mean(9.0))}, [], 5)
    assert everything.lives.of(1).stay == Exponential.from_mean(DAY_S)
    assert everything.lives.of(UNKNOWN).absence == Exponential.from_mean(9.0)
    assert everything.lives.of(0).stay == WEIBULL
    again = with_priors(everything, told(cart=Exponential.from_mean(1.0)), [], 7)
    assert (again.lives.of(0).stay, again.lives.prior_of(0).n_stays) == (Exponential.from_mean(1.0), 7)


def test_an_unknown_class_is_named_with_the_likely_one() -> None:
    with pytest.raises(ConfigError, match=r"no landmark is of class 'crat'.*cart"):
        with_priors(LivingMap(class_names=("cart",)), told(crat=WEIBULL), ["wall"], 20)


@pytest.mark.parametrize("prior", [WEIBULL, Exponential.from_mean(10.0 * DAY_S), Weibull(0.2 * DAY_S, 0.8)])
def test_one_stay_that_goes_on_hardly_moves_a_prior_and_hundreds_do(prior) -> None:
    ages_s = prior.quantile(np.array([0.2, 0.5, 0.8]))
    living = with_priors(LivingMap(), told(cart=prior), ["cart"], worth=50)
    lives = replace(living.lives, looks_s=np.arange(1, 100) * DAY_S)
    one = ClassLives.of(stays_of(0, [0.01], gone=False), lives, 100.0 * DAY_S).lives.of(0)
    np.testing.assert_allclose(np.exp(one.stay.log_survival(ages_s)), [0.8, 0.5, 0.2], atol=0.07)
    assert (one.n_stays, one.n_ended) == (1, 0)
    days = stats.weibull_min.ppf((np.arange(250) + 0.5) / 250, 2.0, scale=20.0)
    many = ClassLives.of(stays_of(0, days.tolist()), lives, 100.0 * DAY_S + 60.0).lives.of(0)
    untold = replace(lives, prior=(), prior_class_id=np.zeros(0, np.int64))
    without = ClassLives.of(stays_of(0, days.tolist()), untold, 100.0 * DAY_S + 60.0).lives.of(0)
    at_s = 20.0 * DAY_S
    far = abs(np.exp(prior.log_survival(at_s)) - np.exp(without.stay.log_survival(at_s)))
    near = abs(np.exp(many.stay.log_survival(at_s)) - np.exp(without.stay.log_survival(at_s)))
    assert near < max(0.35 * far, 0.02)


STATED = {
    "steps": PiecewiseConstantHazard((0.0, 2.0 * DAY_S), (0.0, 10.0 / DAY_S)),
    "mixture": Mixture.of([Exponential.from_mean(3600.0), Exponential.from_mean(30.0 * DAY_S)], [0.5, 0.5]),
    "log-normal": LogNormal.from_half_life(5.0 * DAY_S, 2.0),
    "nights": gone_daily(0.3, first_seen_hour=10.0, hours=(20.0, 6.0)),
    "some stay": Mixture.of([WEIBULL, ENDLESS], [0.9, 0.1]),
}


@pytest.mark.parametrize("name", STATED)
def test_a_stated_hazard_comes_back_where_nothing_was_seen_that_could_change_it(name: str) -> None:
    """Whatever its form: a stay that has just begun says nothing of any age."""
    prior, ages_s = STATED[name], np.array([0.02, 0.3, 1.0, 1.9, 3.0, 20.0]) * DAY_S
    living = with_priors(LivingMap(), told(cart=prior), ["cart"], worth=20)
    lives = replace(living.lives, looks_s=np.arange(1, 100) * DAY_S)
    found = ClassLives.of(stays_of(0, [0.0], gone=False), lives, 100.0 * DAY_S).lives.of(0).stay
    np.testing.assert_allclose(np.exp(found.log_survival(ages_s)), np.exp(prior.log_survival(ages_s)), atol=1e-9)
    packed = unpacked(replace(living, lives=replace(lives, class_id=np.array([0]), chunk=np.zeros((1, 2), np.int64),
                                                    life=(Life(stay=found),))))  # fmt: skip
    assert packed.lives.life[0].stay == found


def test_what_was_stated_keeps_its_form_when_stays_are_seen() -> None:
    """Nothing leaves within two days, all soon after: stays that go on say nothing against it, and it stays a step."""
    living = with_priors(LivingMap(), told(cart=STATED["steps"]), ["cart"], worth=20)
    lives = replace(living.lives, looks_s=np.arange(1, 100) * DAY_S)
    found = ClassLives.of(stays_of(0, [1.0] * 10, gone=False), lives, 100.0 * DAY_S).lives.of(0).stay
    survival = np.exp(found.log_survival(np.array([1.0, 1.9, 3.0]) * DAY_S))
    np.testing.assert_allclose(survival[:2], 1.0, atol=1e-12)
    assert survival[2] < 0.01


def test_what_is_stated_never_to_leave_and_left_may_leave() -> None:
    """Twenty of which a user said so are gone after some ten days: the forecast is that of the band, not for ever."""
    living = with_priors(LivingMap(), told(cart=ENDLESS), ["cart"], worth=5)
    lives = replace(living.lives, looks_s=np.arange(1, 100) * DAY_S)
    found = ClassLives.of(stays_of(0, np.linspace(5.0, 15.0, 20).tolist()), lives, 100.0 * DAY_S + 60.0)
    ages_s = np.array([1.0, 5.0, 10.0, 20.0]) * DAY_S
    mean, _, upper = found.band(0, ages_s)
    forecast = np.exp(found.lives.of(0).stay.log_survival(ages_s))
    np.testing.assert_allclose(forecast, mean, atol=0.02)
    assert forecast[0] == pytest.approx(1.0, abs=1e-6)  # none was seen to leave so young
    assert upper[-1] < 0.6
    steps = with_priors(LivingMap(), told(cart=STATED["steps"]), ["cart"], worth=5).lives
    early = ClassLives.of(stays_of(0, [1.0] * 20), replace(steps, looks_s=lives.looks_s), 100.0 * DAY_S + 60.0)
    ages_s = np.array([0.5, 1.5, 1.9]) * DAY_S
    np.testing.assert_allclose(np.exp(early.lives.of(0).stay.log_survival(ages_s)), early.band(0, ages_s)[0], atol=0.02)
    assert early.band(0, ages_s)[0][1] < 0.5


@pytest.mark.parametrize("prior", [ENDLESS, Uniform(DAY_S)], ids=["never", "a day at most"])
def test_places_of_what_is_not_expected_to_end_have_no_rates_of_their_own(prior: LifetimePrior) -> None:
    """In two squares of the floor: no end is expected in either, or ends long ago; nothing is divided by that."""
    stays = stays_of(UNKNOWN, [5.0] * 12, gone=False)
    stays = replace(stays, position_m=np.where(np.arange(12)[:, None] % 2, [[50.0, 0.0]], [[0.0, 0.0]]))
    living = with_priors(LivingMap(), told(**{"": prior}), [], worth=20)
    lives = replace(living.lives, looks_s=np.arange(1, 100) * DAY_S)
    with np.errstate(divide="raise", invalid="raise"):
        found = ClassLives.of(stays, lives, 100.0 * DAY_S).lives
    assert len(found.life) == 1


def test_more_worth_holds_a_prior_longer() -> None:
    days = [20.0] * 10
    survival = []
    for worth in (2, 20, 200):
        living = with_priors(LivingMap(), told(cart=WEIBULL), ["cart"], worth)
        lives = replace(living.lives, looks_s=np.arange(1, 100) * DAY_S)
        stay = ClassLives.of(stays_of(0, days), lives, 100.0 * DAY_S + 60.0).lives.of(0).stay
        survival.append(float(np.exp(stay.log_survival(6.0 * DAY_S))))
    assert survival[0] > survival[1] > survival[2] > float(np.exp(WEIBULL.log_survival(6.0 * DAY_S)))


def unpacked(living: LivingMap) -> LivingMap:
    name, chunks = pack(living)
    return unpack(name, lambda names: {key: chunks[key].stored() for key in names})


def test_a_stored_map_keeps_what_was_said() -> None:
    living = random_map(3)
    mixed = Lifetimes(Mixture.of([WEIBULL, ENDLESS], [0.9, 0.1]), Exponential.from_mean(DAY_S))
    said = {"pallet": mixed, "": Lifetimes(WEIBULL, ENDLESS)}
    assert_same(unpacked(with_priors(living, said, [], 20)), with_priors(living, said, [], 20))
    _, chunks = pack(living)  # one of which nothing was said is written as it always was
    manifests = [chunk.raw for chunk in chunks.values() if isinstance(chunk, Chunk) and b'"columns"' in chunk.raw]
    assert not any(b"lives.prior" in raw for raw in manifests)


def test_texts_and_files_by_class(tmp_path: Path) -> None:
    models = NamedModels(
        {"cart": RunLength(WEIBULL, Exponential.from_mean(DAY_S), 60.0), "": RunLength(ENDLESS, ENDLESS, 60.0)}, "class"
    )
    file = save_models(models, tmp_path / "lifetimes.json")
    found = priors_of(str(file), {"door": "exponential:half-life=2d"})
    assert found["cart"] == Lifetimes(WEIBULL, Exponential.from_mean(DAY_S))
    assert found["door"].stay == Exponential.from_half_life(2.0 * DAY_S)
    assert found[""].stay == ENDLESS
    assert priors_of(None, {"wagon": str(file)})["wagon"].stay == ENDLESS
    only = save_models(NamedModels({"cart": RunLength(WEIBULL, ENDLESS, 60.0)}, "class"), tmp_path / "cart.json")
    with pytest.raises(InputError, match=r"has no lifetime of class 'crat'.*cart"):
        priors_of(None, {"crat": str(only)})


# --- from the command line ---


def run(*arguments: str | Path):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of two sessions, the first of them with what a user says of pallets and of all else."""
    from evermap.io import write_native
    from evermap_studies.sim import BuildingConfig, SimulatedSensor, simulate_building

    folder = tmp_path_factory.mktemp("priors")
    priors = ["--prior", "pallet=weibull:scale=3d,shape=1.5", "--prior", "unknown:1d..1y"]
    config = BuildingConfig(days=2, patrol_s=30.0, length_m=14.0, depth_m=13.0, rooms_per_side=1,
                            sensor=SimulatedSensor(range_slope=0.0, rate_hz=2.0))  # fmt: skip
    for day, recording in enumerate(simulate_building(config, seed=4).sessions):
        write_native(recording, folder / f"day{day}")
        result = run("map", "enter", folder / "site.evermap", folder / f"day{day}", "--out", folder / f"out{day}",
                     *([] if day else priors), "--set", "output.figures=false", "--set", "output.report=false",
                     "--set", "output.rerun=false", "--set", "slam.calibration.fix.range_slope=0.0")  # fmt: skip
        assert result.exit_code == 0, result.output
    return folder / "site.evermap"


def test_a_map_tells_what_it_was_told_and_gives_what_it_learned(site: Path, tmp_path: Path) -> None:
    from evermap.maps.store import open_store

    shown = json.loads(run("map", "show", site, "--json").stdout)["priors"]
    assert [(said["class"], said["worth_stays"]) for said in shown] == [("", 20), ("pallet", 20)]
    assert "lifetimes of class pallet start from weibull:" in run("map", "show", site).stdout
    file = tmp_path / "lifetimes.json"
    result = run("map", "export", site, "--lifetimes", file, "--json")
    assert result.exit_code == 0, result.output
    with open_store(site) as store:
        learned = lifetimes_by_class(store.load())
    assert json.loads(result.stdout)["classes"] == list(learned)
    assert lifetimes_of(file) == learned  # bit by bit
    assert set(learned) >= {"pallet", ""}

    fresh = with_priors(LivingMap(), priors_of(str(file)), list(learned), 20)
    for name, lifetimes in lifetimes_by_class(fresh).items():
        assert lifetimes.stay == learned[name].stay
        assert lifetimes.absence == learned[name].absence


@pytest.mark.parametrize(
    ("prior", "words"),
    [
        ("palet=never-leaves", ["no landmark is of class 'palet'", "pallet", "--prior"]),
        ("pallet=weibul:scale=3d", ["weibul", "weibull", "--prior"]),
        ("nowhere.json", ["nowhere.json"]),
    ],
)
def test_mistakes_are_one_line(site: Path, tmp_path: Path, prior: str, words: list[str]) -> None:
    result = run("map", "enter", tmp_path / "new.evermap", site.parent / "day1", "--out", tmp_path / "out", "--prior",
                 prior)  # fmt: skip
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    assert all(word in result.stderr for word in words), result.stderr


def test_a_file_may_tell_of_classes_that_the_site_has_not_yet(site: Path, tmp_path: Path) -> None:
    said = {name: RunLength(WEIBULL, ENDLESS, 60.0) for name in ("crane", "pallet", "")}
    file, new = save_models(NamedModels(said, "class"), tmp_path / "company.json"), tmp_path / "new.evermap"
    result = run("map", "enter", new, site.parent / "day0", "--out", tmp_path / "out", "--prior", file, "--set",
                 "output.figures=false", "--set", "output.report=false", "--set", "output.rerun=false")  # fmt: skip
    assert result.exit_code == 0, result.output
    shown = json.loads(run("map", "show", new, "--json").stdout)["priors"]
    assert {said["class"] for said in shown} == {"", "crane", "pallet"}


def test_a_prior_needs_a_map(tmp_path: Path) -> None:
    result = run("slam", tmp_path, "--prior", "never-leaves")
    assert result.exit_code == 2
    assert "evermap map enter MAP INPUT --prior" in result.stderr
