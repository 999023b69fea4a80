"""Machine code of kernels: how it is kept, where, and until when."""

from __future__ import annotations

import contextlib
import functools
import gc
import hashlib
import os
import pickle  # for the name of its error: the index of kept code is numba's, in a folder of this user
import stat
import subprocess
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator
from enum import Enum
from pathlib import Path
from types import CodeType, FunctionType, ModuleType, NoneType
from typing import Any, TypeVar, cast

from evermap.errors import EvermapWarning
from evermap.interrupts import held, raises

_Function = TypeVar("_Function", bound=Callable[..., Any])


THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables that limit the threads of libraries for linear algebra, read when these are loaded."""

_LOCK, _INSIDE = threading.Lock(), list[list[tuple[Any, int]]]()
"""Who is within `single_threaded`, with the numbers of threads before the first of them."""


@contextlib.contextmanager
def single_threaded() -> Iterator[None]:
    """Keep BLAS to one thread: matrices are small, more threads sum in another order on another machine, and idle ones
    take a core of their own. The number is one for the whole process: the last thread that leaves restores it.
    """
    with _LOCK:
        _INSIDE.append(_INSIDE[0] if _INSIDE else [(library, library.num_threads) for library in _blas()])
        for library, _ in _INSIDE[0]:
            _set_threads(library, 1)
    try:
        yield
    finally:
        with _LOCK:
            before = _INSIDE.pop()
            for library, number in () if _INSIDE else before:
                _set_threads(library, number)


@functools.cache
def _blas() -> list[Any]:
    """Those of numpy and scipy; finding them takes a millisecond."""
    import scipy.linalg  # noqa: F401  (one that is loaded later would not be found)
    from threadpoolctl import ThreadpoolController

    return list(ThreadpoolController().select(internal_api="openblas").lib_controllers)


def _set_threads(library: Any, number: int) -> None:
    """Also after another thread has done so, which threadpoolctl 3.8 ignores without a word."""
    getattr(library, "_real_set_num_threads", library.set_num_threads)(number)


@contextlib.contextmanager
def shared_with(module: str) -> Iterator[None]:
    """Run a second process that compiles one half of the kernels, while this one compiles the other.

    The process is started when a kernel turns out not to be kept, unless there is one core only. The block waits for
    it at its end; an exception kills it. Whatever it leaves undone is compiled at its first call.

    Args:
        module: run as `python -m MODULE`; it calls kernels that the block does not.
    """
    second: list[subprocess.Popen[bytes]] = []

    def start() -> None:
        command, quiet = [sys.executable, "-m", module], subprocess.DEVNULL
        with contextlib.suppress(OSError):
            process = subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet)  # noqa: S603  (ourselves)
            second.append(process)

    if (os.cpu_count() or 1) > 1:
        _AT_FIRST_MISSING.append(start)
    try:
        yield
        for process in second:
            process.wait()
    finally:
        _forget(start)
        for process in second:
            process.kill()
            process.wait()


@contextlib.contextmanager
def at_first_missing(tell: Callable[[], None]) -> Iterator[None]:
    """Call `tell` once, when within the block a kernel turns out not to be kept: it is compiled next."""
    _AT_FIRST_MISSING.append(tell)
    try:
        yield
    finally:
        _forget(tell)


def _forget(called: Callable[[], None]) -> None:
    if called in _AT_FIRST_MISSING:
        _AT_FIRST_MISSING.remove(called)


_AT_FIRST_MISSING: list[Callable[[], None]] = []
"""What is called, once, when a kernel is not kept."""

UNREADABLE = (AttributeError, ImportError, EOFError, pickle.UnpicklingError)
"""Errors of a cache index that names types missing in this evermap, or that is truncated."""

OBJECTS_BEFORE_COLLECTION = 100_000
"""Threshold of the garbage collector while a kernel is compiled."""


def kept(*, effort: int = 3, **options: Any) -> Callable[[_Function], _Function]:
    """Return a decorator that compiles a function at its first call and keeps the machine code for all processes.

    It is kept beside the source, or where that is read-only in the user's cache folder, or in a temporary one. It is
    compiled again when the function, what it calls, or a constant that either of them reads has changed. A call lets go
    of the interpreter's lock: kernels run side by side in threads.

    Args:
        effort: LLVM's level of optimisation, from 1. Level 1 compiles in two thirds of the time; level 3 pays where
            loops are to be vectorised. No level changes a result, but for the rounding that `fastmath` permits.
        options: as for numba's `njit`.

    Warns:
        EvermapWarning: once, where only a temporary folder is left.
    """

    def decorate(function: _Function) -> _Function:
        from numba import njit

        # no entry for C, which nobody calls: 3 % of the time that compiling takes
        options["no_cfunc_wrapper"] = True
        dispatcher = njit(nogil=True, **options)(function)  # of other options what numba brings is compiled anew
        dispatcher._cache = _keeper()(function)
        dispatcher._cache.of = dispatcher
        dispatcher.effort = effort
        dispatcher.compile = _whole(dispatcher.compile, effort, dispatcher._cache)
        return cast("_Function", dispatcher)

    return decorate


def _whole(compile_for: Callable[..., Any], effort: int, cache: Any) -> Callable[..., Any]:
    """Compiling that no `KeyboardInterrupt` cuts in two, at an effort of its own.

    LLVM asks for kept machine code, and hands over the new, through callbacks of ctypes. These drop an exception: the
    interrupt would be forgotten, or LLVM would get no code, and the kernel's address would be 0.
    """

    def compile_whole(signature: Any) -> Any:
        with held() if raises() else contextlib.nullcontext(), _optimising(effort), cache.turns():
            return compile_for(signature)

    return compile_whole


@contextlib.contextmanager
def _optimising(effort: int) -> Iterator[None]:
    """Numba knows one level for all functions: it is ours while this thread, alone, compiles.

    It makes millions of objects that are all needed to the end: looking for garbage among them is a tenth of the time.
    """
    from numba import config
    from numba.core.compiler_lock import global_compiler_lock

    settings: Any = config
    with global_compiler_lock:
        before, collecting = settings.OPT, gc.get_threshold()
        try:
            settings.OPT = type(before)(min(effort, _asked()))
            gc.set_threshold(max(collecting[0], OBJECTS_BEFORE_COLLECTION) if collecting[0] else 0, *collecting[1:])
            yield
        finally:
            settings.OPT = before
            gc.set_threshold(*collecting)


@functools.cache
def _asked() -> int:
    """The level that the user allows (NUMBA_OPT), 3 if nothing is said."""
    from numba import config

    settings: Any = config
    return int(settings.OPT)


@functools.cache
def _keeper() -> Callable[[Any], Any]:
    """Numba's keeper of machine code, for several processes, and for an installation that is read-only.

    Its own reads the index of what is kept, chooses a file and writes both, without a lock. Of processes that compile
    a function for different arguments at the same moment, one could be given the machine code of the other's. And it
    compares kept code with the file of the function only, though that holds the code of all that the function calls.
    Of processes that need the same code, one compiles it, and the others wait and load it.
    """
    from numba import config
    from numba.core.caching import CompileResultCacheImpl, FunctionCache

    class NamedWithoutLine(CompileResultCacheImpl):
        def get_filename_base(self, fullname: str, abiflags: str) -> str:
            name = fullname.replace("<", "").replace(">", "")
            return f"{name}.py{sys.version_info[0]}{sys.version_info[1]}{abiflags}"

    class OneProcessAtATime(FunctionCache):
        _impl_class = NamedWithoutLine
        of: Any = None
        """The dispatcher whose code is cached."""
        turn: contextlib.ExitStack | None = None
        """Within a compilation, what keeps other processes from the same one until it ends."""

        @contextlib.contextmanager
        def turns(self) -> Iterator[None]:
            """Within the block, code that is missing is compiled by this process alone, or loaded if another was."""
            before = self.turn
            with contextlib.ExitStack() as turn:
                self.turn = turn
                try:
                    yield
                finally:
                    self.turn = before

        def load_overload(self, sig: Any, target_context: Any) -> Any:
            found = self._load(sig, target_context)
            while found is None and _AT_FIRST_MISSING:
                _AT_FIRST_MISSING.pop()()
            if found is None and self.turn is not None:
                name = hashlib.sha256(str(sig).encode()).hexdigest()[:8]
                self.turn.enter_context(_hold_lock(Path(self.cache_path), f"{self._impl.filename_base}.{name}"))
                found = self._load(sig, target_context)
            return found

        def _load(self, sig: Any, target_context: Any) -> Any:
            with _hold_lock(Path(self.cache_path)):
                self._stamp()
                try:
                    return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
                except UNREADABLE:
                    self.flush()  # type: ignore[no-untyped-call]
                    return None

        def save_overload(self, sig: Any, data: Any) -> None:
            with _hold_lock(Path(self.cache_path)):
                self._stamp()
                try:
                    super().save_overload(sig, data)  # type: ignore[no-untyped-call]
                except UNREADABLE:
                    self.flush()  # type: ignore[no-untyped-call]
                    super().save_overload(sig, data)  # type: ignore[no-untyped-call]

        def _stamp(self) -> None:
            """Not before the first call: a kernel may call others that stand below it."""
            if self.of is not None:
                self._cache_file._source_stamp = _stamp_of(self.of)

    def keeper(function: Any) -> Any:
        try:
            return OneProcessAtATime(function)  # type: ignore[no-untyped-call]
        except RuntimeError:  # neither the package nor a home folder can be written to
            setattr(config, "CACHE_DIR", temporary_folder())  # noqa: B010 (numba sets it so, too: mypy sees none)
            return OneProcessAtATime(function)  # type: ignore[no-untyped-call]

    return keeper


def find_place() -> None:
    """Find out where machine code is kept, before several processes find it out and each of them says so."""
    _keeper()(find_place)


@functools.cache
def temporary_folder() -> str:
    """Return where machine code goes if it can go nowhere else, said once by a warning.

    The next process of the same user finds it again. Code is loaded from there, so it is a folder that belongs to this
    user and that no other user may write to, or else a new one of this process.
    """
    name = f"evermap-kernels-{os.getuid()}" if hasattr(os, "getuid") else "evermap-kernels"
    folder = Path(tempfile.gettempdir()) / name
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        ours = not hasattr(os, "getuid") or (found.st_uid == os.getuid() and not found.st_mode & 0o077)
        if not stat.S_ISDIR(found.st_mode) or not ours or not os.access(folder, os.W_OK):
            raise PermissionError
    except OSError:
        folder = Path(tempfile.mkdtemp(prefix=f"{name}-"))
    problem = "compiled kernels are cached in a temporary folder: the installation and the home folder are read-only"
    warnings.warn(f"{problem} ({folder}; try: NUMBA_CACHE_DIR=FOLDER)", EvermapWarning, stacklevel=2)
    os.environ.setdefault("NUMBA_CACHE_DIR", str(folder))  # processes that this one starts need not say it again
    os.environ.setdefault("MPLCONFIGDIR", str(folder / "matplotlib"))  # which would say the same of its fonts
    return str(folder)


@contextlib.contextmanager
def _hold_lock(folder: Path, name: str = "machine-code") -> Iterator[None]:
    try:
        import fcntl
    except ImportError:  # Windows has no such lock: processes there do as numba alone has them do
        yield
        return
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / f"{name}.lock").open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        try:
            yield
        finally:
            fcntl.flock(file, fcntl.LOCK_UN)  # closing it does not where a fork has it open, too


@functools.cache
def _stamp_of(dispatcher: Any) -> str:
    """A digest of everything of ours that the machine code of a kernel depends on, and of nothing else.

    Line numbers, comments and the plain Python around it are not part of it.
    """
    import numpy as np

    digest = hashlib.sha256(np.__version__.encode())
    for part in _parts(dispatcher, {}):
        digest.update(part.encode())
        digest.update(b"\0")
    return digest.hexdigest()


def _parts(value: Any, seen: dict[int, int]) -> Iterator[str]:
    """What a value that a kernel refers to means for its machine code, as texts; a function with all it refers to."""
    function = getattr(value, "py_func", getattr(value, "_defn", value))  # a dispatcher's, an intrinsic's, or itself
    if isinstance(function, FunctionType):
        number = seen.setdefault(id(function), len(seen))
        yield f"function {number}"
        if number == len(seen) - 1:
            captured = [cell.cell_contents for cell in function.__closure__ or ()]
            options = {"effort": getattr(value, "effort", 3), **getattr(value, "targetoptions", {})}
            for part in (*sorted(options), *map(options.get, sorted(options)), function.__defaults__, captured):
                yield from _parts(part, seen)
            yield from _parts_of_code(function.__code__, function.__doc__, function.__globals__, seen)
    elif isinstance(value, ModuleType):
        yield f"module {value.__name__}"
    elif isinstance(value, type):
        yield f"{value.__module__}.{value.__qualname__} {getattr(value, '_fields', '')}"
        if issubclass(value, Enum):
            yield repr([(member.name, member.value) for member in value])
    elif type(value).__module__ == "numpy" and hasattr(value, "tobytes"):
        yield f"{value.dtype} {value.shape} {value.tobytes().hex()}"
    elif isinstance(value, set | frozenset):
        yield repr(sorted(map(repr, value)))
    elif isinstance(value, tuple | list):
        yield f"{type(value).__qualname__} {len(value)}"
        for item in value:
            yield from _parts(item, seen)
    elif isinstance(value, bool | int | float | complex | str | bytes | NoneType):
        yield repr(value)
    else:  # numba's types and the like: as they were when numba was built
        yield f"{type(value).__module__}.{type(value).__qualname__} {getattr(value, '__name__', '')}"


def _parts_of_code(code: CodeType, doc: str | None, around: dict[str, Any], seen: dict[int, int]) -> Iterator[str]:
    yield from (code.co_code.hex(), repr(code.co_varnames), repr(code.co_names), repr(code.co_freevars))
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _parts_of_code(constant, None, around, seen)
        elif constant is None or constant is not doc:
            yield from _parts(constant, seen)
    for name in code.co_names:
        value = around.get(name)
        if value is not None:
            yield name
            yield from _parts(value, seen)
        if isinstance(value, ModuleType) and value.__name__.partition(".")[0].startswith("evermap"):
            for read in code.co_names:
                if hasattr(value, read):
                    yield from _parts(getattr(value, read), seen)
