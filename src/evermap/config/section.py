"""A section of the configuration: keys with defaults, bounds and meanings, and what is said of a wrong one.

A section also holds rules: numbers of the method beside the keys they belong to. They are of the code, not of a
recording or a site, so a file or `--set` cannot change them; an experiment in Python can (`with_rules`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeGuard, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from evermap.errors import ConfigError, similar, suggestion

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Probability = Annotated[float, Field(ge=0, le=1)]
Share = Annotated[float, Field(gt=0, lt=1)]
"""A probability that is neither zero nor one."""
Count = Annotated[int, Field(ge=1)]


def key(default: Any, meaning: str, **bounds: Any) -> Any:
    """Define a key of a section: its default, one line of meaning with the unit, and bounds as of pydantic's `Field`.

    A default that can be changed is copied for every section.
    """
    return Field(default=default, description=meaning, **bounds)


def rule(default: Any, meaning: str, **bounds: Any) -> Any:
    """Define a rule of a section: a number of the method, with its meaning as of `key`, which no user sets."""
    return Field(default=default, description=meaning, json_schema_extra={"rule": True}, **bounds)


def is_rule(info: FieldInfo) -> bool:
    """Return whether a field is a rule, not a key."""
    return isinstance(info.json_schema_extra, dict) and bool(info.json_schema_extra.get("rule"))


def part(section: Callable[[], Section], meaning: str) -> Any:
    """Define a section within a section."""
    return Field(default_factory=section, description=meaning)


class _RaisesOurErrors(ModelMetaclass):
    """Sections made from Python raise `ConfigError` as those from a file do; nested ones report the whole key."""

    def __call__(self, *args: Any, **values: Any) -> Any:
        try:
            return super().__call__(*args, **values)
        except ValidationError as error:
            raise config_error(self, error) from None


class Section(BaseModel, metaclass=_RaisesOurErrors):
    """Base of all sections: frozen, no unknown keys, no infinities or nan, every field with a default."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def __repr_args__(self) -> list[tuple[str | None, Any]]:
        """Show what was set, of two hundred keys."""
        return [(name, value) for name, value in super().__repr_args__() if name in self.model_fields_set]

    def to_dict(self) -> dict[str, Any]:
        """Return the section as plain JSON values, for `summary.json`."""
        return self.model_dump(mode="json")


def config_error(root: Any, error: ValidationError, path: Path | None = None) -> ConfigError:
    """Return the first thing that is wrong with values for `root` as an error of one line.

    Args:
        root: the section that the values were for.
        error: of its validation.
        path: file that the values came from.
    """
    first = error.errors(include_url=False)[0]
    names = [str(name) for name in first["loc"]]
    field = ".".join(names)
    if first["type"] == "extra_forbidden":
        return ConfigError("unknown key", path=path, field=field, hint=_nearest_key(root, names, first["input"]))
    told = first["ctx"]["error"] if first["type"] == "value_error" else None
    if isinstance(told, ValueError):
        return ConfigError(str(told), path=path, field=field or None)
    problem, hint = f"{first['msg'][:1].lower()}{first['msg'][1:]}, not {first['input']!r}", None
    if first["type"] == "literal_error":
        annotation: Any = root
        for name in names:
            annotation = annotation.model_fields[name].annotation
        hint = suggestion(str(first["input"]), _words_of(annotation))
    return ConfigError(problem, path=path, field=field, hint=hint)


def _words_of(annotation: Any) -> list[str]:
    """Return the words that a key of such a type may be."""
    return [option for option in get_args(annotation) if isinstance(option, str)]


def list_keys(section: type[Section], prefix: tuple[str, ...] = ()) -> Iterator[str]:
    """Yield the dotted names of all keys, and of the sections that hold some."""
    for name, info in section.model_fields.items():
        if is_rule(info):
            continue
        inner = list(list_keys(info.annotation, (*prefix, name))) if _is_section(info.annotation) else None
        if inner is None or inner:
            yield ".".join((*prefix, name))
            yield from inner or ()


def find_rule(section: type[Section], names: Sequence[str]) -> bool:
    """Return whether a dotted name is that of a rule, or of a section that holds nothing else."""
    for depth, name in enumerate(names):
        info = section.model_fields.get(name)
        if info is None:
            return False
        if not _is_section(info.annotation):
            return is_rule(info) and depth == len(names) - 1
        section = info.annotation
    return not list(list_keys(section))


def _is_section(annotation: Any) -> TypeGuard[type[Section]]:
    return isinstance(annotation, type) and issubclass(annotation, Section)


def _nearest_key(root: type[Section], names: list[str], value: Any) -> str:
    """The known key that an unknown one means: of its name in any section, or similar; else the keys of its section.

    Args:
        root: the section that it was given to.
        names: of the key and the sections around it.
        value: that it was given; of a section that is not known, what that holds.
    """
    known, inner = list(list_keys(root)), names
    while isinstance(value, dict) and value:
        inner, value = [*inner, str(next(iter(value)))], next(iter(value.values()))
    for wanted in (inner, names):
        same_name = [key for key in known if key.rpartition(".")[2] == wanted[-1]]
        meant = similar(".".join(wanted), same_name, cutoff=0.0) or similar(".".join(wanted), known, cutoff=0.6)
        if meant:
            return meant
    section = max(
        (key.rpartition(".")[0] for key in known if ".".join(names).startswith(key.rpartition(".")[0])), key=len
    )
    return "one of " + ", ".join(key for key in known if key.rpartition(".")[0] == section)
