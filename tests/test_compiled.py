"""Machine code is kept for every kind of arguments, whoever else is compiling."""

from __future__ import annotations

import importlib.util
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from numba.core.caching import IndexDataCacheFile

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
