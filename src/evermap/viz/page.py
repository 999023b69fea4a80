"""The page of a report and its parts: cards, notes, tables, figures. Self-contained, light and dark, printable."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from string import Template

from evermap.viz.style import NamedFigure, inline_svg, page_theme

# colours of figures are variables of the page, so that its theme decides what they look like
STYLE = (
    page_theme()
    + """
:root { --card:#f6f8fa }
@media screen and (prefers-color-scheme:dark) { :root { --card:#1c2229 } }
* { box-sizing:border-box }
html { -webkit-text-size-adjust:100% }
body { margin:0; background:var(--paper); color:var(--ink); font:16px/1.55 system-ui,-apple-system,"Segoe UI",
  "Noto Sans","DejaVu Sans",sans-serif }
main { max-width:61rem; margin:0 auto; padding:2.5rem 1.25rem 4rem }
h1 { font-size:2rem; line-height:1.2; letter-spacing:-.02em; margin:0 0 .35rem; text-wrap:balance }
h2 { font-size:1.3rem; letter-spacing:-.01em; margin:3rem 0 .75rem; padding-top:1.1rem;
  border-top:1px solid var(--grid) }
h3 { font-size:1rem; margin:1.6rem 0 .4rem }
p { margin:.5rem 0; max-width:46rem }
a { color:var(--estimate) }
code, pre { font-family:ui-monospace,"SF Mono",Menlo,Consolas,"DejaVu Sans Mono",monospace; font-size:.86em }
pre { background:var(--card); border:1px solid var(--grid); border-radius:.5rem; padding:.8rem 1rem; overflow-x:auto;
  white-space:pre-wrap; overflow-wrap:anywhere }
.kicker { color:var(--estimate); font-weight:600; font-size:.8rem; letter-spacing:.09em; text-transform:uppercase;
  margin:0 0 .4rem }
.lead { color:var(--muted); margin:0 0 1.6rem }
.cards { display:grid; grid-template-columns:repeat(auto-fit,minmax(17rem,1fr)); gap:.85rem; padding:0; margin:0 }
.card { background:var(--card); border:1px solid var(--grid); border-radius:.7rem; padding:.9rem 1.05rem 1rem }
.card dt { color:var(--muted); font-size:.83rem }
.card dd { margin:0 }
.card .number { font-size:1.85rem; font-weight:650; letter-spacing:-.02em; line-height:1.3;
  font-variant-numeric:tabular-nums }
.card .number small { font-size:.55em; font-weight:500; color:var(--muted); letter-spacing:0 }
.card p { font-size:.85rem; line-height:1.45; margin:.25rem 0 0; color:var(--muted) }
.note { border-left:3px solid var(--odometry); background:var(--card); border-radius:0 .5rem .5rem 0;
  padding:.6rem 1rem; margin:1rem 0; max-width:none }
.note ul { margin:.2rem 0; padding-left:1.1rem }
figure { margin:1.4rem 0 2.2rem }
figure svg, figure img { display:block; width:100%; max-width:54rem; height:auto }
figure img { background:#fff; border-radius:.5rem }
figcaption { color:var(--muted); font-size:.88rem; max-width:50rem; margin-top:.5rem }
figcaption strong { color:var(--ink) }
.scroll { overflow-x:auto }
table { border-collapse:collapse; font-size:.88rem; font-variant-numeric:tabular-nums; width:100% }
th { text-align:left; font-weight:600; color:var(--muted); border-bottom:1px solid var(--muted) }
th, td { padding:.34rem .9rem .34rem 0; vertical-align:baseline }
td { border-bottom:1px solid var(--grid) }
td.n, th.n { text-align:right }
td small { color:var(--muted); font-size:.9em }
details { margin:.7rem 0 }
summary { cursor:pointer; font-weight:600 }
footer { color:var(--muted); font-size:.85rem; margin-top:3rem; padding-top:1rem; border-top:1px solid var(--grid) }
@media print {
  body { font-size:10.5pt } main { max-width:none; padding:0 }
  .card, figure, tr, .note { break-inside:avoid } h2, h3 { break-after:avoid }
  .cards { grid-template-columns:repeat(3,1fr) }
}
"""
)

# the policy makes a browser refuse whatever is not in this very file
PAGE = Template(
    """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="generator" content="evermap $version">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'; img-src data:">
<title>$title</title>
<style>$style</style>
</head>
<body>
<main>
<header>
<p class="kicker">evermap run</p>
<h1>$heading</h1>
<p class="lead">$lead</p>
</header>
$body
<footer>$footer</footer>
</main>
</body>
</html>
"""
)


def table(head: Sequence[str], rows: Iterable[Sequence[str]], *, numbers: Sequence[int] = ()) -> str:
    """Return a table of ready markup; `numbers` are the columns to align right."""

    def row(tag: str, cells: Sequence[str]) -> str:
        kind = [' class="n"' if column in numbers else "" for column in range(len(cells))]
        return "<tr>" + "".join(f"<{tag}{k}>{cell}</{tag}>" for k, cell in zip(kind, cells, strict=True)) + "</tr>"

    body = "".join(row("td", cells) for cells in rows)
    return f'<div class="scroll"><table><thead>{row("th", head)}</thead><tbody>{body}</tbody></table></div>'


def card(label: str, value: float | None, form: str, unit: str, meaning: str) -> str | None:
    """Return a number with its unit and what it means; None where there is no number."""
    if value is None:
        return None
    number = f'<dd class="number">{escape(form.format(value))} <small>{escape(unit)}</small></dd>'
    return f'<div class="card"><dt>{escape(label)}</dt>{number}<dd><p>{escape(meaning)}</p></dd></div>'


def cards_html(cards: Iterable[str | None]) -> str:
    """Return the cards that there are as a definition list; '' for none."""
    shown = [one for one in cards if one is not None]
    return f'<dl class="cards">{"".join(shown)}</dl>' if shown else ""


def warnings_note(warnings: Sequence[str]) -> str:
    """Return a box with what a run warned of; '' for nothing."""
    if not warnings:
        return ""
    items = "".join(f"<li>{escape(text)}</li>" for text in warnings)
    return f'<div class="note"><strong>Warnings</strong><ul>{items}</ul></div>'


_REM_PER_INCH = 7.5
"""Common text scale of all figures."""


def figure_html(named: NamedFigure) -> str:
    """Return a figure as a drawing that follows the theme of the page, with its title and caption."""
    label = escape(named.title, quote=True)
    width_rem = _REM_PER_INCH * float(named.figure.get_size_inches()[0])
    start = f'<svg role="img" aria-label="{label}" style="max-width:{width_rem:.0f}rem"'
    drawing = inline_svg(named.figure, named.name).replace("<svg", start, 1)
    return (
        f'<figure id="{escape(named.name, quote=True)}">{drawing}'
        f"<figcaption><strong>{escape(named.title)}.</strong> {escape(named.caption)}</figcaption></figure>"
    )
