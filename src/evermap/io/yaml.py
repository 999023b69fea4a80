"""The part of YAML that calibration files are written in: nested maps and lists of numbers and words.

Read here and not by a library, so that a folder of recordings is read by a plain installation. What is not understood
(anchors, tags, texts of several lines) is refused, never guessed.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

from evermap.errors import InputError
from evermap.io.text import decode_text, quote

_INTEGER = re.compile(r"[-+]?\d{1,18}")
_FLOAT = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_WORDS: dict[str, Any] = {
    "": None, "~": None, "null": None, "true": True, "false": False,
    ".inf": float("inf"), "-.inf": -float("inf"), ".nan": float("nan"),
}  # fmt: skip
_KEY = re.compile(r"(\"[^\"]*\"|'[^']*'|[^\s\[\]{}#&*!|>%@`\"'-][^:#]*?|-[^\s:#][^:#]*?)\s*:(?:\s+(.*))?$")
_UNREAD = tuple("&*!|>%@`")
_TOKEN = re.compile(
    r"\s*(\"[^\"]*\"|'[^']*'|[\[\]{},]|:(?=[\s\[\]{},]|$)|(?<=[\"']):|[^\s\[\]{},\"':](?:[^\[\]{},:]|:(?![\s\[\]{},]|$))*)"
)
"""What lists in brackets and maps in braces are made of."""
_CLOSING = {"[": "]", "{": "}"}


class _Line(NamedTuple):
    number: int
    indent: int
    content: str


def parse_yaml(data: bytes, path: Path) -> Any:
    """Return a document as maps, lists, numbers, words, booleans and None; an empty one is an empty map.

    Raises:
        InputError: the file is not text or not of this part of YAML, with the line.
    """
    lines = _lines(decode_text(data, path), path)
    if not lines:
        return {}
    try:
        value, after = _block(lines, 0, path)
    except RecursionError:
        raise InputError("is nested too deeply", path=path) from None
    if after < len(lines):
        raise _error(lines[after], "is indented less than its parent", path)
    return value


def _lines(text: str, path: Path) -> list[_Line]:
    """Lines with content, without comments; what is in brackets or braces is one line."""
    found: list[_Line] = []
    open_since: _Line | None = None
    for number, raw in enumerate(text.split("\n"), 1):
        content = re.sub(r"(?:^|\s)#.*$", "", raw) if '"' not in raw and "'" not in raw else _without_comment(raw)
        content = content.rstrip()
        if not content.strip() or (content.strip() == "---" and not found):
            continue
        if "\t" in content:
            raise InputError("contains a tab", path=path, line=number, hint="indent by spaces")
        if open_since is not None:
            open_since = open_since._replace(content=f"{open_since.content} {content.strip()}")
        else:
            indent = len(content) - len(content.lstrip())
            open_since = _Line(number, indent, content.strip())
        if all(open_since.content.count(one) <= open_since.content.count(end) for one, end in _CLOSING.items()):
            found.append(open_since)
            open_since = None
    if open_since is not None:
        raise _error(open_since, "opens a bracket that is never closed", path)
    return found


def _without_comment(raw: str) -> str:
    held = ""
    for place, sign in enumerate(raw):
        if held:
            held = "" if sign == held else held
        elif sign in "\"'":
            held = sign
        elif sign == "#" and (place == 0 or raw[place - 1].isspace()):
            return raw[:place]
    return raw


def _block(lines: list[_Line], start: int, path: Path) -> tuple[Any, int]:
    """The map, list or scalar that begins at a line, and the line after it."""
    first = lines[start]
    if _is_item(first):
        return _list(lines, start, path)
    if _KEY.match(first.content):
        return _map(lines, start, path)
    return _value(first.content, first, path), start + 1


def _is_item(line: _Line) -> bool:
    return line.content == "-" or line.content.startswith("- ")


def _list(lines: list[_Line], start: int, path: Path) -> tuple[list[Any], int]:
    found: list[Any] = []
    indent, at = lines[start].indent, start
    while at < len(lines) and lines[at].indent == indent and _is_item(lines[at]):
        rest = lines[at].content[1:].lstrip()
        if rest:
            inner = indent + len(lines[at].content) - len(rest)
            lines[at] = _Line(lines[at].number, inner, rest)
            value, at = _block(lines, at, path)
        else:
            value, at = _inside(lines, at + 1, indent, path)
        found.append(value)
    _refuse_deeper(lines, at, indent, path)
    return found, at


def _map(lines: list[_Line], start: int, path: Path) -> tuple[dict[str, Any], int]:
    found: dict[str, Any] = {}
    indent, at = lines[start].indent, start
    while at < len(lines) and lines[at].indent == indent and not _is_item(lines[at]):
        line = lines[at]
        match = _KEY.match(line.content)
        if match is None:
            raise _error(line, f"{quote(line.content)} is neither 'key: value' nor '- item'", path)
        key = match[1].strip("\"'")
        if key in found:
            raise InputError("appears twice", path=path, line=line.number, field=key)
        if match[2]:
            found[key], at = _value(match[2].strip(), line, path), at + 1
        elif at + 1 < len(lines) and lines[at + 1].indent == indent and _is_item(lines[at + 1]):
            found[key], at = _list(lines, at + 1, path)
        else:
            found[key], at = _inside(lines, at + 1, indent, path)
    _refuse_deeper(lines, at, indent, path)
    return found, at


def _inside(lines: list[_Line], start: int, indent: int, path: Path) -> tuple[Any, int]:
    """Return the block indented deeper than `indent` from a line on; None if there is none."""
    if start < len(lines) and lines[start].indent > indent:
        return _block(lines, start, path)
    return None, start


def _refuse_deeper(lines: list[_Line], at: int, indent: int, path: Path) -> None:
    if at < len(lines) and lines[at].indent > indent:
        raise _error(lines[at], "is indented more than its siblings", path)


def _value(text: str, line: _Line, path: Path) -> Any:
    """A scalar, a list in brackets, or a map in braces."""
    if text.startswith(_UNREAD):
        raise _error(line, f"{quote(text)} is unsupported YAML", path)
    if text[:1] not in _CLOSING:
        return _scalar(text)
    tokens = [found[1].rstrip() for found in _TOKEN.finditer(text)]
    if "".join(tokens).replace(" ", "") != re.sub(r"\s", "", text):
        raise _error(line, f"{quote(text)} is unsupported YAML", path)
    value, after = _collection(tokens, 0, line, path)
    if after < len(tokens):
        raise _error(line, f"text after the last bracket: {quote(tokens[after])}", path)
    return value


def _collection(tokens: list[str], start: int, line: _Line, path: Path) -> tuple[Any, int]:
    """The list or map that is opened at a token, and the token after it."""
    end, at = _CLOSING[tokens[start]], start + 1
    items, pairs = list[Any](), dict[str, Any]()
    while at < len(tokens) and tokens[at] != end:
        if end == "}":
            key = tokens[at].strip("\"'")
            if at + 2 >= len(tokens) or tokens[at + 1] != ":" or tokens[at] in ("[", "{", "]", ",", ":"):
                raise _error(line, f"{quote(tokens[at])} in braces is no 'key: value'", path)
            if key in pairs:
                raise InputError("appears twice", path=path, line=line.number, field=key)
            empty = tokens[at + 2] in (",", "}")
            pairs[key], at = (None, at + 2) if empty else _item(tokens, at + 2, line, path)
        else:
            value, at = _item(tokens, at, line, path)
            items.append(value)
        if at < len(tokens) and tokens[at] == ",":
            at += 1
        elif at < len(tokens) and tokens[at] != end:
            raise _error(line, f"brackets do not match at {quote(tokens[at])}", path)
    if at == len(tokens):
        raise _error(line, "opens a bracket that is never closed", path)
    return (pairs if end == "}" else items), at + 1


def _item(tokens: list[str], at: int, line: _Line, path: Path) -> tuple[Any, int]:
    """A scalar or a collection within one, and the token after it."""
    if tokens[at] in _CLOSING:
        return _collection(tokens, at, line, path)
    if tokens[at] in ("]", "}", ",", ":"):
        raise _error(line, f"brackets do not match at {quote(tokens[at])}", path)
    if tokens[at].startswith(_UNREAD):
        raise _error(line, f"{quote(tokens[at])} is unsupported YAML", path)
    return _scalar(tokens[at]), at + 1


def _scalar(text: str) -> Any:
    if text[:1] in "\"'" and len(text) >= 2 and text[-1] == text[0]:
        return text[1:-1]
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    if _INTEGER.fullmatch(text):
        return int(text)
    return float(text) if _FLOAT.fullmatch(text) else text


def _error(line: _Line, problem: str, path: Path) -> InputError:
    return InputError(problem, path=path, line=line.number, hint="plain maps and lists, indented by spaces")
