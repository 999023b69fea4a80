"""Machine code of kernels: how it is kept, and when to throw it away."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

_Function = TypeVar("_Function", bound=Callable[..., Any])


def kept(**options: Any) -> Callable[[_Function], _Function]:
    """A decorator: compile a function at its first call, and keep the machine code beside the source.

    Args:
        options: as for numba's `njit`.
    """

    def decorate(function: _Function) -> _Function:
        from numba import njit

        dispatcher = njit(**options)(function)
        dispatcher._cache = _keeper()(function)
        return cast("_Function", dispatcher)

    return decorate


@functools.cache
def _keeper() -> Callable[[Any], Any]:
    """Numba's keeper of machine code, for several processes.

    Its own reads the index of what is kept, chooses a file and writes both, without a lock. Of processes that compile
    a function for different arguments at the same moment, one could be given the machine code of the other's.
    """
    from numba.core.caching import FunctionCache

    class OneProcessAtATime(FunctionCache):
        def load_overload(self, sig: Any, target_context: Any) -> Any:
            with _locked(Path(self.cache_path)):
                return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]

        def save_overload(self, sig: Any, data: Any) -> None:
            with _locked(Path(self.cache_path)):
                super().save_overload(sig, data)  # type: ignore[no-untyped-call]

    return OneProcessAtATime


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
