"""Where Ctrl-C may stop a program: never inside a callback of a compiler, never between two halves of an output."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from evermap import interrupts
from evermap.cli.warmup import warm_up
from evermap.config import Config, SlamConfig
from evermap.interrupts import held, temporary, watched
from evermap.pipeline import run_slam
from evermap.slam.batch import Batch, SolvedPart
from evermap.slam.problem import Problem
from evermap_studies.sim import BuildingConfig, simulate_building
from evermap_studies.workers import sheltered

INTERRUPT = "import os, signal; os.kill(os.getpid(), signal.SIGINT)"


@pytest.fixture(autouse=True)
def python_s_own_handler() -> Iterator[None]:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, before)


def interrupt() -> None:
    signal.raise_signal(signal.SIGINT)


def test_an_interrupt_of_the_warm_up_is_for_the_job(monkeypatch: pytest.MonkeyPatch) -> None:
    def parts(self: Batch, problem: Problem) -> Iterator[SolvedPart]:
        for part in whole(self, problem):
            assert interrupts._open["watched"]
            interrupt()
            yield part  # enough to end with

    whole = Batch.parts
    monkeypatch.setattr(Batch, "parts", parts)
    with pytest.raises(KeyboardInterrupt):
        warm_up.__wrapped__(search=False)


READING = """
import os, random, signal, sys, threading, time
from evermap import interrupts
from evermap.io.columns import read_columns

heard, done, lost = threading.Event(), threading.Event(), []
interrupts._leave = lambda number, frame: heard.set()
interrupts.leave_on_signals()

def ask():
    for _ in range(100):
        time.sleep(random.uniform(0.0, 0.004))
        heard.clear()
        os.kill(os.getpid(), signal.SIGINT)
        lost.append(not heard.wait(1.0))
    done.set()

threading.Thread(target=ask).start()
while not done.is_set():
    read_columns(sys.argv[1], [])
sys.exit(sum(lost))
"""


def test_an_interrupt_at_the_end_of_a_table_is_heard(tmp_path: Path) -> None:
    """Arrow has handlers of its own while it reads, which lose one in ten."""
    table = tmp_path / "table.csv"
    table.write_text("stamp_s,range_m\n" + "1.5,2.25\n" * 5_000)
    assert subprocess.run([sys.executable, "-c", READING, table], check=False).returncode == 0


def test_a_held_block_ends_before_it_is_interrupted() -> None:
    done = []

    def block() -> None:
        with held():
            interrupt()
            with held():
                interrupt()
            done.append("first half")
            done.append("second half")
        done.append("later")

    with pytest.raises(KeyboardInterrupt):
        block()
    assert done == ["first half", "second half"]


def test_a_held_block_that_nobody_interrupts_raises_nothing() -> None:
    with held(), held():
        pass


def test_a_watched_loop_stops_where_it_says() -> None:
    done = []

    def loop() -> None:
        with watched() as watch:
            for step in range(10):
                if step == 3:
                    interrupt()
                done.append(step)
                watch.stop_if_asked()

    with pytest.raises(KeyboardInterrupt):
        loop()
    assert done == [0, 1, 2, 3]


def test_the_second_interrupt_does_not_wait_and_a_late_one_is_not_lost() -> None:
    def impatient() -> None:
        with watched():
            interrupt()
            interrupt()
            raise AssertionError

    def late() -> None:
        with watched():
            interrupt()

    for block in (impatient, late):
        with pytest.raises(KeyboardInterrupt):
            block()


def test_who_sleeps_in_a_watched_loop_is_woken() -> None:
    timer = threading.Timer(0.2, os.kill, [os.getpid(), signal.SIGINT])
    timer.start()
    start = time.monotonic()

    def loop() -> None:
        with watched() as watch:
            watch.sleep(60.0)
            watch.stop_if_asked()

    with pytest.raises(KeyboardInterrupt):
        loop()
    assert time.monotonic() - start < 30.0


def test_other_threads_and_ignored_signals_are_left_alone() -> None:
    seen: list[object] = []

    def elsewhere() -> None:
        with held():
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert seen == [signal.default_int_handler]
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with held():
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
            interrupt()
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def test_an_estimate_can_be_interrupted_from_python_at_any_instant() -> None:
    """Whatever the interrupt hits, the frame it hits is finished, and what was done so far is a result: also where
    that frame is the last.
    """
    recording = simulate_building(BuildingConfig(days=1, patrol_s=30.0), seed=1).sessions[0]
    config = Config(slam=SlamConfig(online=True))
    whole = run_slam(recording, config)
    for after in (5, 40, len(whole.step_s)):
        count = []

        def stop(done_s: float, all_s: float, after: int = after, count: list[float] = count) -> None:
            count.append(done_s)
            if len(count) == after:
                interrupt()

        result = run_slam(recording, config, progress=stop)
        assert result.interrupted
        assert len(count) == after
        np.testing.assert_array_equal(result.step_s.shape, (after,))
        np.testing.assert_allclose(result.online.pose_world_robot[:4], whole.online.pose_world_robot[:4])


def test_machine_code_is_compiled_and_loaded_whole(tmp_path: Path) -> None:
    """An exception in the compiler's callbacks is dropped, and without the code that they give a kernel crashes."""
    (tmp_path / "module.py").write_text(
        "from evermap.compiled import kept\n\n\n"
        "@kept(error_model='numpy')\ndef twice(value):\n    return value + value\n"
    )
    code = """
import llvmlite.binding.executionengine as engine
import os, signal

def interrupt(of):
    def hook(self, data):
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000):
            pass
        return of(self, data)
    return hook

own = engine.ExecutionEngine
engine._notify_c_hook = engine._ObjectCacheNotifyFunc(interrupt(own._raw_object_cache_notify))
engine._getbuffer_c_hook = engine._ObjectCacheGetBufferFunc(interrupt(own._raw_object_cache_getbuffer))
import module
for attempt in range(2):
    try:
        print(module.twice(2))
    except KeyboardInterrupt:
        print("interrupted")
"""
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
    for _ in range(2):  # compiled, then loaded
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
        )
        assert (done.returncode, done.stdout, done.stderr) == (0, "interrupted\n4\n", "")


def ended(code: str, folder: Path) -> tuple[int, str]:
    """Exit code and stderr of a command that does something and is interrupted."""
    begin = "from evermap import interrupts\ninterrupts.leave_on_signals()\nfrom pathlib import Path\n"
    done = subprocess.run([sys.executable, "-c", begin + code], cwd=folder, capture_output=True, text=True, check=False)
    return done.returncode, done.stderr


def test_a_command_ends_with_130_and_what_was_kept(tmp_path: Path) -> None:
    assert ended(INTERRUPT, tmp_path) == (130, "evermap: interrupted: no result was written\n")
    note = "Path('kept').touch(); interrupts.kept('kept', 'it is in kept'); interrupts.kept('gone', 'never there')\n"
    assert ended(note + INTERRUPT, tmp_path) == (130, "evermap: interrupted: it is in kept\n")
    caught = f"try:\n    {INTERRUPT}\nexcept BaseException:\n    print('never')\n"
    assert ended(caught, tmp_path)[0] == 130
    terminate = INTERRUPT.replace("SIGINT", "SIGTERM")
    assert ended(terminate, tmp_path) == (143, "evermap: terminated: no result was written\n")


def test_a_command_removes_what_is_half_written(tmp_path: Path) -> None:
    write = """
from evermap.runs.folder import RunFolder
from evermap.io.files import stage_folder
with RunFolder("out") as folder, stage_folder("template") as staging:
    folder.path("figures/map.png").write_text("half")
    (staging / "table.csv").write_text("half")
    """
    assert ended(write + INTERRUPT, tmp_path) == (130, "evermap: interrupted: no result was written\n")
    assert list(tmp_path.iterdir()) == []


def test_a_command_finishes_what_it_puts_in_place(tmp_path: Path) -> None:
    swap = f"""
import evermap.runs.folder as runfolder
take = runfolder.RunFolder._swap
def interrupted(self, ours):
    {INTERRUPT}
    take(self, ours)
runfolder.RunFolder._swap = interrupted
with runfolder.RunFolder("out") as folder:
    folder.path("map.csv").write_text("whole")
print("never")
"""
    assert ended(swap, tmp_path) == (130, "evermap: interrupted: the results are in out\n")
    assert (tmp_path / "out" / "map.csv").read_text() == "whole"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_command_takes_its_workers_along(tmp_path: Path) -> None:
    (tmp_path / "work.py").write_text(
        "import os, time\nfrom pathlib import Path\n\n\n"
        "def work(_):\n    Path(f'worker-{os.getpid()}').touch()\n    time.sleep(600)\n"
    )
    code = f"""
import multiprocessing, time
from concurrent.futures import ProcessPoolExecutor
from evermap_studies.workers import sheltered
import work
with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
    with sheltered():
        futures = [pool.submit(work.work, k) for k in range(2)]
    while len(list(Path().glob("worker-*"))) < 2:
        time.sleep(0.05)
    {INTERRUPT}
    """
    assert ended(code, tmp_path) == (130, "evermap: interrupted: no result was written\n")
    for path in tmp_path.glob("worker-*"):
        with pytest.raises(ProcessLookupError):
            os.kill(int(path.name.removeprefix("worker-")), 0)


def test_processes_started_in_shelter_never_see_it() -> None:
    with sheltered():
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(0.5); print('slept')"],
                                 stdout=subprocess.PIPE, text=True)  # fmt: skip
    child.send_signal(signal.SIGINT)
    assert child.communicate()[0] == "slept\n"
    with pytest.raises(KeyboardInterrupt), sheltered():
        interrupt()


@pytest.mark.parametrize("stop", [None, KeyboardInterrupt])
def test_what_is_temporary_is_removed_once(stop: type[BaseException] | None) -> None:
    removed: list[int] = []
    remove: Callable[[], None] = lambda: removed.append(1)  # noqa: E731
    try:
        with temporary(remove):
            if stop:
                raise stop
    except KeyboardInterrupt:
        pass
    assert removed == [1]


@pytest.mark.slow
def test_interrupts_at_random_instants_end_with_one_line(tmp_path: Path) -> None:
    """A sample; the whole is `python -m benchmarks.interrupts`."""
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from benchmarks.interrupts import BEFORE_OURS, interrupt

    endings = interrupt(tmp_path, 20, seed=1, verbs=["slam", "persist", "convert"])
    assert [ending for ending in endings if ending.wrong not in ("", BEFORE_OURS)] == []
