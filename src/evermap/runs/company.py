"""Work on all maps of a company, in this process or on a Dask cluster: `evermap learn`, `evermap map reenter`.

A class has a mean stay and a shape in the company, and its own at every site, about them; how far sites differ is
learned, too (`survival.class_lifetimes.SitesPosterior`). Of each map only the log likelihoods of its classes are
needed, some kilobytes. They are collected by as many processes as there are; what follows is computed in one, in the
order of the sites, so the result does not depend on the number of processes.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from evermap.config import LifetimeConfig
from evermap.errors import ConfigError, DataError, EvermapError, MissingExtraError
from evermap.existence.lifetimes import Lifetimes
from evermap.maps.learning import USUAL, ClassEvidence
from evermap.show import Shown
from evermap.survival.class_lifetimes import SitesPosterior
from evermap.types import FloatArray, Progress

if TYPE_CHECKING:
    from distributed import Client

    from evermap.config import Config
    from evermap.runs.reentry import Reentered


@dataclass(frozen=True, slots=True, eq=False)
class Company(Shown):
    """The lifetimes of the C classes of a company's sites.

    Attributes:
        class_names: of all sites, sorted; '' for landmarks without a class.
        stay: posterior of stays.
        absence: posterior of absences.
        sites: what the map of each says, in the order given.
    """

    class_names: tuple[str, ...]
    stay: SitesPosterior
    absence: SitesPosterior
    sites: tuple[ClassEvidence, ...]

    @classmethod
    def of(cls, sites: Sequence[ClassEvidence]) -> Self:
        """Learn from what the maps of all sites say.

        Raises:
            DataError: no map has a stay.
        """
        names = tuple(sorted({name for site in sites for name in site.class_names}))
        if not names:
            raise DataError("no map has a stay to learn from", hint="maps with sessions: evermap map enter MAP INPUT")
        stay, absence = (
            np.stack(parts) for parts in zip(*(_align_classes(site, names) for site in sites), strict=True)
        )
        return cls(names, SitesPosterior.of(stay), SitesPosterior.of(absence, improper=True), tuple(sites))

    def lifetimes(self, site: int | None = None) -> dict[str, Lifetimes]:
        """Return the lifetimes of all classes at a site, '' for a class that no site has; None for a new site."""
        of_stays, of_absences = (None, None) if site is None else _align_classes(self.sites[site], self.class_names)
        stay, absence = self.stay.site(of_stays), self.absence.site(of_absences)
        rows = {name: row for row, name in enumerate(self.class_names) if name}
        rows[""] = self.class_names.index("") if "" in self.class_names else -1
        return {name: Lifetimes(stay.curve(row), absence.curve(row)) for name, row in rows.items()}


def _align_classes(site: ClassEvidence, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    """Log likelihoods (C, M, A) of stays and of absences of these classes; 0 of those that a site has not."""
    rows = [names.index(name) for name in site.class_names]
    stay, absence = (np.zeros((len(names), *part.shape[1:])) for part in (site.stay, site.absence))
    stay[rows], absence[rows] = site.stay, site.absence
    return stay, absence


def collect(
    maps: Sequence[str],
    settings: LifetimeConfig = USUAL,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> list[ClassEvidence]:
    """Return the evidence of each of many maps (files or addresses) on its classes, in their order.

    How the work is spread is as of `spread_over`; workers of a cluster reach the maps under the same names.

    Raises:
        InputError: a map that is missing or damaged.
        MissingExtraError, ConfigError: as `spread_over`.
    """
    evidence = partial(_evidence, settings=settings)
    found = spread_over(maps, evidence, workers=workers, cluster=cluster, progress=progress)
    for site in found:
        if isinstance(site, EvermapError):
            raise site
    return found


def reenter_all(
    maps: Mapping[str, str],
    out: Path,
    config: Config | None = None,
    *,
    adopt: bool = False,
    workers: int | None = None,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> dict[str, Reentered | EvermapError]:
    """Enter all sessions of many maps, by the names of their sites, again (`sessions.reenter`); return the results.

    Copies, `SITE.evermap` in the folder `out`, are what an attempt that was stopped is continued from. How the work is
    spread is as of `spread_over`; workers of a cluster reach the maps and `out` under the same names.

    Raises:
        MissingExtraError, ConfigError: as `spread_over`; what is wrong with a map is its result.
    """
    works = {where: out / f"{site}.evermap" for site, where in maps.items()}
    again = partial(_again, works=works, config=config, adopt=adopt)
    found = spread_over(list(works), again, workers=workers, cluster=cluster, progress=progress)
    return dict(zip(maps, found, strict=True))


def spread_over(
    items: Sequence[str],
    apply: Callable[[str], Any],
    *,
    workers: int | None = None,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> list[Any]:
    """Return the results of a function for many names, in their order: here, in processes, or on a cluster.

    Args:
        items: the names.
        apply: the function; an `EvermapError` that it raises is its answer, as Dask would raise another.
        workers: processes on this machine, by Dask; 1 for this one alone. None: one for each core, if Dask is there.
        cluster: address of a Dask scheduler, as tcp://host:8786, in the place of processes here.
        progress: told after every one.

    Raises:
        MissingExtraError: workers or a cluster are asked for, and Dask is not installed.
        ConfigError: no scheduler answers, a worker dies, or has no evermap.
    """
    found: dict[int, Any] = {}
    with _spread(len(items), workers, cluster) as spread:
        for number, one in spread(partial(_apart, apply=apply), items):
            found[number] = one
            if progress:
                progress(len(found), len(items))
    return [found[number] for number in range(len(items))]


def _apart(item: str, apply: Callable[[str], Any]) -> Any:
    """With the same sums in every process; errors are results."""
    from threadpoolctl import threadpool_limits

    try:
        with threadpool_limits(limits=1, user_api="blas"):
            return apply(item)
    except EvermapError as error:
        return error


def _evidence(where: str, settings: LifetimeConfig) -> ClassEvidence:
    from evermap.maps.store import open_store

    with open_store(where) as store:
        return ClassEvidence.of(store.load(), settings)


def _again(where: str, works: Mapping[str, Path], config: Config | None, adopt: bool) -> Reentered:
    from evermap.runs.reentry import reenter

    return reenter(where, works[where], config, adopt=adopt)


_Spread = Callable[[Callable[[str], Any], Sequence[str]], Iterator[tuple[int, Any]]]


@contextmanager
def _spread(count: int, workers: int | None, cluster: str | None) -> Iterator[_Spread]:
    """Yield what applies a function to many: here, or on Dask."""
    if cluster is None and (workers == 1 or count < 2):
        yield _here
        return
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        if cluster is None and workers is None:
            yield _here
            return
        raise MissingExtraError("needs Dask, which is not installed", hint="pip install 'evermap[cluster]'") from None
    try:
        if cluster is None:
            count = min(workers or os.cpu_count() or 1, count)
            here = LocalCluster(n_workers=count, threads_per_worker=1, dashboard_address=None, silence_logs=50)
            with here, Client(here) as client:
                yield partial(_on_dask, client)
        else:
            with Client(cluster, timeout="10s") as client:
                yield partial(_on_dask, client)
    except (OSError, ValueError) as error:  # timeouts are of the first kind, addresses that are none of the second
        if cluster is None:
            raise
        problem = f"no Dask scheduler answers: {error}"
        raise ConfigError(problem, field="cluster", hint="tcp://HOST:8786, where `dask scheduler` runs") from error


def _here(apply: Callable[[str], Any], items: Sequence[str]) -> Iterator[tuple[int, Any]]:
    return ((number, apply(item)) for number, item in enumerate(items))


def _on_dask(client: Client, apply: Callable[[str], Any], items: Sequence[str]) -> Iterator[tuple[int, Any]]:
    from distributed import KilledWorker, as_completed

    futures = client.map(apply, items, pure=False)
    number_of = {future.key: number for number, future in enumerate(futures)}
    for future in as_completed(futures):
        number = number_of[future.key]
        try:
            yield number, future.result()
        except (KilledWorker, ModuleNotFoundError) as error:
            problem = f"a worker crashed, or has no evermap: {error}"
            hint = "more memory; the same evermap on all workers"
            raise ConfigError(problem, path=items[number], hint=hint) from error
        future.release()
