"""Old spellings of command lines, which go on working for a version: each becomes the new one, which a last line names.

A verb has at most ten options. What only sets a key of the configuration is now `--set KEY=VALUE`, and what did the
work of another verb is a verb of its own. So an old command line is rewritten before it is parsed: it does what the new
one does, and the next version deletes this module.
"""

from __future__ import annotations

import json
import shlex
import tomllib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from evermap.cli.options import duration_s
from evermap.cli.terminal import hide_passwords
from evermap.errors import ConfigError

Value = Callable[[str], str]
"""Writes the value of an old option in TOML notation."""


def write_text(value: str) -> str:
    """Return a text as `--set` reads it: bare, or in quotes where it would be a number or a list."""
    try:
        tomllib.loads(f"value = {value}")
    except tomllib.TOMLDecodeError:
        return value if value == value.strip() else json.dumps(value)
    return json.dumps(value)


def write_number(value: str) -> str:
    """Return a number as `--set` reads it: TOML has no `.5`."""
    for convert in (int, float):
        with suppress(ValueError):
            return repr(convert(value))
    return value  # refused where the key is set


class Moved(NamedTuple):
    """An old option of a verb.

    Attributes:
        takes: whether a value follows it.
        key: what it sets, if it only sets a key.
        write: writes its value; '' where `key` says it all.
        option: by which the key is set.
        hint: of an option that is still read where it was, but hidden: what to use.
    """

    takes: bool = True
    key: str = ""
    write: Value = write_text
    option: str = "--set"
    hint: str = ""


def _number(key: str) -> Moved:
    return Moved(key=key, write=write_number)


def _flag(key: str = "", value: str = "true") -> Moved:
    return Moved(takes=False, key=key, write=lambda _: value)


def _still(hint: str, *, takes: bool = True) -> Moved:
    return Moved(takes=takes, hint=hint)


@dataclass(slots=True)
class Line:
    """A command line.

    Attributes:
        verb: its words, as ('map', 'enter').
        options: in their order, each with its value; None for a flag.
        arguments: what is neither a verb nor an option.
        old: what was rewritten.
    """

    verb: tuple[str, ...]
    options: list[tuple[str, str | None]]
    arguments: list[str]
    old: list[str] = field(default_factory=list)

    def has(self, *names: str) -> bool:
        """Return whether one of these options was given."""
        return any(name in names for name, _ in self.options)

    def value(self, name: str) -> str | None:
        """Return the last value of an option; None without one."""
        return next((value for one, value in reversed(self.options) if one == name), None)

    def take(self, *names: str) -> str | None:
        """Remove options that are old, and return the last value."""
        found = None
        for name in names:
            if self.has(name):
                found = self.value(name)
                self.options = [one for one in self.options if one[0] != name]
                self.old += [name] if name not in self.old else []
        return found

    def drop(self, *names: str) -> None:
        """Remove options which such a line does not read."""
        self.options = [one for one in self.options if one[0] not in names]

    def words(self) -> list[str]:
        """Return the words after `evermap`."""
        given = [text for name, value in self.options for text in ([name] if value is None else [name, value])]
        ends = ["--"] if any(one.startswith("-") and len(one) > 1 for one in self.arguments) else []
        if ends:
            return [*self.verb, *given, *ends, *self.arguments]
        return [*self.verb, *self.arguments, *given]


_CLUSTER = {"--cluster": Moved()}
_EMPTY_IDS = {"--empty-ids": _flag("slam.unknown_ids", "empty")}

MOVED: Mapping[str, Mapping[str, Moved]] = {
    "slam": {
        "--sensor-model": Moved(key="slam.sensor_model"),
        "--method": Moved(key="slam.method"),
        **_EMPTY_IDS,
        "--map": Moved(),
        "--prior": Moved(),
        "--prior-sigma": Moved(),
        "--localize": _flag(),
        "--together": _flag(),
        "--init": Moved(),
        "--3d": _flag(),
        "--init-bag": Moved(),
        "--start": _still("an option of evermap map enter, localize and convert"),
        "--realtime": _still(
            "an option of evermap localize and live; without a map it is for experiments", takes=False
        ),
        "--offline-session": _still("evermap convert INPUT FILE.zip --format session"),
        "--shift": _still("for experiments; evermap.io.shifted in Python"),
    },
    "check": _EMPTY_IDS,
    "live": {"--map": Moved(), "--replay": Moved()},
    "persist": {
        "--recurrent": Moved(key="persist.recurrent"),
        "--per": Moved(key="persist.per"),
        "--model": Moved(key="persist.model", write=lambda text: write_text(str(Path(text)))),
        "--learn-from": _number("persist.learn_from"),
        "--query": Moved(key="persist.query"),
        "--step-s": _number("persist.step_s"),
        "--horizon": Moved(key="persist.horizon_s", write=lambda text: f"{duration_s(text, '--horizon'):.17g}"),
        "--p-miss": _number("persist.p_miss"),
        "--p-false": _number("persist.p_false"),
        "--confidence": _number("persist.confidence"),
        "--figures": _number("persist.figures"),
        "--init": Moved(),
        **_CLUSTER,
    },
    "track": {
        "--speed": Moved(),
        "--min-score": _number("track.min_score"),
        "--gap-s": _number("track.gap_s"),
        "--scene": _flag("output.rerun"),
        "--no-scene": _flag("output.rerun", "false"),
        "--init": Moved(),
    },
    "learn": _CLUSTER,
    "map reenter": _CLUSTER,
    "map export": {
        "--speed-mask": _flag(),
        "--route-graph": Moved(),
        "--ahead": Moved(),
        "--cell-m": Moved(),
        "--radius-m": Moved(),
        "--lifetimes": _still("evermap map export, without --out"),
    },
}
"""Old options of each verb."""


def renew(
    args: Sequence[str],
    options: Callable[[str], Mapping[str, Any]],
    tables: Mapping[str, Mapping[str, Moved]] = MOVED,
) -> tuple[list[str], str | None]:
    """Return the words of a command line in its new spelling, and the line that names it; None if nothing is old.

    Args:
        args: words after `evermap`.
        options: returns those that a verb has now, by name.
        tables: old options of each verb.

    Raises:
        ConfigError: the old command line was a mistake of the user.
    """
    verb = next((" ".join(args[:n]) for n in (1, 2) if " ".join(args[:n]) in tables), None)
    if verb is None:
        return list(args), None
    moved = tables[verb]
    takes = {name: not one.is_flag for name, one in options(verb).items()}
    takes |= {name: one.takes for name, one in moved.items()}
    line = _parse(tuple(verb.split()), args[len(verb.split()) :], takes)
    if verb in _REWRITES:
        _REWRITES[verb](line)
    for name in [name for name, _ in line.options if name in moved and moved[name].key]:
        if line.has(name):
            value = moved[name].write(line.take(name) or "")
            said = f"{moved[name].key}={value}" if value or moved[name].takes else moved[name].key
            line.options.append((moved[name].option, said))
    shown = {name for name, one in options(" ".join(line.verb)).items() if not one.hidden}
    hidden = {name for name, _ in line.options if name in moved and name not in shown}
    hints = [f"{name} is now: {moved[name].hint}" for name in sorted(hidden)]
    if not line.old:
        return list(args), "; ".join(hints) or None
    old = " and ".join([", ".join(line.old[:-1]), line.old[-1]] if len(line.old) > 1 else line.old)
    said = f"{old} {'is' if len(line.old) == 1 else 'are'} now: evermap {shlex.join(line.words())}"
    return line.words(), hide_passwords("; ".join([said, *hints]))


def _parse(verb: tuple[str, ...], args: Sequence[str], takes: Mapping[str, bool]) -> Line:
    """Return options and arguments of a verb.

    Raises:
        ConfigError: an old option lacks its value.
    """
    line, rest = Line(verb, [], []), list(args)
    while rest:
        word = rest.pop(0)
        if word == "--":
            line.arguments += rest
            break
        name, equals, value = word.partition("=")
        if not word.startswith("-") or word == "-":
            line.arguments.append(word)
        elif takes.get(name, False):
            if not equals and not rest:
                raise ConfigError("requires a value", field=name)
            line.options.append((name, value if equals else rest.pop(0)))
        else:  # a flag, or an option that nobody knows
            line.options.append((word, None))
    return line


def _rewrite_check(line: Line) -> None:
    if line.has("--unknown-ids") and line.has("--empty-ids"):
        raise ConfigError("ignores the ids that --empty-ids keeps", field="--unknown-ids", hint="one of the two")


def _rewrite_slam(line: Line) -> None:
    """Find the verb: slam, map enter, localize, together or init."""
    if line.has("--init", "--init-bag", "--3d"):
        _rewrite_templates(line)
        return
    _rewrite_check(line)
    if line.has("--show-config"):  # of any of them: nothing else is read
        line.take("--map", "--localize", "--together", "--prior", "--prior-sigma")
        return
    if line.has("--together"):
        single = ("--realtime", "--topics", "--offline-session", "--robot", "--map", "--prior", "--localize",
                  "--prior-map", "--shift", "--prior-sigma", "--start")  # fmt: skip
        for name in single:
            if line.has(name):
                raise ConfigError("is for one robot at a time", field=name, hint="omit it or --together")
        line.take("--together")
        line.verb = ("together",)
        return
    for name in ("--shift", "--prior-sigma"):
        if line.has(name) and not line.has("--prior-map"):
            hint = "--prior-map truth, or --prior-map FILE"
            raise ConfigError("there is no prior map", field=name, hint=hint)
    if line.has("--prior-sigma"):
        survey = f"{line.value('--prior-map')},sigma={line.take('--prior-sigma')}"
        line.drop("--prior-map")
        line.options.append(("--prior-map", survey))
    if not line.has("--map"):
        if line.has("--prior"):
            raise ConfigError("is for a session of a map", field="--prior", hint="evermap map enter MAP INPUT --prior")
        if line.has("--localize"):
            raise ConfigError("needs a map", field="--localize", hint="evermap localize MAP INPUT")
        return
    if line.has("--localize") and line.has("--prior"):
        hint = "evermap map enter MAP INPUT --prior"
        raise ConfigError("is for a session of a map", field="--prior", hint=hint)
    if line.has("--localize") and line.has("--prior-map"):
        hint = "either a living map or a prior map"
        raise ConfigError("a living map cannot be combined with a prior map", field="--prior-map", hint=hint)
    if line.has("--method"):
        hint = "--set living.search=gate, for example"
        raise ConfigError("a living map finds changes by itself", field="--method", hint=hint)
    if line.has("--realtime") and not line.has("--localize"):
        raise ConfigError("a session is solved when it ends", field="--realtime", hint="evermap localize")
    line.arguments.insert(0, line.take("--map") or "")
    if line.has("--unknown-ids"):
        line.take("--unknown-ids")
        line.options.append(("--set", "slam.unknown_ids=true"))
    if line.has("--localize"):
        line.take("--localize")
        line.verb = ("localize",)
    else:
        line.verb = ("map", "enter")


def _rewrite_templates(line: Line) -> None:
    """Rewrite `--init DIR`, `--init DIR --3d` and `--init-bag BAG` of slam."""
    others = [name for name, _ in line.options if name not in ("--init", "--init-bag", "--3d")]
    if line.arguments or others:
        field = "INPUT" if line.arguments else others[0]
        raise ConfigError("is for a run", field=field, hint="omit it, or --init and --init-bag")
    if line.has("--init") and line.has("--init-bag"):
        raise ConfigError("is for a bag", field="--init-bag", hint="one of evermap init recording and init bag")
    folder, bag = line.take("--init"), line.take("--init-bag")
    if folder is not None and folder.startswith("-"):
        raise ConfigError(f"needs a folder, not {folder}", field="--init", hint="evermap init flight DIR")
    in_space = line.has("--3d")
    line.take("--3d")
    if in_space and folder is None:
        raise ConfigError("is for a template", field="--3d", hint="evermap init flight DIR")
    kind = "bag" if bag is not None else "flight" if in_space else "recording"
    line.verb, line.arguments = ("init",), [kind, folder or bag or ""]


def _rewrite_cluster(line: Line) -> None:
    """Rewrite `--cluster ADDRESS` as `--workers ADDRESS`."""
    if not line.has("--cluster"):
        return
    if line.has("--workers"):
        raise ConfigError("are the cluster's", field="--workers", hint="leave out --workers, or --cluster")
    address = line.take("--cluster")
    line.options.append(("--workers", address))


def _rewrite_example(line: Line, kind: str) -> bool:
    """Rewrite `--init FILE`, beside which nothing else was read; return whether it was given."""
    found = line.has("--init")
    if found:
        line.verb, line.arguments, line.options = ("init",), [kind, line.take("--init") or ""], []
    return found


def _rewrite_persist(line: Line) -> None:
    if not _rewrite_example(line, "looks"):
        _rewrite_cluster(line)


def _rewrite_track(line: Line) -> None:
    if _rewrite_example(line, "detections"):
        return
    texts = [value or "" for name, value in line.options if name == "--speed"]
    if texts:
        line.take("--speed")
        speeds = ", ".join(f"{json.dumps(name)} = {speed!r}" for name, speed in read_speeds(texts).items())
        line.options.append(("--set", f"track.speeds_mps={{{speeds}}}"))


def read_speeds(texts: Sequence[str]) -> dict[str, float]:
    """Return the speeds of `CLASS=MPS` each.

    Raises:
        ConfigError: no speed, or a class named twice.
    """
    speeds: dict[str, float] = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.rpartition("="))
        try:
            speed = float(value)
        except ValueError:
            speed = -1.0
        if not equals or not 0.0 < speed < float("inf"):
            raise ConfigError(f"'{text}' is not CLASS=SPEED", field="--speed", hint="pallet=0.2")
        if name in speeds:
            raise ConfigError(f"given twice for class '{name}'", field="--speed")
        speeds[name] = speed
    return speeds


def _rewrite_live(line: Line) -> None:
    """Rewrite `live --map MAP --replay INPUT` as `live MAP INPUT`, and without a map as `play INPUT`."""
    living, replayed = line.take("--map"), line.take("--replay")
    if living is None and not line.arguments and not line.has("--help", "-h"):
        if replayed is None or not line.has("--zenoh", "--foxglove"):
            hint = "evermap live MAP; or evermap play INPUT --zenoh ENDPOINT"
            raise ConfigError("a living map is needed", field="MAP", hint=hint)
        for name in ("--sensor", "--topics", "--localize", "--json", "--config", "--set"):
            if line.has(name):
                raise ConfigError("needs a map", field=name, hint="evermap live MAP INPUT")
        line.drop("--realtime")
        line.verb = ("play",)
    line.arguments = [*(one for one in (living, replayed) if one is not None), *line.arguments]


def _rewrite_export(line: Line) -> None:
    """Rewrite an export for Nav2 as `map nav2`."""
    out = line.value("--out") or ""
    grid = out.lower().endswith(".yaml") and not line.has("--format")
    if out and (grid or line.has("--speed-mask", "--route-graph")):
        line.drop("--format")
        line.old += [name for name in ("--speed-mask", "--route-graph") if line.has(name)] or [f"--out {out}"]
        line.verb = ("map", "nav2")
    else:  # they were not read
        line.take("--speed-mask", "--route-graph", "--ahead", "--cell-m", "--radius-m")


_REWRITES: dict[str, Callable[[Line], None]] = {
    "check": _rewrite_check,
    "slam": _rewrite_slam,
    "live": _rewrite_live,
    "persist": _rewrite_persist,
    "track": _rewrite_track,
    "learn": _rewrite_cluster,
    "map reenter": _rewrite_cluster,
    "map export": _rewrite_export,
}

NOW = "evermap.moved"
"""Key of the line that names the new spelling, in what all contexts share."""


def options_of(command: Any) -> dict[str, Any]:
    """Return the options of a parsed command, by all of their names."""
    options = (one for one in command.params if one.param_type_name == "option")
    return {name: one for one in options for name in (*one.opts, *one.secondary_opts)}
