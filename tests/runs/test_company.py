"""`evermap learn`: lifetimes over the maps of many sites, whoever reads them."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.existence.lifetimes import Lifetimes
from evermap.existence.models import lifetimes_of
from evermap.maps.learning import ClassEvidence, ClassLives, with_priors
from evermap.maps.lives import Lives
from evermap.maps.living import LivingMap, Stays
from evermap.maps.store import Provenance, RevisionKind, open_store
from evermap.runs.company import Company
from evermap.survival import Exponential

DAY_S = 86_400.0
LOOKS_S = np.arange(1, 31) * DAY_S


def a_site(seed: int, classes: dict[str, float], count: int = 6) -> LivingMap:
    """A map of which only the stays are told, of exponential lifetimes with these means [days]."""
    rng = np.random.default_rng(seed)
    came = rng.uniform(1.0, 25.0, (len(classes), count))
    left = came + rng.exponential(size=came.shape) * np.array(list(classes.values()))[:, None]
    kind, first, after = (
        np.ravel(part)
        for part in (np.repeat(np.arange(len(classes)), count), np.ceil(came).ravel(), np.ceil(left).ravel())
    )
    seen = first < after
    kind, first, after = kind[seen], first[seen] * DAY_S, after[seen] * DAY_S
    gone = np.where(after <= LOOKS_S[-1], after, np.inf)
    names = np.arange(len(kind))
    stays = Stays(
        names, names, kind, np.zeros((len(kind), 2)), first - DAY_S, first, np.minimum(after, 31 * DAY_S) - DAY_S, gone,
        np.isfinite(gone).astype(float),
    )  # fmt: skip
    count = len(names)
    return LivingMap(
        stays=stays, lives=Lives(looks_s=LOOKS_S), class_names=tuple(classes), n_cliques_ever=count, n_sites_ever=count
    )


SITES = {
    "dock": {"cart": 2.0, "pallet": 10.0},
    "hall": {"pallet": 12.0, "cart": 1.0},
    "yard": {"cart": 3.0, "crane": 40.0},
}


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("company")
    for seed, (name, classes) in enumerate(SITES.items()):
        with open_store(folder / f"{name}.evermap", create=True) as store:
            store.commit(a_site(seed, classes), Provenance(RevisionKind.EDIT, source="simulated"), parent=store.head())
    return folder


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["learn", *map(str, arguments)])


def files(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*.json")
        if not path.name.startswith(".") and path.name != "summary.json"
    }


def test_classes_are_pooled_by_name_and_each_site_gets_a_file(maps: Path, tmp_path: Path) -> None:
    result = run(*sorted(maps.glob("*.evermap")), "--out", tmp_path / "out", "--workers", "1", "--json")
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert told["classes"]["pallet"]["sites"] == 2
    assert told["classes"]["crane"]["sites"] == 1
    assert told["classes"]["cart"]["stays"] == sum(of["cart"]["stays"] for of in told["sites"].values())
    assert set(files(tmp_path / "out")) == {"company.json", *(f"sites/{name}.json" for name in SITES)}
    assert set(told["outputs"]) >= set(files(tmp_path / "out"))
    company = lifetimes_of(tmp_path / "out" / "company.json")
    assert set(company) == {"cart", "crane", "pallet", ""}
    for name, here in SITES.items():
        own = lifetimes_of(tmp_path / "out" / "sites" / f"{name}.json")
        for kind in company.keys() - set(here):
            ages_s = np.array([1.0, 5.0, 20.0]) * DAY_S  # what a site has not, it has from the company
            np.testing.assert_allclose(own[kind].stay.log_survival(ages_s), company[kind].stay.log_survival(ages_s))


def test_a_site_lies_between_what_it_says_alone_and_what_the_company_says() -> None:
    sites = [a_site(seed, {"cart": 3.0}, count=12) for seed in range(8)] + [a_site(9, {"cart": 20.0}, count=4)]
    company = Company.of([ClassEvidence.of(living) for living in sites])
    alone = ClassLives.of(sites[-1].stays, sites[-1].lives).lives.of(0).stay
    halves = [
        prior.quantile(0.5) for prior in (company.lifetimes()["cart"].stay, company.lifetimes(8)["cart"].stay, alone)
    ]
    assert halves == sorted(halves)


def test_what_a_map_was_told_is_no_evidence() -> None:
    living = a_site(0, SITES["dock"])
    told = with_priors(living, {"cart": Lifetimes(Exponential.from_mean(DAY_S), Exponential.from_mean(DAY_S))}, [], 20)
    for name in ("stay", "absence"):
        np.testing.assert_array_equal(getattr(ClassEvidence.of(told), name), getattr(ClassEvidence.of(living), name))


@pytest.mark.slow
def test_a_store_of_maps_and_workers_give_the_same_bytes(maps: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    assert run("--store", maps, "--out", tmp_path / "one", "--workers", "1").exit_code == 0
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        result = run("--store", maps, "--out", tmp_path / "many", "--workers", cluster.scheduler_address)
        assert result.exit_code == 0, result.output
        (maps.parent / "damaged").mkdir()
        damaged = maps.parent / "damaged" / "gate.evermap"
        damaged.write_bytes(b"SQLite format 3\x00" + bytes(2000))
        result = run(*maps.glob("*.evermap"), damaged, "--out", tmp_path / "no", "--workers", cluster.scheduler_address)
        assert result.exit_code == 2
        assert result.stderr.count("\n") == 1
        assert "gate.evermap" in result.stderr
    assert files(tmp_path / "one") == files(tmp_path / "many")


def test_mistakes_are_one_line(maps: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    dock = maps / "dock.evermap"
    for words, arguments in {
        ("evermap[cluster]",): ("--store", maps, "--workers", "2"),
        ("evermap[cluster]", "Dask"): ("--store", maps, "--workers", "tcp://localhost:8786"),
        ("--workers", "1 to 1024"): ("--store", maps, "--workers", "1025"),
        ("'dock'", "MAP"): (dock, dock),
        ("'dock'", "--store"): (dock, "--store", maps),
        ("nowhere.evermap",): (dock, tmp_path / "nowhere.evermap"),
        ("no map", "--store"): ("--store", tmp_path),
        ("no map",): (),
        ("--store", "postgresql://"): ("--store", "postgresql://:::/"),
    }.items():
        result = run(*arguments, "--out", tmp_path / "out")
        assert result.exit_code == 2, result.output
        assert result.stderr.count("\n") == 1
        assert all(word in result.stderr for word in words), result.stderr
    assert run("--store", maps, "--out", tmp_path / "out").exit_code == 0  # by default one process will do
    with open_store(tmp_path / "new.evermap", create=True):
        pass
    result = run(tmp_path / "new.evermap", "--out", tmp_path / "out")
    assert (result.exit_code, "no map has a stay" in result.stderr) == (2, True)
