"""Machine code of kernels: how it is kept, where, and when to throw it away."""

from __future__ import annotations

import contextlib
import functools
import os
import stat
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

from evermap.errors import EvermapWarning
from evermap.interrupts import held, raises

_Function = TypeVar("_Function", bound=Callable[..., Any])


def kept(**options: Any) -> Callable[[_Function], _Function]:
    """A decorator: compile a function at its first call, and keep the machine code for all processes.

    It is kept beside the source, or where that is read-only in the user's cache folder, or in a temporary one.

    Args:
        options: as for numba's `njit`.

    Warns:
        EvermapWarning: once, where only a temporary folder is left.
    """

    def decorate(function: _Function) -> _Function:
        from numba import njit

        dispatcher = njit(**options)(function)
        dispatcher._cache = _keeper()(function)
        dispatcher.compile = _whole(dispatcher.compile)
        return cast("_Function", dispatcher)

    return decorate


def _whole(compile_for: Callable[..., Any]) -> Callable[..., Any]:
    """Compiling that no `KeyboardInterrupt` cuts in two.

    LLVM asks for kept machine code, and hands over the new, through callbacks of ctypes. These drop an exception: the
    interrupt would be forgotten, or LLVM would get no code, and the kernel's address would be 0.
    """

    def compile_whole(signature: Any) -> Any:
        with held() if raises() else contextlib.nullcontext():
            return compile_for(signature)

    return compile_whole


@functools.cache
def _keeper() -> Callable[[Any], Any]:
    """Numba's keeper of machine code, for several processes, and for an installation that nobody may write to.

    Its own reads the index of what is kept, chooses a file and writes both, without a lock. Of processes that compile
    a function for different arguments at the same moment, one could be given the machine code of the other's.
    """
    from numba import config
    from numba.core.caching import FunctionCache

    class OneProcessAtATime(FunctionCache):
        def load_overload(self, sig: Any, target_context: Any) -> Any:
            with _locked(Path(self.cache_path)):
                return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]

        def save_overload(self, sig: Any, data: Any) -> None:
            with _locked(Path(self.cache_path)):
                super().save_overload(sig, data)  # type: ignore[no-untyped-call]

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
    """Where machine code goes if it can go nowhere else, said once by a warning.

    The next process of the same user finds it again. Code is loaded from there, so it is a folder that belongs to this
    user and that nobody else may write to, or else a new one of this process.
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
    problem = "compiled kernels are kept in a temporary folder: neither the installation nor a home folder is writable"
    warnings.warn(f"{problem} ({folder}; try: NUMBA_CACHE_DIR=FOLDER)", EvermapWarning, stacklevel=2)
    os.environ.setdefault("NUMBA_CACHE_DIR", str(folder))  # processes that this one starts need not say it again
    os.environ.setdefault("MPLCONFIGDIR", str(folder / "matplotlib"))  # which would say the same of its fonts
    return str(folder)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    try:
        import fcntl
    except ImportError:  # Windows has no such lock: processes there do as numba alone has them do
        yield
        return
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "machine-code.lock").open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # until the file is closed
        yield


def drop_stale_code(module_file: str, *called: str) -> None:
    """Delete the kept machine code of a package that is older than any of its sources, or than others that it calls.

    A compiled function contains the compiled functions that it calls, but its keeper compares it with its own file
    only; after an edit elsewhere in the package old and new formulas would be mixed.

    Args:
        module_file: `__file__` of a module of the package.
        called: `__file__` of modules elsewhere whose compiled functions its kernels call.
    """
    folder = Path(module_file).parent
    newest = max(path.stat().st_mtime for path in (*folder.glob("*.py"), *map(Path, called)))
    for index in (folder / "__pycache__").glob("*.nbi"):
        with contextlib.suppress(OSError):  # someone else's installation: its files do not change under us
            if index.stat().st_mtime < newest:
                index.unlink()
