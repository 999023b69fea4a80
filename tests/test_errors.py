"""Errors that users can cause are one line that says what, where and what to try."""

from __future__ import annotations

from pathlib import Path

import pytest

from evermap import errors
from evermap.errors import EvermapError, InputError

KINDS = [kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, EvermapError)]


@pytest.mark.parametrize(
    ("where", "expected"),
    [
        ({}, "is broken"),
        ({"path": "a/b.csv"}, "a/b.csv: is broken"),
        ({"path": Path("b.csv"), "line": 3}, "b.csv:3: is broken"),
        ({"line": 3}, "line 3: is broken"),
        ({"path": "b.csv", "line": 3, "field": "range_m"}, "b.csv:3: field 'range_m': is broken"),
        ({"field": "slam.seed", "hint": "a whole number"}, "field 'slam.seed': is broken (try: a whole number)"),
    ],
)
def test_message_names_the_parts_that_are_known(where: dict[str, object], expected: str) -> None:
    error = InputError("is broken", **where)  # type: ignore[arg-type]
    assert str(error) == error.one_line() == expected


def test_message_is_one_line_whatever_the_input_was() -> None:
    error = InputError("cannot parse '1.0\n\t2.0\r\n'", hint="one number\na cell")
    assert str(error) == "cannot parse '1.0 2.0 ' (try: one number a cell)"


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_every_kind_is_caught_as_one_and_keeps_its_parts(kind: type[EvermapError]) -> None:
    with pytest.raises(EvermapError) as caught:
        raise kind("is broken", path="b.csv", line=3, field="range_m", hint="mend it")
    error = caught.value
    assert (error.problem, error.path, error.line, error.field, error.hint) == (
        "is broken",
        Path("b.csv"),
        3,
        "range_m",
        "mend it",
    )
    assert isinstance(error, Exception)
    assert not isinstance(error, ValueError)
