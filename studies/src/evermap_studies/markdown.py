"""Tables of the experiments as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def number(form: str, value: float | None) -> str:
    """A number in a format such as `{:.3f}`, a dash where there is none."""
    return "–" if value is None else form.format(value)


def markdown_table(header: Sequence[str], lines: Iterable[Sequence[str]], words: tuple[int, ...] = (0,)) -> str:
    """A Markdown table; numbers to the right, columns of words to the left. No trailing line end."""
    rule = ["---" if column in words else "---:" for column in range(len(header))]
    return "\n".join("| " + " | ".join(row) + " |" for row in (header, rule, *lines))
