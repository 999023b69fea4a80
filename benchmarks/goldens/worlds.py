"""Parts in worlds made here, with fixed seeds: their truth is exact, and no recording is needed."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import evermap as em
from benchmarks.goldens.scores import Named, levels, longest_frame_ms, measured, scores

Part = Callable[[Path], Iterator[Named]]
SOLVERS = (
    ("evermap.estimate.sparse.system", "System", "factorised"),
    ("evermap.estimate.sparse.system", "System", "factorised"),
)
"""Where the method is that factorises a whole problem; the first that is there is counted."""
SIZES = (100, 400)
DEMO_SEEDS = (0, 1, 2)
"""One seed would decide by single objects: the statements on a shelf are four."""


@contextmanager
def counting_factorisations() -> Iterator[list[int]]:
    """Count the factorisations of whole problems by their unknowns; an empty list where the solver is not found."""
    sizes: list[int] = []
    for module, owner, method in SOLVERS:
        try:
            solver = getattr(import_module(module), owner)
            original = getattr(solver, method)
        except (ImportError, AttributeError):
            continue

        def counted(self: Any, *given: Any, original: Any = original, **named: Any) -> Any:
            sizes.append(int(self.tree.parent.size))
            return original(self, *given, **named)

        setattr(solver, method, counted)
        try:
            yield sizes
        finally:
            setattr(solver, method, original)
        return
    yield sizes


def warehouse(n_landmarks: int) -> Part:
    """Return the part of a drive through a warehouse: errors, calibration, cost beside gtsam's in one process."""

    def run(_: Path) -> Iterator[Named]:
        from benchmarks import scale
        from evermap_studies.peers.plain_gtsam import levenberg_marquardt

        scale.warm_up()
        drive = scale.warehouse_drive(n_landmarks)
        with measured() as first:
            result = em.run_slam(drive.recording)
        yield from scores(drive.recording, result)
        yield from levels(result, ("sigma_range_m", "sigma_bearing_rad"))
        with counting_factorisations() as sizes, measured() as second:
            em.run_slam(drive.recording)
        if sizes:  # those that are at least half as large as the largest
            yield "factorisations", sum(2 * size >= max(sizes) for size in sizes)
        cpu_s = min(first.cpu_s, second.cpu_s)
        yield "cpu_s", cpu_s
        yield "longest/frame_ms", longest_frame_ms(drive.recording)
        peers = (levenberg_marquardt(drive.factors, drive.starts["near"], marginals=False) for _ in range(3))
        yield "lm/over_peer", cpu_s / min(peer.solve.cpu_s for peer in peers)
        yield "session/cpu_s", scale.by_evermap_mapped(drive)["cpu_s"]
        if n_landmarks == SIZES[0]:  # the peer's optimum to many digits takes it long
            yield "plain/objective", scale.by_evermap_plain(drive)["objective"] / scale.best_objective(drive)

    return run


def rooms(_: Path) -> Iterator[Named]:
    """Three days in four rooms, two patrols a day into one living map, in the plane."""
    from evermap_studies.lifelong.runs import SIMULATED
    from evermap_studies.lifelong.world import simulated_world

    yield from _lived(simulated_world(3, 0), SIMULATED)


def mrclam6_changing(data: Path) -> Iterator[Named]:
    """The robots of a recording in turn into one living map, landmarks moved between them by a script."""
    from benchmarks.goldens.recordings import present
    from evermap_studies.lifelong.world import recorded_world

    yield from _lived(recorded_world(present(data / "mrclam"), 6, 0), ())


def _lived(world: Any, overrides: tuple[str, ...]) -> Iterator[Named]:
    from evermap_studies.lifelong.runs import WHOLE, live
    from evermap_studies.lifelong.scores import change_counts
    from evermap_studies.lifelong.table import existence, forecast, rms

    rows = list(live(world, (WHOLE,), overrides))
    stands, count = existence(rows), change_counts(rows)
    yield "position_m", rms(rows, "pose_rmse_m")
    yield "landmarks_m", rms(rows, "landmark_rmse_m")
    yield "precision/share", stands.precision
    yield "recall/share", stands.recall
    yield "brier/score", stands.brier
    yield "forecast/brier/score", forecast(rows).brier
    yield "right", count.n_right
    yield "false", count.n_found - count.n_right
    yield "missed", count.n_true - count.n_right
    yield "refused/missed", sum(not row["placed"] for row in rows)
    yield "cpu_s", sum(row["cpu_s"] for row in rows if row["cpu_s"] is not None)


def partial_views(_: Path) -> Iterator[Named]:
    """A robot that sees a part of a building on each of six patrols, and the same where nothing ever changes."""
    from evermap_studies.partial_views.study import Settings, live
    from evermap_studies.partial_views.table import summary

    settings = Settings(sessions=6)
    found = summary([live(settings, 1000, 60)])
    yield "landmarks_m", found["landmark_rmse_m"]
    yield "landmarks/nees", found["nees"]
    yield "right", found["told"] - found["false"]
    yield "false", found["false"]
    yield "recall/share", found["recall"]
    yield "precision/share", found["precision"]
    yield "reported/brier/score", found["brier"]
    yield "forecast/brier/score", found["forecast_brier"]
    yield "lost/missed", found["lost"]
    still = summary([live(replace(settings, change_rate=0.0), 1000, 60)])
    yield "still/false", still["false"]
    yield "still/landmarks_m", still["landmark_rmse_m"]


def building_in_space(_: Path) -> Iterator[Named]:
    """Five days of a building in space into one living map, one of them carried by hand."""
    from evermap_studies.building.study import live, story_of
    from evermap_studies.building.table import summary

    with measured() as spent:
        found = summary([live(story_of(0, 5), "evermap")[0]])
    yield "position_m", found["pose_m"]
    yield "landmarks_m", found["landmark_m"]
    yield "landmarks/nees", found["nees"]
    yield "right", found["told"] - found["false"]
    yield "false", found["false"]
    yield "recall/share", found["recall"]
    yield "off_m", found["displacement_m"]
    yield "brier/score", found["brier"]
    yield "log_loss/score", found["log_loss"]
    yield "forecast/brier/score", found["forecast_brier"]
    yield "lost/missed", found["lost"]
    yield "cpu_s", spent.cpu_s


def building_nameless(_: Path) -> Iterator[Named]:
    """One of these days without identities."""
    from benchmarks.association import _with_clock
    from benchmarks.goldens.recordings import _nameless
    from evermap_studies.building.study import story_of

    yield from _nameless(_with_clock(story_of(0, 2).patrols[0].recording))


def demo(_: Path) -> Iterator[Named]:
    """Four weeks of the demonstration's building, for three seeds, as evermap lives through them."""
    from evermap_studies.demo.claims import claim_numbers
    from evermap_studies.demo.methods import method_named
    from evermap_studies.demo.numbers import lines_of, ratios, week_of
    from evermap_studies.demo.scenario import Scenario
    from evermap_studies.demo.scores import Counts
    from evermap_studies.demo.study import run_study

    counts, told = list[Counts](), list[dict[str, Any]]()
    with measured() as spent:
        for seed in DEMO_SEEDS:
            study = run_study(Scenario(), seed, methods=(method_named("evermap"),))
            line = lines_of(study)["evermap"]
            counts += line.counts
            told.append(claim_numbers(line.claims, study.truth, week_of(study) >= 0))
    total = {key: sum(numbers[key] for numbers in told) for key in ("told", "false", "knowable", "recalled")}
    score = ratios(sum(counts[1:], counts[0]))
    yield "position_m", score["pose_rmse_m"]
    yield "precision/share", score["precision"]
    yield "recall/share", score["recall"]
    yield "brier/score", score["existence_brier"]
    yield "forecast/brier/score", score["forecast_brier"]
    yield "told/precision/share", 1.0 - total["false"] / total["told"]
    yield "told/recall/share", total["recalled"] / total["knowable"]
    yield "certain/false", sum(numbers["false_certain"] for numbers in told)
    yield "lost/missed", score["lost"]
    yield "cpu_s", spent.cpu_s


def template(*, in_space: bool) -> Part:
    """Return the part of the recording that `evermap init` writes, beside its own map where it has one."""

    def run(_: Path) -> Iterator[Named]:
        from evermap.io import write_template

        with tempfile.TemporaryDirectory() as folder:
            recording = em.read_recording(write_template(Path(folder) / "recording", in_space=in_space))
            result = em.run_slam(recording)
        yield from scores(recording, result)
        yield "landmarks/level", len(result.landmarks)

    return run


def session_path(_: Path) -> Iterator[Named]:
    """The code that a reader steps through when a second session enters a map."""
    from benchmarks.session_path import second_session

    with tempfile.TemporaryDirectory() as folder:
        path = second_session(Path(folder))
    for name, count in path.figures().items():
        yield f"{name}/count", count


def parts() -> dict[str, Part]:
    """Return all parts by name."""
    return {
        "template": template(in_space=False),
        "template_in_space": template(in_space=True),
        **{f"warehouse_{size}": warehouse(size) for size in SIZES},
        "session_path": session_path,
        "rooms": rooms,
        "demo": demo,
        "mrclam6_changing": mrclam6_changing,
        "partial_views": partial_views,
        "building_in_space": building_in_space,
        "building_nameless": building_nameless,
    }
