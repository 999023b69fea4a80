"""Pages that MkDocs builds from the code: Python, command line, configuration; and a check for a network.

A hook of MkDocs (see `mkdocs.yml`). Nothing is written into `docs/`: the pages exist in the site only.
"""

from __future__ import annotations

import html
import importlib
import inspect
import json
import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[2]
PARTS = {
    "Estimate": ("evermap.pipeline", "evermap.runs"),
    "Read and write": ("evermap.io",),
    "Maps": ("evermap.maps",),
    "Filters, trackers and priors": ("evermap.existence", "evermap.tracking", "evermap.survival", "evermap.slam"),
    "Values": ("evermap.types",),
    "Configuration and errors": ("evermap.config", "evermap.errors"),
}
NAMES = {
    bool: "true or false",
    int: "whole number",
    float: "number",
    str: "text",
    dict[str, float]: "table of numbers",
    tuple[float, float, float]: "three numbers",
}
FROM_ANOTHER_HOST = re.compile(
    r"<(?:script|img|iframe)[^>]+src=[\"']?(?:https?:)?//|<link[^>]+rel=[\"']?(?:style|pre)[^>]+//"
)
"""What a browser would load by itself; links that a reader may follow are none of it."""


def on_config(config: Any) -> Any:
    """Put the pages of the rooms into the navigation."""
    rooms = [{f"evermap.{room}": f"reference/modules/{room}.md"} for room in rooms_of_the_library()]
    for part in config.nav:
        for entry in part.get("Reference", ()):
            if "Modules" in entry:
                entry["Modules"] = [entry["Modules"], *rooms]
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the generated pages to those of `docs/`."""
    pages = {
        "reference/api.md": api_page(),
        "reference/cli.md": cli_page(),
        "reference/configuration.md": configuration_page(),
        "contributing.md": moved_into_docs(ROOT / "CONTRIBUTING.md"),
        "changelog.md": moved_into_docs(ROOT / "CHANGELOG.md"),
        **module_pages(),
    }
    for uri, content in pages.items():
        files.append(File.generated(config, uri, content=content))
    return files


def on_post_page(output: str, page: Any, config: Any) -> str:
    """Refuse a page that would load something from another host."""
    del config
    if found := FROM_ANOTHER_HOST.search(output):
        raise PluginError(f"{page.file.src_uri}: loads from another host: {found[0]}")
    return output


def moved_into_docs(path: Path) -> str:
    """Return a page of the repository's root with its links as they are from `docs/`."""
    return path.read_text(encoding="utf-8").replace("](docs/", "](")


def api_page() -> str:
    """Return the page of the public names of `evermap`, grouped by what they are for."""
    evermap = importlib.import_module("evermap")
    names = [name for name in evermap.__all__ if not name.startswith("_")]
    homes = {name: _home(getattr(evermap, name), name, evermap) for name in names}
    lines = ["# Python", "", "What `import evermap as em` offers. Names are loaded when they are first used.", ""]
    for part, modules in [*PARTS.items(), ("More", ("",))]:
        here = [name for name in names if homes[name].startswith(modules)]
        names = [name for name in names if name not in here]
        if here:
            lines += [f"## {part}", ""]
        for name in here:
            lines += [f"::: {homes[name]}", *_options(homes[name]), ""]
    return "\n".join(lines)


def _home(value: Any, name: str, package: Any) -> str:
    """Return where a public name is defined, 'evermap.module.name'."""
    module = getattr(value, "__module__", None) or package._MODULE_OF[name]
    return f"{module}.{getattr(value, '__qualname__', name)}"


def _options(path: str) -> list[str]:
    """Return options of how a name is shown: the members of configurations have a page of their own."""
    return ["    options:", "      members: false"] if path.startswith("evermap.config.") else []


def rooms_of_the_library() -> list[str]:
    """Return the names of the packages inside `evermap`, but for the command line, which has a page of its own."""
    package = importlib.import_module("evermap")
    return [found.name for found in pkgutil.iter_modules(package.__path__) if found.ispkg and found.name != "cli"]


def module_pages() -> dict[str, str]:
    """Return a page for each room of the library with all its modules, and an index of the rooms."""
    pages, index = {}, ["# Modules", "", "What each room of the library holds, module by module.", ""]
    for room in rooms_of_the_library():
        package = importlib.import_module(f"evermap.{room}")
        modules = sorted(found.name for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."))
        index.append(f"- [`evermap.{room}`]({room}.md): {_first_line(package)}")
        lines = [f"# evermap.{room}", "", inspect.getdoc(package) or "", ""]
        lines += ["| module | what |", "| --- | --- |"]
        lines += [f"| {_reference(name)} | {_first_line(importlib.import_module(name))} |" for name in modules]
        lines.append("")
        for name in modules:
            if not name.endswith("kernels"):  # compiled loops: what they compute is said by those who call them
                lines += [
                    f"::: {name}",
                    "    options:",
                    "      heading_level: 2",
                    "      show_root_full_path: true",
                    "",
                ]
        pages[f"reference/modules/{room}.md"] = "\n".join(lines)
    return {"reference/modules/index.md": "\n".join(index) + "\n", **pages}


def _reference(module: str) -> str:
    return f"`{module}`" if module.endswith("kernels") else f"[`{module}`][{module}]"


def _first_line(value: Any) -> str:
    text = inspect.getdoc(value) or ""
    return " ".join(text.partition("\n\n")[0].split())


def configuration_page() -> str:
    """Return the page of all configuration keys, and of the rules beside them: default, bounds and meaning."""
    from evermap.config import Config
    from evermap.config.section import is_rule

    lines = [
        "# Configuration",
        "",
        "Every key with its default, its bounds and its meaning. Keys are set in a TOML file (`--config`) or one by",
        "one (`--set slam.seed=3`); `evermap slam --show-config` prints them as a file to start from. Rules are",
        "numbers of the method, which come with evermap; an experiment in Python may change them",
        "(`evermap.config.with_rules`).",
        "",
    ]
    for section, model in _sections(Config, ()):
        fields = model.model_fields.items()
        rows, rules = (
            [row for name, field in fields if is_rule(field) == of_rules and (row := _key(name, field))]
            for of_rules in (False, True)
        )
        if not rows and not rules:
            continue
        lines += [f"## {'.'.join(section) or 'top'}", "", _first_line(model), ""]
        for of, table in (("key", rows), ("rule", rules)):
            if table:
                lines += [f"| {of} | default | bounds | meaning |", "| --- | --- | --- | --- |", *table, ""]
    return "\n".join(lines)


def _sections(model: Any, prefix: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield every section of a configuration with its path, depth first."""
    yield prefix, model
    for name, field in model.model_fields.items():
        if hasattr(field.annotation, "model_fields"):
            yield from _sections(field.annotation, (*prefix, name))


def _key(name: str, field: Any) -> str:
    """Return the row of one key; empty for a section."""
    if hasattr(field.annotation, "model_fields"):
        return ""
    default = field.get_default(call_default_factory=True)
    shown = "unset" if default is None else f"`{json.dumps(default, default=str)}`"
    return f"| `{name}` | {shown} | {_bounds(field)} | {_cell(field.description or '')} |"


def _bounds(field: Any) -> str:
    """Return what a value may be: a set of words, or a type and its limits."""
    kinds, found = [], list(field.metadata)
    for annotated in _alternatives(field.annotation):
        part = annotated
        if get_origin(annotated) is Annotated:
            part, *extra = get_args(annotated)
            found += [limit for one in extra for limit in getattr(one, "metadata", (one,))]
        if get_origin(part) is Literal:
            kinds.append(" or ".join(f"`{word}`" for word in get_args(part)))
        elif part is not type(None):
            kinds.append(NAMES.get(part) or str(getattr(part, "__name__", part)))
    signs = (("gt", ">"), ("ge", "≥"), ("lt", "<"), ("le", "≤"))
    limits = [f"{sign} {getattr(one, key):g}" for one in found for key, sign in signs if hasattr(one, key)]
    return ", ".join([_cell(" or ".join(kinds)), *limits])


def _alternatives(annotation: Any) -> tuple[Any, ...]:
    """Return the members of a union, or the annotation alone."""
    return get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)


def _cell(text: str) -> str:
    """Return a text as it is safe in a cell of a table."""
    return html.escape(" ".join(text.split()), quote=False).replace("|", "&#124;")


def cli_page() -> str:
    """Return the page of the command line: every verb with its arguments and options."""
    import typer

    from evermap.cli.main import app

    command = typer.main.get_command(app)
    lines = ["# Command line", "", "Every verb, generated from the program. `-h` prints the same.", ""]
    lines += [
        "Results go to stdout, everything else to stderr. Exit codes: 0 fine; 2 a mistake of the user; 1 a defect"
    ]
    lines += ["of evermap; 130 interrupted.", ""]
    for context, verb in _verbs(command, ("evermap",)):
        lines += _verb(context, verb)
    return "\n".join(lines)


def _verbs(command: Any, names: tuple[str, ...], parent: Any = None) -> Iterator[tuple[Any, Any]]:
    """Yield every verb with the context that it is called in, groups before what they hold."""
    context = command.context_class(command, info_name=names[-1], parent=parent)
    yield context, command
    for name in command.list_commands(context) if hasattr(command, "list_commands") else ():
        yield from _verbs(command.get_command(context, name), (*names, name), context)


def _verb(context: Any, command: Any) -> list[str]:
    """Return the section of a verb: its help, its examples, a table of its parameters."""
    words = context.command_path.split()
    lines = [f"{'#' * min(len(words) + 1, 4)} {' '.join(words)}", ""]
    for paragraph in inspect.cleandoc(command.help or "").split("\n\n"):
        if paragraph.startswith("\b"):
            lines += ["```text", *paragraph.splitlines()[1:], "```", ""]
        else:
            lines += [paragraph, ""]
    records = [record for parameter in command.params if (record := parameter.get_help_record(context))]
    if records:
        lines += ["| argument or option | meaning |", "| --- | --- |"]
        lines += [f"| <code>{_cell(name)}</code> | {_cell(meaning)} |" for name, meaning in records]
        lines.append("")
    return lines
