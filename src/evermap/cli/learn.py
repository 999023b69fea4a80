"""`evermap learn`: lifetimes learned over all maps of a company."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from evermap.cli.options import (
    DEFAULT_STORE,
    STORE_VARIABLE,
    AsJson,
    ConfigFile,
    Force,
    Settings,
    ShowConfig,
    Workers,
    argument,
    configure,
    database_errors,
    option,
    workers_of,
)
from evermap.cli.terminal import command_line, print_json, print_table, progress_bar, say
from evermap.errors import ConfigError

if TYPE_CHECKING:
    from evermap.existence.lifetimes import Lifetimes
    from evermap.runs.company import Company
    from evermap.runs.folder import RunFolder

HELP = """\
Learn lifetimes over the maps of many sites.

Each class has one lifetime for the company, and each site its own, drawn towards it: the more so the fewer stays the
site has, and the more alike the sites are. Both are learned from the histories of the maps, which are not changed.

\b
--out gets company.json, for sites without a map, and sites/NAME.json, for each site: files for --prior of
`evermap map enter`, and for `evermap persist --set model=FILE`.

\b
Examples:
  evermap learn maps/*.evermap --out lifetimes
  evermap learn --store postgresql://evermap@db/fleet --workers 4
  evermap learn --store maps --workers tcp://scheduler:8786
  evermap map enter maps/ward-3.evermap day9 --prior lifetimes/sites/ward-3.json
"""


Maps = Annotated[
    list[str] | None, argument("Files, or postgresql://user@host/database/SITE.", metavar="MAP", default=False)
]
Store = Annotated[
    str | None,
    option(
        "All maps of a server: folder, or postgresql://user@host/database.",
        metavar="WHERE",
        default=f"without MAP: ${STORE_VARIABLE}, else {DEFAULT_STORE}",
    ),
]


def learn(
    maps: Maps = None,
    store: Store = None,
    out: Annotated[Path, option("Folder for the lifetimes.")] = Path("evermap-out/lifetimes"),
    workers: Workers = None,
    force: Force = False,
    config: ConfigFile = None,
    settings: Settings = None,
    show_config: ShowConfig = False,
    as_json: AsJson = False,
) -> None:
    """Learn lifetimes over the maps of many sites."""
    chosen = configure(config, settings, within="living", show=show_config)
    from evermap.runs.company import Company, collect
    from evermap.runs.folder import RunFolder

    count, cluster = workers_of(workers)
    sites = sites_of(maps or [], store, cluster)
    files = [where for where in sites.values() if "://" not in where]
    with RunFolder(out, force=force, inputs=files) as folder:
        with progress_bar("reading maps", speed=False) as progress:
            found = collect(
                list(sites.values()), chosen.living.lifetimes, workers=count, cluster=cluster, progress=progress
            )
        settings_told = {"living": {"lifetimes": chosen.living.lifetimes.to_dict()}}
        told = {"command": command_line(), "input": ", ".join(sites), "config": settings_told}
        summary = folder.finish({**told, **_write_company(folder, Company.of(found), list(sites))})
    if as_json:
        print_json(summary)
        return
    _print(summary, out)


def sites_of(maps: list[str], store: str | None, cluster: str | None = None) -> dict[str, str]:
    """Return files and addresses of maps by the names of their sites; whole paths where a cluster reads them.

    Raises:
        ConfigError: no map, or two of one name.
    """
    found: dict[str, str] = {}
    for where in maps:
        name = where.rstrip("/").rpartition("/")[2] if "://" in where else Path(where).stem
        if name in found:
            raise ConfigError(f"two maps are named '{name}'", field="MAP", hint="rename one of the files")
        found[name] = where
    if not maps and store is None:
        store = os.environ.get(STORE_VARIABLE, DEFAULT_STORE)
    for name, where in [] if store is None else _store_model(store):
        if name in found:
            raise ConfigError(
                f"one of its sites is named '{name}', like a map", field="store", hint="leave out that map"
            )
        found[name] = where
    if not found:
        raise ConfigError("there is no map", path=store, hint="files of maps, or --store WHERE")
    if cluster is None:
        return found
    return {name: where if "://" in where else str(Path(where).absolute()) for name, where in found.items()}


def _store_model(store: str) -> list[tuple[str, str]]:
    from sqlalchemy.exc import ArgumentError

    from evermap.server.sites import SiteStores

    stores = SiteStores(store)
    try:
        with database_errors():
            return [(name, stores.address(name)) for name in stores.names()]
    except (ArgumentError, ValueError):
        hint = "postgresql://user@host/base"
        raise ConfigError("is not the address of a database", field="store", hint=hint) from None


def _write_company(folder: RunFolder, company: Company, names: list[str]) -> dict[str, Any]:
    """Write the files of a company and its sites; return the results for the summary."""
    from evermap.existence.models import save_lifetimes
    from evermap.types import json_number

    def half_gone_s(lifetimes: Lifetimes) -> float | None:
        return json_number(lifetimes.stay.quantile(0.5))

    general = company.lifetimes()
    save_lifetimes(general, folder.path("company.json"))
    own: dict[str, dict[str, Lifetimes]] = {}
    with progress_bar("learning", speed=False) as progress:
        for number, name in enumerate(names):
            own[name] = company.lifetimes(number)
            save_lifetimes(own[name], folder.path(f"sites/{name}.json"))
            if progress:
                progress(number + 1, len(names))
    sites = {
        site: {
            name: {"stays": n_stays, "stays_that_ended": n_ended, "half_gone_s": half_gone_s(lifetimes[name])}
            for name, n_stays, n_ended in zip(of.class_names, of.n_stays.tolist(), of.n_ended.tolist(), strict=True)
        }
        for of, (site, lifetimes) in zip(company.sites, own.items(), strict=True)
    }
    classes = {}
    for name, lifetimes in general.items():
        seen = [of[name] for of in sites.values() if name in of]
        counts = {key: sum(one[key] for one in seen) for key in ("stays", "stays_that_ended")}
        classes[name] = {"sites": len(seen), **counts, "half_gone_s": half_gone_s(lifetimes)}
    differ = float(math.exp(company.stay.p_pair @ company.stay.spreads[:, 0]))
    return {"classes": classes, "sites": sites, "factor_between_sites": differ}


def _print(summary: dict[str, Any], out: Path) -> None:
    """Print the results for people."""
    from evermap.survival.durations import duration_text

    rows = []
    for name, one in summary["classes"].items():
        half_gone_s = one["half_gone_s"]
        numbers = (one["sites"], one["stays"], one["stays_that_ended"])
        half = duration_text(math.inf if half_gone_s is None else half_gone_s)
        rows.append((name or "any other", *(f"{number:,}" for number in numbers), half))
    title = f"{len(summary['sites'])} sites, mean stays differ by a factor of {summary['factor_between_sites']:.1f}"
    print_table(title, rows, ("class", "sites", "stays", "ended", "half gone at a new site"), numbers=(1, 2, 3))
    say(f"written to {out}; use it with: evermap map enter MAP INPUT --prior {out}/sites/SITE.json")
