"""One look for all figures: colour-blind safe, 8 pt and larger, and at home on light and dark pages.

Figures use matplotlib's object interface only, so no backend, display or global state is touched. Every colour has
a role; a page's theme, or an SVG file's own style sheet, decides what a role looks like in the dark.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO
from weakref import WeakKeyDictionary

import numpy as np

from evermap.errors import printable
from evermap.types import FloatArray
from evermap.types.mark import MARK

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito (2008), and wine and sand: distinguished with every common kind of colour blindness
INK = "#1b1f24"
MUTED = "#636c76"
GRID = "#d8dde3"
SHADE = "#e9ecf0"
PAPER = "#fffffe"
ESTIMATE = "#0072b2"
ESTIMATE_BAND = "#cfe3f1"
ODOMETRY = "#e69f00"
LANDMARK = "#009e73"
ALERT = "#d55e00"
ONLINE = "#cc79a7"
GROUP = "#882255"
SKY = "#56b4e9"
SAND = "#c8b560"
STATIC, DYNAMIC = ESTIMATE, GROUP
"""Blue, and wine instead of the thesis' purple, which colour-blind readers confuse with blue."""

ROLES = {
    INK: ("ink", "#e7ebef"),
    MUTED: ("muted", "#9aa5b1"),
    GRID: ("grid", "#323a44"),
    SHADE: ("shade", "#262d36"),
    PAPER: ("paper", "#14181d"),
    ESTIMATE: ("estimate", "#56b4e9"),
    ESTIMATE_BAND: ("estimate-band", "#1d3b50"),
    ODOMETRY: ("odometry", "#e6a823"),
    LANDMARK: ("landmark", "#2fc39a"),
    ALERT: ("alert", "#ff8a4c"),
    ONLINE: ("online", "#dd97bd"),
    GROUP: ("group", "#b5427f"),
    SKY: ("sky", "#2f74c0"),
    SAND: ("sand", "#f3e6a0"),
}
"""Colours by role: its name, which is a CSS variable of the report, and its colour on dark pages."""

CLASS_COLOURS = (ESTIMATE, ODOMETRY, ONLINE, GROUP, SKY, INK, SAND)
CLASS_MARKERS = ("o", "s", "^", "D", "v", "P", "<", ">")


@dataclass(frozen=True, slots=True)
class ClassLook:
    """Colour and marker of a class in all figures."""

    colour: str
    marker: str


NO_CLASS = ClassLook(LANDMARK, "o")
"""Colour of objects without a class, or with an unnamed one."""


def class_looks(names: Iterable[str]) -> dict[str, ClassLook]:
    """Return the look of each class by its name, and `NO_CLASS` for the empty name.

    The order of the names decides, so that all figures of a run agree when they are given the same classes. Colours
    are distinguished by readers with every common kind of colour blindness; as their number and that of the markers
    have no common divisor, 56 classes look different.
    """
    looks = zip(cycle(CLASS_COLOURS), cycle(CLASS_MARKERS), strict=False)
    known = sorted({name for name in names if name})
    return {"": NO_CLASS, **{name: ClassLook(*look) for name, look in zip(known, looks, strict=False)}}


_RC: Any = {
    "font.family": "DejaVu Sans",
    **dict.fromkeys(("font.size", "axes.labelsize", "axes.titlesize"), 9.0),
    **dict.fromkeys(("xtick.labelsize", "ytick.labelsize", "legend.fontsize"), 8.0),
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "legend.handlelength": 1.8,
    **dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), "none"),
    **dict.fromkeys(("text.color", "axes.labelcolor", "axes.titlecolor", "xtick.labelcolor", "ytick.labelcolor"), INK),
    **dict.fromkeys(("axes.edgecolor", "xtick.color", "ytick.color"), MUTED),
    "grid.color": GRID,
    **dict.fromkeys(("legend.frameon", "axes.spines.top", "axes.spines.right"), False),
    **dict.fromkeys(("figure.autolayout", "figure.constrained_layout.use"), False),
    **dict.fromkeys(("axes.grid", "axes.axisbelow"), True),
    "axes.linewidth": 0.7,
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.2,
    "lines.solid_joinstyle": "round",
    "svg.fonttype": "path",
    "svg.hashsalt": "evermap",
    "path.simplify": True,
    "path.simplify_threshold": 0.3,
    "text.parse_math": False,  # names of landmarks and classes are shown as they are
}


@dataclass(frozen=True, slots=True)
class NamedFigure:
    """A finished figure with its file name (no suffix), its title and the caption that explains it."""

    name: str
    figure: Figure
    title: str
    caption: str


@contextmanager
def house_style() -> Iterator[None]:
    """Yield matplotlib settings of this module while drawing, and only then."""
    import matplotlib as mpl

    if mpl.rcParams["svg.hashsalt"] == _RC["svg.hashsalt"]:  # within another one; entering takes some 5 ms
        yield
        return
    with mpl.rc_context(_RC), warnings.catch_warnings():
        # a name may have letters of any script; those that the font lacks are boxes
        warnings.filterwarnings("ignore", r"Glyph \d+ .* missing from", UserWarning)
        yield


def legend_name(name: str) -> str:
    """Return a name for a legend or a title: as it is, on one line, and also where it begins with an underscore.

    Matplotlib leaves what is labelled with a leading underscore out of legends.
    """
    text = printable(name, 60)
    return f"\N{ZERO WIDTH SPACE}{text}" if text.startswith("_") else text


def legend_of(*panels: Axes) -> tuple[list[Any], list[str]]:
    """Return handles and labels of several panels for one legend, each label once."""
    found: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    return list(found.values()), list(found)


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure with an Agg canvas and constrained layout. Call within `house_style`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


@contextmanager
def drawing(width_in: float, height_in: float, *, title: str | None = None) -> Iterator[Figure]:
    """Yield an empty figure to draw into, in the house style; at the end its layout is computed.

    Args:
        width_in: size in inches.
        height_in: size in inches.
        title: above all panels.
    """
    with house_style():
        figure = new_figure(width_in, height_in)
        yield figure
        if title:
            figure.suptitle(title, fontweight="bold")
        settle(figure)


def settle(figure: Figure) -> None:
    """Compute the layout once, so that saving in several formats does not repeat it, and move labels apart."""
    _write_powers(figure)
    engine: Any = figure.get_layout_engine()
    for axes in figure.axes:
        axes.apply_aspect()
    if engine is not None:
        engine.execute(figure)
    figure.set_layout_engine(None)  # "none" leaves an engine that does nothing, for which every file is drawn twice
    for axes in figure.axes:
        _declutter(axes, [text for text in axes.texts if text.get_gid() == _POINT_LABEL])


def label_points(axes: Axes, points: Any, texts: Iterable[str]) -> None:
    """Write a text beside each of K points (x, y); `settle` moves them apart, with a thin line to what is far off."""
    from matplotlib.patheffects import withStroke

    line = {"arrowstyle": "-", "color": MUTED, "lw": 0.6, "shrinkA": 0.5, "shrinkB": 2.0}
    halo = [withStroke(linewidth=2.2, foreground=PAPER)]
    for point, text in zip(points, texts, strict=True):
        label = axes.annotate(
            printable(text, 24), point, (0.0, 8.0), textcoords="offset points", ha="center", va="center", size=8,
            color=INK, path_effects=halo, arrowprops=line, zorder=10,
        )  # fmt: skip
        label.set_gid(_POINT_LABEL)


_POINT_LABEL = "label of a point"
"""Marks labels that `settle` still has to place; ids in files are unrelated."""
_MARK_PT = 3.5
"""Half the side of the square about a point that labels avoid."""
_NEAR_PT = 9.0
"""Maximum distance of a label from its point without a line."""
_RINGS_PT = (4.0, 9.0, 16.0, 25.0, 36.0)


def _declutter(axes: Axes, labels: Sequence[Any]) -> None:
    """Move each label to the nearest free position around its point.

    If none is free, to the one with least overlap.
    """
    from matplotlib.text import Text

    if not labels:
        return
    figure: Any = axes.figure
    place: Any = axes
    renderer, pt = figure.canvas.get_renderer(), figure.dpi / 72.0
    points = axes.transData.transform([(place.convert_xunits(x), y) for x, y in (label.xy for label in labels)])
    marks = np.concatenate([points - _MARK_PT * pt, points + _MARK_PT * pt], axis=1)
    frame = np.array(axes.bbox.extents)
    boxes = np.zeros((0, 4))
    for label, point in zip(labels, points, strict=True):
        extent = Text.get_window_extent(label, renderer)
        half = 0.5 * np.array([extent.width, extent.height])
        angle = np.radians(np.arange(0.0, 360.0, 22.5) + 45.0)
        way = np.tile(np.stack([np.cos(angle), np.sin(angle)], axis=1), (len(_RINGS_PT), 1))
        ring = np.repeat(_RINGS_PT, len(angle))
        middle = point + way * (ring[:, None] * pt + half)
        here = np.concatenate([middle - half, middle + half], axis=1)
        outside = np.maximum(frame[:2] - here[:, :2], 0.0) + np.maximum(here[:, 2:] - frame[2:], 0.0)
        cost = _find_overlaps(here, boxes) + _find_overlaps(here, marks) + 1e3 * outside.sum(axis=1) + 1e-3 * ring
        label.set_gid(None)
        best = int(np.argmin(cost))
        boxes = np.concatenate([boxes, here[best : best + 1]])
        label.set_position((middle[best] - point) / pt)
        label.update_positions(renderer)
        label.arrow_patch.set_visible(bool(ring[best] > _NEAR_PT))


def _find_overlaps(boxes: FloatArray, others: FloatArray) -> FloatArray:
    """(K,) area that each box shares with all others; corners as (x0, y0, x1, y1)."""
    low = np.maximum(boxes[:, None, :2], others[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], others[None, :, 2:])
    return np.asarray(np.prod(np.maximum(high - low, 0.0), axis=2).sum(axis=1))


def _write_powers(figure: Figure) -> None:
    """Have logarithmic axes say 10⁻³ in plain text: mathematics is off, so that names need no escapes."""
    from matplotlib.ticker import LogFormatterMathtext

    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            major, minor = axis.get_major_formatter(), axis.get_minor_formatter()
            if isinstance(major, LogFormatterMathtext) and not isinstance(major, _powers()):
                axis.set_major_formatter(_powers().like(major))
            if isinstance(minor, LogFormatterMathtext) and not isinstance(minor, _powers()):
                axis.set_minor_formatter(_powers().like(minor))


@cache
def _powers() -> Any:
    """Matplotlib's formatter of logarithmic axes, in Unicode."""
    from matplotlib.ticker import LogFormatterSciNotation

    class Powers(LogFormatterSciNotation):
        @classmethod
        def like(cls, other: LogFormatterSciNotation) -> Powers:
            one = cls()
            vars(one).update(vars(other))
            return one

        def __call__(self, x: float, pos: Any = None) -> str:
            text = str(super().__call__(x, pos)).removeprefix(r"$\mathdefault{").removesuffix("}$")
            text = text.replace(r"\times", "×").replace("\N{MINUS SIGN}", "-")
            return re.sub(r"\^\{(.*?)\}", lambda found: found[1].translate(_RAISED), text)

    return Powers


_RAISED = str.maketrans("0123456789-.", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻·")


def save_png(figure: Figure, path: Path | BinaryIO, *, dpi: int = 160) -> None:
    """Write a PNG on white paper; the same figure gives the same bytes."""
    _write_powers(figure)
    with house_style():
        figure.savefig(path, format="png", dpi=dpi, facecolor="white", metadata={"Software": MARK})


def save_svg(figure: Figure, path: Path | BinaryIO) -> None:
    """Write a stand-alone SVG that follows the reader's light or dark theme; the same figure gives the same bytes.

    Its colours are those on white paper; a style sheet inside replaces them in the dark, so that programs that know
    no style sheets draw it as in print. Text is in the current colour, for pages that contain the drawing.
    """
    text = _svg(figure)
    at = text.index(">", text.index("<svg")) + 1
    content = (text[:at] + f"\n<style>{_file_theme()}</style>" + text[at:]).encode()
    if isinstance(path, Path):
        path.write_bytes(content)
    else:
        path.write(content)


def inline_svg(figure: Figure, name: str) -> str:
    """Return the figure as a themed `<svg>` element for an HTML page: no prolog, no address, ids prefixed by `name`."""
    text = _svg(figure)
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", text)
    text = text.replace("xlink:href", "href")
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r"url\(#", f"url(#{name}-", text)
    text = re.sub(r'href="#', f'href="#{name}-', text)
    for colour, (role, _) in ROLES.items():
        text = text.replace(colour, "currentColor" if colour == INK else f"var(--{role})")
    # the page scales the drawing; the view box keeps its proportions
    return re.sub(r'<svg height="[^"]*"', "<svg", re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1), count=1)


def page_theme() -> str:
    """Return the style sheet of a page's variables, one a role, with those of dark pages."""
    light = ";".join(f"--{role}:{colour}" for colour, (role, _) in ROLES.items())
    dark = ";".join(f"--{role}:{colour}" for role, colour in ROLES.values())
    return f":root{{{light};color-scheme:light dark}}\n@media screen and (prefers-color-scheme:dark){{:root{{{dark}}}}}"


def _svg(figure: Figure) -> str:
    """The drawing as matplotlib writes it; drawn once, unless the figure was changed since."""
    if figure in _DRAWN and not figure.stale:
        return _DRAWN[figure]
    _write_powers(figure)
    buffer = io.StringIO()
    metadata = {"Date": None, "Creator": MARK, "Format": None, "Type": None}
    with house_style():
        figure.savefig(buffer, format="svg", facecolor=PAPER, metadata=metadata)
    figure.stale = False  # from here on it says whether anybody changes the figure
    _DRAWN[figure] = buffer.getvalue()
    return _DRAWN[figure]


_DRAWN: WeakKeyDictionary[Figure, str] = WeakKeyDictionary()


def _file_theme() -> str:
    """Rules for the colours that matplotlib writes into the style of each element."""
    rules = "".join(
        f'[style*="{what}: {light}"]{{{what}:{dark}}}'
        for light, (_, dark) in ROLES.items()
        for what in ("fill", "stroke")
        if light != INK
    ).replace("}", " !important}")
    ink = "".join(f'[style*="{what}: {INK}"]{{{what}:currentColor !important}}' for what in ("fill", "stroke"))
    dark_ink = ROLES[INK][1]
    return f"svg{{color:{INK}}}{ink}@media (prefers-color-scheme:dark){{svg{{color:{dark_ink}}}{rules}}}"
