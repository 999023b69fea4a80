"""Output folders of commands, and the protection of the user's files.

`RunFolder` is the one way to an output folder, for every verb and from Python. Everything is made in a hidden
sibling (`.<name>.partial-...`) and takes its place at the very end, so an older good run stays until a new good run
is there. The folder carries a list of its files with their checksums (`.evermap-run.json`). Only a file that is
listed, and is still what was written, is ever replaced or removed; all else belongs to the user. `check_output_file`
is the rule for verbs that write a single file.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, TypedDict, Unpack

from evermap import __version__
from evermap.errors import ConfigError, MissingExtraError
from evermap.interrupts import held, kept, temporary
from evermap.io.files import is_marked, write_atomic
from evermap.runs.summary import SUMMARY_SCHEMA_VERSION, RunInfo, change_dict, changes_text, summary_dict, timing_dict
from evermap.types import AnyRecording, SlamResult

if TYPE_CHECKING:
    from evermap.metrics.summary import Evaluation
    from evermap.viz.report import ReportSection
    from evermap.viz.style import NamedFigure

SUMMARY = "summary.json"
MANIFEST = ".evermap-run.json"
"""Manifest in every folder that evermap wrote: its files with sizes and checksums."""
_IGNORED = {".DS_Store", "Thumbs.db"}
_DISK_FULL = {errno.ENOSPC, errno.EDQUOT}


class RunFolder:
    """Context manager: write into `folder.path(name)`; on success it becomes `out`, on any exception it vanishes.

    Args:
        out: where the run shall be; parents are made.
        force: write into a folder that holds other files, too; they stay.
        inputs: files and folders that are read for this run; None and '' are none.
        renew: replace an older output of evermap, without `force` too.

    Raises:
        ConfigError: `out` must not be written to, see `check_replaceable`.
    """

    def __init__(
        self, out: str | Path, *, force: bool = False, inputs: Iterable[str | Path | None] = (), renew: bool = True
    ) -> None:
        self.out = Path(out).expanduser().resolve()
        self._name = str(out)
        self._rules: dict[str, Any] = {"force": force, "inputs": tuple(inputs), "renew": renew}
        check_replaceable(self.out, **self._rules)
        token = secrets.token_hex(4)
        self._partial = self.out.with_name(f".{self.out.name}.partial-{token}")
        self._replaced = self.out.with_name(f".{self.out.name}.replaced-{token}")
        if self.out.is_dir() and (self.out.is_mount() or not os.access(self.out.parent, os.W_OK)):
            self._partial = self.out / self._partial.name  # nothing can be put beside it
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        try:
            self._stack.enter_context(temporary(lambda: shutil.rmtree(self._partial, ignore_errors=True)))
            self._partial.mkdir(parents=True)
        except OSError as error:
            self._stack.close()
            raise _cannot_write(self.out, error) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        with self._stack:
            if kind is None:
                self._take_place()
        if isinstance(error, OSError) and (
            error.errno in _DISK_FULL or str(error.filename or "").startswith(str(self._partial))
        ):
            raise _cannot_write(self.out, error) from error

    def path(self, name: str) -> Path:
        """Return where to write the file `name` for now, '.' for the folder itself; its folder exists."""
        path = self._partial / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def files(self) -> list[str]:
        """Return names of all files written so far and of their list, sorted, with forward slashes."""
        return sorted({*_entries(self._partial), MANIFEST})

    def finish(self, summary: dict[str, Any], *more: str) -> dict[str, Any]:
        """Write `summary.json` and return its content as plain JSON values, with the names of all files as `outputs`.

        What is missing of the keys that every summary has is added; settings of a study are its configuration. Files of
        the names in `more` are still to be written.
        """
        head = {
            "schema_version": SUMMARY_SCHEMA_VERSION,
            "evermap": __version__,
            "version": __version__,
            "command": "",
            "config": summary.get("settings", {}),
            "input": "",
            "warnings": [],
            "timing": {},
        }
        summary = {**head, **summary, "outputs": sorted({*self.files(), SUMMARY, *more})}
        text = summary_text(summary)
        self.path(SUMMARY).write_text(text, encoding="utf-8")
        content: dict[str, Any] = json.loads(text)
        return content

    def _take_place(self) -> None:
        """Move into place by one rename if the old folder is evermap's alone, else file by file."""
        try:
            new = {name: _checksum(self._partial / name) for name in self.files() if name != MANIFEST}
            (self._partial / MANIFEST).write_text(_manifest_text({name: [of] for name, of in new.items()}), "utf-8")
            with held():
                try:
                    check_replaceable(self.out, **self._rules)  # it may have changed during a long run
                    ours, foreign = _whose(self.out)
                    _check_free(self.out, ours, new)
                except ConfigError as refused:
                    raise self._put_beside(refused) from refused
                if foreign or self._partial.parent == self.out:
                    self._move_in(ours, new)
                else:
                    self._swap(ours)
                kept(self.out, f"the results are in {self._name}")
        except OSError as error:
            raise _cannot_write(self.out, error) from error

    def _swap(self, ours: Iterable[str]) -> None:
        """Two renames; if the second fails the old folder comes back."""
        if self.out.exists():
            self.out.rename(self._replaced)
        try:
            self._partial.rename(self.out)
        except OSError:
            if self._replaced.exists():
                self._replaced.rename(self.out)
            raise
        _remove(self._replaced, ours)
        for name in _entries(self._replaced):  # what came in the last moment, or is not listed
            if not os.path.lexists(self.out / name):
                (self.out / name).parent.mkdir(parents=True, exist_ok=True)
                (self._replaced / name).rename(self.out / name)
        for place, _, _ in os.walk(self._replaced, topdown=False):
            with suppress(OSError):
                Path(place).rmdir()

    def _move_in(self, ours: Mapping[str, str], new: Mapping[str, str]) -> None:
        """File by file. Until the last one is there, the list names the old files and the new ones."""
        both = {name: [of[name] for of in (ours, new) if name in of] for name in {*ours, *new} - {MANIFEST}}
        write_atomic(self.out / MANIFEST, _manifest_text(both))
        for name in sorted(new, key=lambda name: (name == SUMMARY, name)):
            (self.out / name).parent.mkdir(parents=True, exist_ok=True)
            (self._partial / name).replace(self.out / name)
        _remove(self.out, ours.keys() - new.keys() - {MANIFEST})
        (self._partial / MANIFEST).replace(self.out / MANIFEST)

    def _put_beside(self, refused: ConfigError) -> ConfigError:
        """A new run that may not take its place is not thrown away."""
        number = 2
        while (beside := self.out.with_name(f"{self.out.name}-{number}")).exists():
            number += 1
        try:
            self._partial.rename(beside)
        except OSError:
            return refused
        kept(beside, f"the results are in {beside}")
        problem = f"{refused.problem}; the new results are in {beside}"
        return ConfigError(problem, path=self.out, field="out", hint=refused.hint)


def check_replaceable(
    out: str | Path, *, force: bool = False, inputs: Iterable[str | Path | None] = (), renew: bool = True
) -> None:
    """Check that results may be written to `out`: it does not exist, is empty, or holds an output of evermap alone.

    With `force` it may hold other files, too, but none of an older run that was changed since: it is in the way of the
    new one. None of the `inputs`, which need not exist, may be `out` or in it, whatever `force` says. Without `renew`
    an older output of evermap needs `force`, too.

    Raises:
        ConfigError: what is wrong with it.
    """
    shown, out = Path(out), Path(out).expanduser().resolve()
    if out.exists() and not out.is_dir():
        raise ConfigError("is a file; results need a folder", path=out, field="out", hint="another folder")
    if any(place.is_relative_to(out) for place in _places()):
        raise ConfigError("would replace the working or home folder", path=out, field="out", hint="a folder below it")
    for path in (one for one in inputs if one):
        if any(_is_within(place, folder) for place in _real_places(Path(path)) for folder in (out, shown.absolute())):
            problem = f"contains '{path}', which this command reads"
            raise ConfigError(problem, path=out, field="out", hint="a separate folder")
    if not out.exists():
        return
    ours, foreign = _whose(out)
    if not force and not renew and (ours or foreign):
        raise ConfigError("is not empty", path=out, field="out", hint="another folder, or `force` to write into it")
    listed = _manifest(out)
    for name in (one for one in foreign if not force or one in listed or one == SUMMARY):
        what = "which was changed since evermap wrote it" if name in listed else "which no evermap run wrote"
        hint = "another folder" if force else "another folder, or `force` to keep it and write into the folder"
        raise ConfigError(f"contains '{name}', {what}", path=out, field="out", hint=hint)


def check_output_file(
    path: str | Path,
    *,
    inputs: Iterable[str | Path | None] = (),
    ending: str = "",
    force: bool | None = None,
    ours: Callable[[Path], bool] = is_marked,
) -> None:
    """Check that a single file may be written: it is none of the inputs, and no living map.

    Args:
        path: the file.
        inputs: files and folders that are read.
        ending: of the files that may be replaced.
        force: replace an older file of that name, whoever wrote it; None where a verb has no such option.
        ours: whether evermap wrote such a file, which is replaced without `force`, too.

    Raises:
        ConfigError: what is wrong with it.
    """
    path = Path(path)
    for read in (one for one in inputs if one):
        if any(_is_within(place, path) for place in _real_places(Path(read))):
            raise ConfigError("is the input of this command", path=path, hint="another name")
    if not path.name.endswith(ending) and os.path.lexists(path):
        raise ConfigError(f"exists, and is not a {ending} file", path=path, hint=f"a name ending in {ending}")
    if _is_living_map(path):
        raise ConfigError("is a living map, which is never replaced", path=path, hint="another name")
    if os.path.lexists(path) and not force and not ours(path):
        hint = "another name" if force is None else "another name, or --force"
        raise ConfigError("is there already, and not by this command", path=path, hint=hint)


def _is_living_map(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(16).startswith(b"SQLite format 3")
    except OSError:
        return False


def _places() -> list[Path]:
    """Folders that must not vanish."""
    places = []
    for find in (Path.cwd, Path.home):
        try:
            places.append(find().resolve())
        except (OSError, RuntimeError):  # no such folder: nothing to protect
            continue
    return places


def _real_places(path: Path) -> list[Path]:
    """Return the paths of an input: as given, with links resolved, and for a folder the targets of its links."""
    path = path.expanduser()
    places = [path.absolute(), Path(os.path.normpath(path.absolute())), path.resolve()]
    with suppress(OSError):
        places += [child.resolve() for child in path.iterdir() if child.is_symlink()]
    return places


def _is_within(path: Path, folder: Path) -> bool:
    """Return whether a path is `folder` or in it, by name or by file identity."""
    if path.is_relative_to(folder):
        return True
    with suppress(OSError):
        there = folder.stat()
        for place in (path, *path.parents):
            with suppress(OSError):  # it need not exist
                if os.path.samestat(place.stat(), there):
                    return True
    return False


def _entries(folder: Path) -> list[str]:
    """Names of files, links and empty folders, sorted, with forward slashes; links are not followed."""
    found = []
    for place, folders, files in os.walk(folder):
        links = [name for name in folders if Path(place, name).is_symlink()]
        empty = [] if files or folders or Path(place) == folder else [""]
        found += [Path(place, name).relative_to(folder).as_posix() for name in (*files, *links, *empty)]
    return sorted(found)


def _whose(folder: Path) -> tuple[dict[str, str], list[str]]:
    """Return evermap's unchanged files (with the list) and checksums; and the user's files and links."""
    listed = _manifest(folder)
    ours: dict[str, str] = {}
    foreign = []
    for name in _entries(folder):
        path = folder / name
        if name.startswith(f".{folder.name}.partial-") or (path.is_dir() and not path.is_symlink()):
            continue
        checksum = None if path.is_symlink() else _checksum(path) if name in listed or name == MANIFEST else None
        if checksum is not None and (name == MANIFEST or (listed[name] or [checksum]).count(checksum)):
            ours[name] = checksum
        elif path.name not in _IGNORED:
            foreign.append(name)
    return ours, foreign


def _check_free(folder: Path, ours: Mapping[str, str], new: Iterable[str]) -> None:
    """Check that no file of the user has the name of a new file, or of a folder that it needs.

    Raises:
        ConfigError: something has.
    """
    for name in new:
        path = folder / name
        parents = [folder / parent for parent in Path(name).parents[:-1]]
        blocked = [at for at in parents if at.is_symlink() or (at.exists() and not at.is_dir())]
        if name not in ours and os.path.lexists(path):
            blocked.append(path)
        if blocked:
            problem = f"contains '{blocked[0].relative_to(folder).as_posix()}', which evermap did not write"
            raise ConfigError(problem, path=folder, field="out", hint="another folder, or rename it")


def _remove(folder: Path, names: Iterable[str]) -> None:
    """Files, and the folders that are empty without them."""
    names = [*names]
    for name in names:
        (folder / name).unlink(missing_ok=True)
    for parent in sorted({parent for name in names for parent in Path(name).parents[:-1]}, reverse=True):
        with suppress(OSError):  # it is not empty
            (folder / parent).rmdir()


def _manifest(folder: Path) -> dict[str, list[str]]:
    """Files that evermap listed there and their checksums; none where an older evermap listed the names only."""
    with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
        files = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))["files"]
        return {str(name): [str(checksum) for checksum in checksums] for name, checksums in files.items()}
    with suppress(OSError, ValueError, KeyError, TypeError):
        summary = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
        if "evermap" in summary and "schema_version" in summary:  # but a map may have been continued since
            return {str(name): [] for name in summary["outputs"] if not str(name).endswith(".evermap")}
    return {}


def _manifest_text(files: Mapping[str, Sequence[str]]) -> str:
    about = "Files that evermap wrote, with their SHA-256. It replaces and removes these while they are unchanged."
    return json.dumps({"about": about, "evermap": __version__, "files": files}, indent=1, sort_keys=True) + "\n"


def _checksum(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _cannot_write(out: Path, error: OSError) -> ConfigError:
    return ConfigError(f"cannot be written: {error.strerror or error}", path=out, field="out", hint="another folder")


class Asked(TypedDict, total=False):
    """Requests of a caller for a run folder; missing or None values follow the configuration.

    Attributes:
        figures: whether to draw; `config.output.figures`, or yes.
        report: likewise `report.html`, `config.output.report`.
        scene: whether to write `scene.rrd`; `config.output.rerun`, or no. Where rerun-sdk is missing it is left out
            with a warning if the configuration asks for it, else that is an error.
        mcap: likewise `run.mcap`, `config.output.mcap`, which needs rosbags.
    """

    figures: bool | None
    report: bool | None
    scene: bool | None
    mcap: bool | None


def write_run(
    out: str | Path,
    recording: AnyRecording,
    result: SlamResult,
    config: Any = None,
    *,
    info: RunInfo | None = None,
    sections: Sequence[ReportSection] = (),
    force: bool = False,
    inputs: Iterable[str | Path | None] = (),
    **asked: Unpack[Asked],
) -> dict[str, Any]:
    """Evaluate a run and write its folder; return the content of `summary.json`.

    Args:
        out: the folder, with `force` and `inputs` (beside the recording's) as of `RunFolder`.
        recording: what was processed.
        result: what came out.
        config: a `Config`, or any mapping that JSON can hold; None if there is none.
        info: what the numbers alone cannot say: command, seeds, measured times.
        sections: parts that the caller adds to the report.
        force: see `out`.
        inputs: see `out`.
        asked: `figures`, `report`, `scene` or `mcap`, see `Asked`.

    Raises:
        ConfigError: `out` must not or cannot be written.
        MissingExtraError: `scene` is True and rerun-sdk is missing, or `mcap` and rosbags.
    """
    from evermap.maps.sessions.admission import as_estimated
    from evermap.metrics.summary import RATE_HZ, compare_with_truth, metrics_dict

    recording = as_estimated(recording, result)
    wanted = getattr(config, "output", None)
    rate_hz = float(getattr(wanted, "score_rate_hz", RATE_HZ))
    info = info or RunInfo()
    with RunFolder(out, force=force, inputs=(recording.source, *inputs)) as folder:
        evaluation = compare_with_truth(recording, result, rate_hz=rate_hz)
        timing = timing_dict(recording, result, info)
        _write_estimates(folder, result)
        draw = _choose(asked.get("figures"), wanted, "figures")
        tell = _choose(asked.get("report"), wanted, "report")
        drawn: tuple[NamedFigure, ...] = ()
        if draw or tell:
            from evermap.viz.run_figures import draw_figures

            drawn = draw_figures(recording, result, evaluation, real_time_factor=timing["real_time_factor"])
        if draw:
            _write_figures(folder, drawn)
        remarks = _write_extras(folder, recording, result, evaluation, asked, wanted)
        measured, settings = metrics_dict(evaluation), _plain(config)
        summary = summary_dict(recording, result, measured, config=settings, info=info, timing=timing, warnings=remarks)
        summary = folder.finish(summary, *(["report.html"] if tell else []))
        if tell:
            from evermap.viz.report import render_report

            page = render_report(recording, result, evaluation, summary, drawn, sections)
            folder.path("report.html").write_text(page, encoding="utf-8")
    return summary


def summary_text(summary: Mapping[str, Any]) -> str:
    """Return `summary.json` as text: keys sorted, floats in their shortest exact form, so equal runs give equal
    bytes.
    """
    return json.dumps(summary, indent=2, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n"


def _choose(asked: bool | None, wanted: Any, name: str, *, default: bool = True) -> bool:
    return bool(getattr(wanted, name, default)) if asked is None else asked


def _plain(config: Any) -> Any:
    """Configuration as JSON values; a pydantic model dumps itself."""
    if config is None:
        return {}
    return config.model_dump(mode="json") if hasattr(config, "model_dump") else json.loads(json.dumps(config))


def _write_estimates(folder: RunFolder, result: SlamResult) -> None:
    from evermap.io.arrow import parquet_bytes
    from evermap.io.landmarks import write_map_geojson, write_map_parquet
    from evermap.io.tum import write_tum
    from evermap.runs.object_changes import object_changes_text

    write_tum(result.trajectory, folder.path("trajectory.tum"))
    if len(result.online):
        write_tum(result.online, folder.path("online.tum"))
    write_map_parquet(result.landmarks, folder.path("map.parquet"))
    write_map_geojson(result.landmarks, folder.path("map.geojson"))
    for rank, alternative in enumerate(result.alternatives, start=1):
        write_map_geojson(alternative.landmarks, folder.path(f"alternative_{rank}.geojson"))
    folder.path("innovations.parquet").write_bytes(parquet_bytes(result.innovations._columns()))
    folder.path("changes.jsonl").write_text(changes_text(map(change_dict, result.changes)), encoding="utf-8")
    folder.path("object_changes.csv").write_text(object_changes_text(result), encoding="utf-8")
    if result.followed is not None:
        from evermap.runs.track.tables import track_files

        for name, content in track_files(result.followed).items():
            folder.path(name).write_bytes(content())


def _write_figures(folder: RunFolder, figures: Sequence[NamedFigure]) -> None:
    from evermap.viz.style import house_style, save_png, save_svg

    with house_style():
        for named in figures:
            save_png(named.figure, folder.path(f"figures/{named.name}.png"))
            save_svg(named.figure, folder.path(f"figures/{named.name}.svg"))


def _write_extras(
    folder: RunFolder, recording: AnyRecording, result: SlamResult, evaluation: Evaluation, asked: Asked, wanted: Any
) -> list[str]:
    """Write the files for other programs, if requested."""
    remarks: list[str] = []
    if _choose(asked.get("scene"), wanted, "rerun", default=False):
        from evermap.viz.rerun_scene import write_scene

        scene = partial(write_scene, recording, result, folder.path("scene.rrd"), evaluation=evaluation)
        remarks += if_installed("scene.rrd", scene, must=asked.get("scene") is True)
    if _choose(asked.get("mcap"), wanted, "mcap", default=False):
        from evermap.runs.mcap import write_mcap

        messages = partial(write_mcap, recording, result, folder.path("run.mcap"))
        remarks += if_installed("run.mcap", messages, must=asked.get("mcap") is True)
    return remarks


def if_installed(name: str, write: Callable[[], object], *, must: bool = False) -> list[str]:
    """Write a file for which a package may be missing; return a remark then, unless it must be written."""
    try:
        write()
    except MissingExtraError as error:
        if must:
            raise
        return [f"{name} was left out: {error.one_line()}"]
    return []
