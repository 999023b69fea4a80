"""What is compared: switches of one engine, and an oracle that forgets."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from evermap.config import LivingConfig
from evermap.maps.living import LivingMap, Members, Places, Sites, Stays
from evermap_studies.demo.lifetimes import true_life
from evermap_studies.demo.methods import METHODS, method_named
from evermap_studies.demo.scenario import CLASSES


def test_methods_differ_in_their_switches_only() -> None:
    default = method_named("evermap").config()
    assert default.living == LivingConfig(accept="any")
    for method in METHODS:
        config = method.config()
        assert config.slam.explain.on == (method.name == "evermap"), "only evermap competes for causes"
        assert config.slam.model_copy(update={"explain": default.slam.explain}) == default.slam
        differs = {name for name in LivingConfig.model_fields if getattr(config.living, name) != getattr(
            default.living, name)}  # fmt: skip
        assert differs == {name for name, _ in method.switches}, "a switch that is the default says nothing"
    assert len({method.name for method in METHODS}) == len(METHODS)


def test_no_such_method() -> None:
    with pytest.raises(KeyError):
        method_named("magic")


def living() -> LivingMap:
    """Clique 0: landmarks 3 and 5 at sites 0 and 1; clique 1: landmark 7 at site 2."""
    off = np.zeros(3, dtype=np.bool_)
    places = Places(
        site_id=np.array([0, 0, 1, 1, 2]),
        landmark_id=np.array([3, 5, 3, 5, 7]),
        position_m=np.arange(10.0).reshape(5, 2),
        n_hits=np.arange(5),
        n_misses=np.zeros(5, dtype=np.int64),
    )
    factor = np.random.default_rng(1).normal(size=(10, 10))
    stays = Stays(np.array([0, 1, 0]), np.array([0, 2, 1]), np.zeros(3, np.int64), np.zeros((3, 2)), *np.zeros((5, 3)))
    return LivingMap(
        members=Members(np.array([3, 5, 7]), np.zeros(3, np.int64), np.array([0, 0, 1]), off, off),
        sites=Sites(np.arange(3), np.array([0, 0, 1]), *np.tile([0.2, 0.7, 0.9], (2, 1)), np.zeros(3), np.ones(3)),
        places=places,
        stays=stays,
        covariance_m2=factor @ factor.T,
        n_cliques_ever=2,
        n_sites_ever=3,
    )


def test_a_body_of_which_one_landmark_is_forgotten_stays() -> None:
    before = living()
    after = before.without(np.array([3, 99]))
    assert after.members.landmark_id.tolist() == [5, 7]
    assert list(zip(after.places.site_id.tolist(), after.places.landmark_id.tolist(), strict=True)) == [
        (0, 5), (1, 5), (2, 7)
    ]  # fmt: skip
    np.testing.assert_array_equal(after.places.position_m, before.places.position_m[[1, 3, 4]])
    kept = [2, 3, 6, 7, 8, 9]
    np.testing.assert_array_equal(after.covariance_m2, before.covariance_m2[np.ix_(kept, kept)])
    assert len(after.sites) == 3
    assert len(after.stays) == 3
    np.testing.assert_allclose(after.p_exists(), [0.9, 0.9])


def test_a_body_of_which_nothing_is_left_goes() -> None:
    after = living().without(np.array([5, 3]))
    assert after.members.landmark_id.tolist() == [7]
    assert after.sites.site_id.tolist() == [2]
    assert after.stays.clique_id.tolist() == [1]
    assert after.covariance_m2.shape == (2, 2)
    assert (after.n_cliques_ever, after.n_sites_ever) == (2, 3), "ids are never used twice"


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.name)
def test_true_lifetimes_are_what_the_simulation_draws(kind) -> None:
    life = true_life(kind, 2.0)
    if kind.stay is None:
        assert life is None
        return
    drawn = np.array([kind.stay.sample_s(np.random.default_rng(k)) for k in range(4000)]) / 2.0
    assert stats.kstest(drawn, lambda t: -np.expm1(life.log_survival(t))).pvalue > 1e-3
