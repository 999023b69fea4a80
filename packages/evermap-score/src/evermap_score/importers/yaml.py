"""The part of YAML that `tagslam.yaml` is written in: mappings, lists, numbers and words, by indentation.

A dependency for one format would be a dependency for all who score anything else.
"""

from __future__ import annotations

from typing import Any

Lines = list[tuple[int, str]]
"""Indentation and content of each line."""


def parse_yaml(text: str) -> dict[str, Any]:
    """Return the mapping of a document; lists in brackets are kept as text.

    Raises:
        ValueError: a line is neither `key: value` nor an element of a list, or its indentation fits nothing.
    """
    lines: Lines = []
    for raw in text.splitlines():
        line = raw.split(" #")[0].rstrip() if not raw.lstrip().startswith("#") else ""
        if line.strip() and line.strip() != "---":
            lines.append((len(line) - len(line.lstrip()), line.strip()))
    found, rest = _parse_block(lines, 0)
    if rest < len(lines) or not isinstance(found, dict):
        raise ValueError(f"not understood: {lines[rest][1] if rest < len(lines) else text[:40]}")
    return found


def _parse_block(lines: Lines, start: int) -> tuple[Any, int]:
    """Return the value that begins in a line, and the line after it."""
    indent = lines[start][0] if start < len(lines) else 0
    if start < len(lines) and lines[start][1].startswith("-"):
        elements = []
        while start < len(lines) and lines[start][0] == indent and lines[start][1].startswith("-"):
            content = lines[start][1][1:]
            inner = content.lstrip()
            if not inner:
                element, start = _parse_block(lines, start + 1)
            elif ":" in inner:  # a mapping whose first key is behind the dash
                lines[start] = (indent + 1 + len(content) - len(inner), inner)
                element, start = _parse_block(lines, start)
            else:
                element, start = _scalar(inner), start + 1
            elements.append(element)
        return elements, start
    mapping: dict[str, Any] = {}
    while start < len(lines) and lines[start][0] == indent and not lines[start][1].startswith("-"):
        key, colon, value = lines[start][1].partition(":")
        if not colon:
            raise ValueError(f"not understood: {lines[start][1]}")
        start += 1
        if value.strip():
            mapping[key.strip()] = _scalar(value.strip())
        elif start < len(lines) and (
            lines[start][0] > indent or (lines[start][0] == indent and lines[start][1].startswith("-"))
        ):
            mapping[key.strip()], start = _parse_block(lines, start)
        else:
            mapping[key.strip()] = None
    return mapping, start


def _scalar(text: str) -> Any:
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    try:
        return int(text)
    except ValueError:
        pass
    try:
        return float(text)
    except ValueError:
        return text.strip("'\"")
