"""One look for all figures: colour-blind safe, 8 pt and larger, and at home on light and dark pages.

Figures use matplotlib's object interface only, so no backend, display or global state is touched. Every colour has
a role; in SVG for the report a role becomes a CSS variable, so that the page's theme decides what it looks like.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from evermap.errors import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito (2008), told apart with every common kind of colour blindness; the violet of a third group is darker
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
GROUP = "#7a4fb5"

CSS_ROLES = {
    INK: "--ink",
    MUTED: "--muted",
    GRID: "--grid",
    SHADE: "--shade",
    PAPER: "--paper",
    ESTIMATE: "--estimate",
    ESTIMATE_BAND: "--estimate-band",
    ODOMETRY: "--odometry",
    LANDMARK: "--landmark",
    ALERT: "--alert",
    ONLINE: "--online",
    GROUP: "--group",
}

_RC: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.labelsize": 9.0,
    "axes.titlesize": 9.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "axes.titlecolor": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
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
    """Matplotlib settings of this module while drawing, and only then."""
    import matplotlib as mpl

    with mpl.rc_context(_RC), warnings.catch_warnings():
        # a name may have letters of any script; those that the font lacks are boxes
        warnings.filterwarnings("ignore", r"Glyph \d+ .* missing from", UserWarning)
        yield


def legend_name(name: str) -> str:
    """A name for a legend or a title: as it is, on one line, and also where it begins with an underscore.

    Matplotlib leaves what is labelled with a leading underscore out of legends.
    """
    text = printable(name, 60)
    return f"\N{ZERO WIDTH SPACE}{text}" if text.startswith("_") else text


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure with an Agg canvas and constrained layout. Call within `house_style`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def settle(figure: Figure) -> None:
    """Computes the layout once, so that saving in several formats does not repeat it."""
    _write_powers(figure)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")


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
    """Writes a PNG on white paper; the same figure gives the same bytes."""
    _write_powers(figure)
    with house_style():
        figure.savefig(path, format="png", dpi=dpi, facecolor="white", metadata={"Software": None})


def save_svg(figure: Figure, path: Path | BinaryIO) -> None:
    """Writes a stand-alone SVG on white paper; the same figure gives the same bytes."""
    _write_powers(figure)
    with house_style():
        figure.savefig(path, format="svg", facecolor="white", metadata={"Date": None, "Creator": None})


def save_all(figures: Mapping[str, Figure], path: Callable[[str], Path]) -> None:
    """Writes every figure as PNG and SVG, to where `path` puts a file of its name."""
    for name, figure in figures.items():
        save_png(figure, path(f"{name}.png"), dpi=130)
        save_svg(figure, path(f"{name}.svg"))


def inline_svg(figure: Figure, name: str) -> str:
    """The figure as an `<svg>` element for an HTML page: no prolog, no address, ids prefixed by `name`, themed."""
    _write_powers(figure)
    buffer = io.StringIO()
    with house_style():
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", text)
    text = text.replace("xlink:href", "href")
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r"url\(#", f"url(#{name}-", text)
    text = re.sub(r'href="#', f'href="#{name}-', text)
    for colour, role in CSS_ROLES.items():
        text = text.replace(colour, f"var({role})")
    # the page scales the drawing; the view box keeps its proportions
    return re.sub(r'<svg height="[^"]*"', "<svg", re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1), count=1)
