"""The path of a call is counted as a debugger would step: functions of the package, however they are reached."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest

from evermap.cli.bench import load_benchmarks
from evermap.maps.living import LivingMap
from evermap.types import Landmarks


@pytest.fixture(scope="module")
def session_path() -> ModuleType:
    load_benchmarks()
    from benchmarks import session_path as found

    return found


def test_functions_depth_and_maps_are_those_that_a_call_enters(session_path: ModuleType) -> None:
    survey = Landmarks.at(np.arange(3), np.zeros((3, 2)), sigma_m=0.1)

    def begin_twice() -> list[LivingMap]:
        return [LivingMap.begun(survey).from_now_on(5.0) for _ in range(2)]

    path = session_path.trace(begin_twice)
    assert {"LivingMap.begun", "LivingMap.from_now_on", "Places.__post_init__"} <= set(path.functions["maps.living"])
    assert "Tabular.__len__" in path.functions["types.arrays"]
    names = [name for module in path.functions.values() for name in module]
    assert not [name for name in names if name.endswith(">")]
    assert path.maps == 4
    assert path.deepest[0].startswith("maps.living:LivingMap.")
    assert path.figures() == {
        "modules": len(path.functions),
        "functions": len(names),
        "depth": len(path.deepest),
        "maps": 4,
    }


def test_an_exception_leaves_the_stack_as_it_was(session_path: ModuleType) -> None:
    living = LivingMap.begun(Landmarks.at(np.arange(3), np.zeros((3, 2)), sigma_m=0.1))

    def fail_often() -> None:
        for _ in range(50):
            with pytest.raises(KeyError):
                living.edited(7)

    assert session_path.trace(fail_often).deepest == ("maps.living:LivingMap.edited", "types.arrays:Tabular.__len__")
