"""What is compiled before a job is all that the job calls: no frame waits for a kernel, no speed contains one."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from evermap.cli.main import app
from evermap.io import write_native
from evermap_studies.building.study import story_of
from evermap_studies.sim import BuildingConfig, simulate_building

pytestmark = pytest.mark.slow

WATCHED = """
import sys

from typer.testing import CliRunner

import evermap.runs.persist.run
import evermap.tracking.run
import evermap.slam.localize_recording
import evermap.cli.warmup
from evermap.cli.main import app

at_start = at_end = None


def ready():
    return {
        f"{name}.{key}{signature}"
        for name, module in list(sys.modules.items())
        for key, kernel in vars(module).items()
        if name.startswith("evermap") and hasattr(kernel, "overloads") and kernel.py_func.__module__ == name
        for signature in kernel.overloads
    }


def watched(module):
    warm_up = module.warm_up

    def watched_warm_up(**given):
        global at_start
        warm_up(**given)
        at_start = ready()

    module.warm_up = watched_warm_up


def all_frames(*given, **settings):
    global at_start, at_end
    at_start = ready()
    answer = fed(*given, **settings)
    at_end = ready()
    return answer


for module in (evermap.cli.warmup, evermap.runs.persist.run, evermap.tracking.run):
    watched(module)
fed, evermap.slam.localize_recording.fed = evermap.slam.localize_recording.fed, all_frames
result = CliRunner().invoke(app, sys.argv[1:], catch_exceptions=False)
assert result.exit_code == 0, result.stderr
assert at_start
print(*sorted((at_end or ready()) - at_start), sep="\\n")
"""


NAMELESS = ("--set", "unknown_ids=true")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sessions in a building, a map of the first, and the examples of the other verbs."""
    folder = tmp_path_factory.mktemp("jobs")
    building = simulate_building(BuildingConfig(days=2, patrol_s=60.0))
    for name, recording in zip(("one", "two"), building.sessions[:2], strict=True):
        write_native(recording, folder / name)
    for patrol, name in zip(story_of(0, 2).patrols, ("flight", "again"), strict=True):
        write_native(patrol.recording, folder / name)
    for command in (
        ("map", "enter", folder / "first.evermap", folder / "one", "--out", folder / "out"),
        (
            "map",
            "enter",
            folder / "space.evermap",
            folder / "flight",
            "--set",
            "unknown_ids=true",
            "--out",
            folder / "space",
        ),
        ("map", "enter", folder / "named.evermap", folder / "flight", "--out", folder / "named"),
        ("init", "detections", folder / "detections.csv"),
        ("init", "looks", folder / "looks.csv"),
    ):
        assert CliRunner().invoke(app, list(map(str, command))).exit_code == 0
    return folder


@pytest.mark.parametrize(
    "job",
    [
        "slam one",
        "slam one --unknown-ids",
        "map enter new.evermap one",
        "map enter nameless.evermap one --set unknown_ids=true",
        "map enter first.evermap two",
        "localize first.evermap two",
        "slam flight --unknown-ids",
        "map enter flights.evermap flight",
        "map enter named.evermap again",
        "map enter space.evermap again --set unknown_ids=true",
        "track detections.csv --range-m 12",
        "persist looks.csv",
    ],
)
def test_all_kernels_of_a_job_are_ready_when_it_begins(folder: Path, tmp_path: Path, job: str) -> None:
    """In a process of its own. What is loaded counts as what is compiled: it was, where this has never been run.

    Of localising, the frames are the job: before them the map is carried to their time, and read where it comes from.
    """
    command = [sys.executable, "-c", WATCHED, *job.split(), "--out", str(tmp_path / "out")]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not done.stdout.strip(), done.stdout


LARGE = """
from evermap.estimate.sparse import elimination, system
from evermap.slam.warmup import warm_up
import evermap as em
from evermap_studies.sim import simulate_warehouse

warm_up()
before = [kernel.signatures[:] for kernel in (elimination._gather, elimination._store)]
system.LARGE = 0.0  # every front is large
em.run_slam(simulate_warehouse(30))
assert before == [kernel.signatures for kernel in (elimination._gather, elimination._store)]
assert all(before)
"""


def test_no_frame_of_a_large_problem_waits_for_a_kernel() -> None:
    subprocess.run([sys.executable, "-c", LARGE], check=True)
