"""Machine code is kept for every kind of arguments, whoever else is compiling."""

from __future__ import annotations

import importlib
import importlib.util
import os
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from numba.core.caching import IndexDataCacheFile

SOURCES = Path(__file__).parents[1] / "src"
SOURCE = """
from evermap.compiled import kept


@kept(error_model="numpy")
def twice(value):
    return value + value
"""


def kernel_of_a_process(path: Path) -> Any:
    """The compiled function as every process makes it for itself."""
    spec = importlib.util.spec_from_file_location("made_for_a_test", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.twice


def test_two_that_compile_at_the_same_moment_keep_the_code_of_both(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "module.py"
    path.write_text(SOURCE)
    load_index = IndexDataCacheFile._load_index

    def dawdle(self: IndexDataCacheFile) -> Any:
        index = load_index(self)
        time.sleep(0.3)  # time enough for another to write
        return index

    compiled = kernel_of_a_process(path)
    assert (compiled(2), compiled(0.5)) == (4, 1.0)
    compiled._cache.flush()
    monkeypatch.setattr(IndexDataCacheFile, "_load_index", dawdle)
    writers = [
        threading.Thread(target=kernel_of_a_process(path)._cache.save_overload, args=(arguments, code))
        for arguments, code in compiled.overloads.items()
    ]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    monkeypatch.undo()
    later = kernel_of_a_process(path)
    assert (later(2), later(0.5)) == (4, 1.0)
    assert not later.stats.cache_misses
    assert len(later.stats.cache_hits) == 2


AT_ONCE = """
import os, sys, time
from pathlib import Path

from evermap.compiled import kept


@kept()
def below(value):
    return value + 1.0


@kept()
def above(value):
    return below(value) + 1.0


def slowly(kernel, for_s):
    compile_kernel = kernel._compiler.compile

    def compile_slowly(*given):
        Path("compiled", f"{kernel.__name__} {os.getpid()}").touch()
        time.sleep(for_s)
        return compile_kernel(*given)

    kernel._compiler.compile = compile_slowly


slowly(below, 0.5)
slowly(above, 0.0)
Path(f"ready {os.getpid()}").touch()
while len(list(Path().glob("ready *"))) < 2:
    time.sleep(0.001)
print((above, below)[sys.argv[1] == "below"](1.0))
"""


@pytest.mark.parametrize(("other", "result"), [("above", "3.0"), pytest.param("below", "2.0", marks=pytest.mark.slow)])
def test_of_processes_that_need_the_same_code_one_compiles_it(tmp_path: Path, other: str, result: str) -> None:
    """Also where one needs it for a kernel that calls it."""
    (tmp_path / "at_once.py").write_text(AT_ONCE)
    (tmp_path / "compiled").mkdir()
    path = os.pathsep.join([str(tmp_path), str(SOURCES)])
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", "import at_once", which], cwd=tmp_path, env={**os.environ, "PYTHONPATH": path},
            stdout=subprocess.PIPE, text=True,
        )
        for which in ("above", other)
    ]  # fmt: skip
    assert [process.communicate(timeout=100)[0].strip() for process in processes] == ["3.0", result]
    assert sorted(file.name.partition(" ")[0] for file in tmp_path.glob("compiled/*")) == ["above", "below"]


CALLED = """
from evermap.compiled import kept

FACTOR = 2.0


@kept(error_model="numpy")
def scaled(value):
    return FACTOR * value


def plain():
    return 1
"""
CALLER = """
from evermap.compiled import kept
from made_for_a_test_of_calls import scaled


@kept(error_model="numpy")
def twice(value):
    return below(value) + scaled(value)


@kept(error_model="numpy")
def below(value):
    return scaled(value)
"""


def test_code_is_kept_until_a_formula_or_a_constant_changes_wherever_it_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kernel holds the code of what it calls; what is plain Python around it does not matter."""
    caller, called = tmp_path / "caller.py", tmp_path / "made_for_a_test_of_calls.py"
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)

    def result(of_caller: str, of_called: str) -> tuple[float, bool]:
        """What it computes, and whether kept code did."""
        caller.write_text(of_caller)
        called.write_text(of_called)
        sys.modules.pop("made_for_a_test_of_calls", None)
        importlib.invalidate_caches()
        kernel = kernel_of_a_process(caller)
        return kernel(1.5), not kernel.stats.cache_misses

    assert result(CALLER, CALLED) == (6.0, False)
    assert result(CALLER, CALLED) == (6.0, True)
    around = CALLED.replace("FACTOR = ", "# a comment moves what follows\nFACTOR = ").replace("return 1", "return 2")
    assert result("import os\n" + CALLER, around) == (6.0, True)
    assert result(CALLER, around.replace("2.0", "3.0")) == (9.0, False)
    assert result(CALLER, around.replace("FACTOR * value", "FACTOR + value")) == (7.0, False)
    assert result(CALLER.replace("return scaled(value)", "return value"), CALLED) == (4.5, False)
    fast = CALLED.replace('error_model="numpy"', 'error_model="numpy", fastmath=True')
    assert result(CALLER, fast) == (6.0, False)


def reader_of_a_shipped_package(folder: Path) -> Any:
    """A module in a package that nobody may write to, as a function that runs code beside it without a home.

    The tests may run as root, whom no permission stops: what is asked for is a place that is a file and not a folder.
    """
    package = folder / "shipped"
    package.mkdir()
    (package / "module.py").write_text(SOURCE)
    (package / "__pycache__").write_text("no folder: nothing can be kept here")
    (folder / "temporary").mkdir()

    def run(code: str) -> subprocess.CompletedProcess[str]:
        environment = {
            **{name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")},
            "HOME": str(package / "module.py"),
            "TMPDIR": str(folder / "temporary"),
            "PYTHONDONTWRITEBYTECODE": "1",
            "PYTHONPATH": f"{package}{os.pathsep}{SOURCES}",
        }
        return subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
        )

    return run


def test_code_for_a_type_that_is_gone_is_compiled_anew(tmp_path: Path) -> None:
    """An update renames the types of a kernel's arguments: what is kept names types that nobody finds any more."""
    program = """
from typing import NamedTuple

from evermap.compiled import kept


class {name}(NamedTuple):
    value: float


@kept(error_model="numpy")
def twice(argument):
    return 2.0 * argument.value


print(twice({name}(3.0)))
"""
    for name in ("Before", "After"):
        (tmp_path / "kernel_of_an_update.py").write_text(program.format(name=name))
        code = [sys.executable, "-c", "import kernel_of_an_update"]
        path = os.pathsep.join([str(tmp_path), str(SOURCES)])
        done = subprocess.run(code, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": path}, check=False)
        assert (done.stdout, done.stderr) == ("6.0\n", ""), name


def test_without_a_place_to_keep_code_a_temporary_one_is_used_and_told_once(tmp_path: Path) -> None:
    run = reader_of_a_shipped_package(tmp_path)
    code = """
import warnings
warnings.simplefilter("always")
warnings.showwarning = lambda message, category, *_: print(category.__name__, message)
from module import twice
import evermap.slam.filter_kernels
print(twice(2), *(sum(twice.stats[k].values()) for k in (1, 2)))
"""
    first, second = run(code), run(code)
    for done, hits in ((first, "0 1"), (second, "1 0")):
        assert done.stderr == ""
        said, result = done.stdout.splitlines()
        assert said.startswith("EvermapWarning compiled kernels are cached in a temporary folder")
        assert str(tmp_path / "temporary") in said
        assert result == f"4 {hits}"
    (kept_in,) = (tmp_path / "temporary").iterdir()
    assert stat.S_IMODE(kept_in.stat().st_mode) == 0o700


def test_code_is_not_loaded_from_a_folder_that_others_may_write_to(tmp_path: Path) -> None:
    run = reader_of_a_shipped_package(tmp_path)
    planted = tmp_path / "temporary" / f"evermap-kernels-{os.getuid()}"
    for plant in (lambda: planted.mkdir(mode=0o777), lambda: planted.symlink_to(tmp_path)):
        plant()
        planted.is_symlink() or planted.chmod(0o777)
        done = run("from evermap.compiled import temporary_folder; print(temporary_folder())")
        place = Path(done.stdout.strip())
        assert place.parent == tmp_path / "temporary"
        assert place != planted
        assert stat.S_IMODE(place.stat().st_mode) == 0o700
        planted.unlink() if planted.is_symlink() else planted.rmdir()


def test_the_command_line_says_it_in_one_line(tmp_path: Path) -> None:
    run = reader_of_a_shipped_package(tmp_path)
    code = """
import sys
sys.argv = ["evermap", "survival", "fit", "nothing.csv"]
import evermap.runs.track.lifetimes
def read(*_):
    from module import twice
    twice(2)
    raise evermap.errors.InputError("no such file", path="nothing.csv")
evermap.runs.track.lifetimes.read_lifetimes = read
from evermap.__main__ import run
run()
"""
    done = run(code)
    assert done.returncode == 2
    said, ended = done.stderr.splitlines()
    assert said.startswith("evermap: warning: compiled kernels are cached in a temporary folder")
    assert ended == "evermap: error: nothing.csv: no such file"


ONE_THREAD = """
import threading
from evermap.compiled import single_threaded

def numbers():
    import threadpoolctl
    return {one["num_threads"] for one in threadpoolctl.threadpool_info() if one["user_api"] == "blas"}

with single_threaded():  # neither numpy nor scipy was loaded
    assert numbers() == {1}
import threadpoolctl
threadpoolctl.threadpool_limits(2)  # in the thread that owns the limit to threadpoolctl
assert numbers() == {2}

entered, left = threading.Event(), threading.Event()

def outlasts():
    with single_threaded():
        entered.set()
        left.wait()
        assert numbers() == {1}

thread = threading.Thread(target=outlasts)
with single_threaded():
    thread.start()
    entered.wait()
    with single_threaded():
        pass
    assert numbers() == {1}
left.set()
thread.join()
assert numbers() == {2}
print("done")
"""


def test_blas_has_one_thread_while_any_thread_asks_for_it_and_then_what_it_had() -> None:
    """In a process of its own, which begins without numpy."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "2", "PYTHONPATH": str(SOURCES)}
    code = [sys.executable, "-c", ONE_THREAD]
    done = subprocess.run(code, capture_output=True, text=True, env=environment, check=False)
    assert (done.stderr, done.stdout) == ("", "done\n")


SHARED = """
import sys
from pathlib import Path

from evermap.compiled import kept, shared_with

@kept()
def one(x):
    return x + 1.0

@kept()
def two(x):
    return x + 2.0

if __name__ == "__main__":
    Path("second").write_text(str(two(1.0)))
else:
    with shared_with("halves"):
        one(1.0)
    two(1.0)
    print(bool(two.stats.cache_hits), Path("second").exists())
"""


def test_a_second_process_compiles_the_other_half_only_where_something_is_missing(tmp_path: Path) -> None:
    """When the block ends, both halves are kept. Where they are, no process is started."""
    if (os.cpu_count() or 1) < 2:
        pytest.skip("one core: no second process")
    (tmp_path / "halves.py").write_text(SHARED)

    def run() -> str:
        command = [sys.executable, "-c", "import halves"]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout.strip()

    assert run() == "True True"
    (tmp_path / "second").unlink()
    assert run() == "True False"


TELLING = """
from evermap.cli.terminal import warm_up
from evermap.compiled import kept

@kept()
def one(x):
    return x + 1.0

warm_up(lambda: None)
warm_up(lambda: one(1.0))
warm_up(lambda: one(2.0))
"""


def test_compiling_is_told_where_something_is_compiled_and_not_where_loading_takes_long(tmp_path: Path) -> None:
    (tmp_path / "telling.py").write_text(TELLING)

    def run() -> str:
        command = [sys.executable, "-c", "import telling"]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stderr

    assert run().count("compiling the kernels") == 1
    assert run() == ""


FAILING = """
import time
from pathlib import Path

from evermap.compiled import kept, shared_with

@kept()
def one(x):
    return x + 1.0

with shared_with("slow"):
    one(1.0)
    while not (Path("pid").exists() and Path("pid").read_text()):
        time.sleep(0.01)
    raise KeyboardInterrupt
"""
SLOW = """
import os, time
from pathlib import Path

Path("pid").write_text(str(os.getpid()))
time.sleep(600)
"""


def test_the_second_process_ends_with_a_block_that_fails(tmp_path: Path) -> None:
    """As by Ctrl-C."""
    if (os.cpu_count() or 1) < 2:
        pytest.skip("one core: no second process")
    (tmp_path / "failing.py").write_text(FAILING)
    (tmp_path / "slow.py").write_text(SLOW)
    command = [sys.executable, "-c", "import failing"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "KeyboardInterrupt" in done.stderr
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)
