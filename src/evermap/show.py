"""Objects that show themselves: a short text, a small HTML table, a pandas data frame, a figure."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from importlib import import_module
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np

from evermap.errors import MissingExtraError, printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LONGEST = 900
"""Maximum characters of a text; the rest is omitted."""
_TEXT, _ITEMS = 60, 4
"""Characters of a name, and items of a list, that are shown in full."""
_AXES = {(2, 2): "xy", (3, 3): ("x", "y", "{t}"), (6, 6): ("x", "y", "z", "rx", "ry", "rz")}
_PARTS: Mapping[tuple[int, ...], tuple[tuple[str, tuple[int, ...]], ...]] = {
    (2,): (("x{unit}", (0,)), ("y{unit}", (1,))),
    (3,): (("x{unit}", (0,)), ("y{unit}", (1,)), ("z{unit}", (2,))),
    (4,): tuple((f"q{axis}", (k,)) for k, axis in enumerate("xyzw")),
    (6,): tuple((f"{axis}{{unit}}", (k,)) for k, axis in enumerate(_AXES[6, 6])),
    (7,): tuple((name, (k,)) for k, name in enumerate(("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"))),
    (4, 2): tuple((f"{axis}{k}{{unit}}", (k, i)) for k in range(4) for i, axis in enumerate("uv")),
    **{
        shape: tuple((f"cov_{a}{b}{{unit}}", (i, j)) for i, a in enumerate(on) for j, b in enumerate(on) if i <= j)
        for shape, on in _AXES.items()
    },
}
"""Data frame columns of positions, poses and their covariances, by their shape after the first axis."""
_PLAIN = ("position", "pose", "covariance", "rotation", "corner")


class Shown:
    """Mixin of dataclasses of arrays: `repr` is one short line, in notebooks a small table."""

    __slots__ = ()

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        # a dataclass writes no `__repr__` over one that stands in the class itself
        if "__repr__" not in cls.__dict__:
            cls.__repr__ = Shown.__repr__  # type: ignore[method-assign]

    def _facts(self) -> dict[str, Any]:
        """Return what the text and the table say, by label; every field unless overridden."""
        known: Mapping[str, Any] = getattr(self, "__dataclass_fields__", {})
        return {name: getattr(self, name) for name, item in known.items() if item.repr and name[0] != "_"}

    def __repr__(self) -> str:
        text = ", ".join(f"{label}={short(value)}" for label, value in self._facts().items())
        return f"{type(self).__name__}({text if len(text) <= LONGEST else text[:LONGEST] + ' ...'})"

    def _repr_html_(self) -> str:
        facts = ((escape(label), escape(short(value))) for label, value in self._facts().items())
        rows = "".join(f"<tr><th>{label}</th><td>{value}</td></tr>" for label, value in facts)
        return f"<table><caption>{escape(type(self).__name__)}</caption>{rows}</table>"


class ShownTable(Shown):
    """Mixin of dataclasses whose arrays are columns with one row an item."""

    __slots__ = ()
    __dataclass_fields__: ClassVar[dict[str, Any]]
    _besides: ClassVar[frozenset[str]] = frozenset()
    """Arrays that are not columns."""

    def to_pandas(self) -> Any:
        """Return a data frame with a row an item; positions, poses and covariances become several columns.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        return data_frame(self._columns())

    def _columns(self) -> dict[str, Any]:
        """Return arrays of one length by name, the columns of the data frame."""
        found: dict[str, Any] = {}
        for name in self.__dataclass_fields__:
            values: Any = getattr(self, name)
            if name in self._besides or not hasattr(values, "shape"):
                continue
            if values.ndim == 1:
                found[name] = values
                continue
            unit = next((end for end in ("_m2", "_m", "_px") if name.endswith(end)), "")
            plain = name.startswith(_PLAIN) and not name.endswith("_covariance")
            prefix = "" if plain else name.removesuffix(unit).removesuffix("_covariance") + "_"
            parts = _PARTS[values.shape[1:]]
            if values.shape[1:] == (3,) and not name.endswith("_m"):  # no point, but a pose in the plane
                parts = (("x_m", (0,)), ("y_m", (1,)), ("theta_rad", (2,)))
            third = "t" if plain and not unit else "z"
            for part, place in parts:
                found[prefix + part.format(unit=unit, t=third)] = values[(slice(None), *place)]
        return found


def data_frame(columns: Mapping[str, Any]) -> Any:
    """Make a pandas data frame of columns.

    Raises:
        MissingExtraError: pandas is not installed.
    """
    try:
        pandas = import_module("pandas")
    except ImportError:
        problem = "a data frame needs pandas, which is not installed"
        raise MissingExtraError(problem, hint="pip install pandas") from None
    return pandas.DataFrame(dict(columns))


def draw(function: str, *given: Any, **options: Any) -> Figure:
    """Draw with a function of `evermap.viz.plots`, which is loaded now: nothing that it draws may import it."""
    return cast("Figure", getattr(import_module("evermap.viz.plots"), function)(*given, **options))


def short(value: Any) -> str:
    """Return a value as a short text: arrays by type and shape, long lists by their length."""
    if isinstance(value, str):
        return repr(printable(str(value), _TEXT))
    if isinstance(value, np.ndarray) and value.ndim:
        return f"{value.dtype} of shape {value.shape}"
    if isinstance(value, bool) or value is None:
        return str(value)
    if isinstance(value, Integral):
        return str(int(value))
    if isinstance(value, Real):
        return repr(float(value))
    if isinstance(value, Mapping):
        return f"{len(value)} entries"
    if isinstance(value, list | tuple):
        inside = ", ".join(short(item) for item in value) if len(value) <= _ITEMS else f"{len(value)} items"
        return f"({inside})"
    if isinstance(value, Shown) and hasattr(value, "__len__"):
        return f"{type(value).__name__} of {len(value)}"
    return printable(repr(value), 3 * _TEXT)


def span(stamp_s: Any) -> dict[str, Any]:
    """Return the first and the last of the stamps, as facts; nothing of none."""
    return {"from_s": round(float(stamp_s[0]), 3), "to_s": round(float(stamp_s[-1]), 3)} if len(stamp_s) else {}


def extent(values: Any) -> tuple[float, float] | None:
    """Return the smallest and the largest finite value, as a fact; None where there is none."""
    finite = values[np.isfinite(values)]
    return (round(float(finite.min()), 3), round(float(finite.max()), 3)) if len(finite) else None
