"""The folder that a run leaves behind: written whole or not at all.

Everything is made in a hidden sibling (`.<name>.partial-...`) and takes its place by a rename at the very end, so an
older good run stays until a new good run is there. A folder that holds anything but an evermap run is not replaced.
"""

from __future__ import annotations

import errno
import json
import secrets
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from evermap.errors import ConfigError
from evermap.runsummary import SUMMARY_SCHEMA_VERSION, RunInfo, change_dict, summary_dict, timing_dict
from evermap.types import Innovations, Recording, SlamResult

if TYPE_CHECKING:
    from evermap.metrics.summary import Evaluation
    from evermap.viz.report import ReportSection
    from evermap.viz.style import NamedFigure

SUMMARY = "summary.json"
_IGNORED = {".DS_Store", "Thumbs.db"}
_DISK_FULL = {errno.ENOSPC, errno.EDQUOT}


class RunFolder:
    """Context manager: write into `folder.path(name)`; on success it becomes `out`, on any exception it vanishes.

    Args:
        out: where the run shall be; parents are made.
        force: replace a folder that is not (only) an evermap run, too.

    Raises:
        ConfigError: `out` must not be replaced, see `check_replaceable`.
    """

    def __init__(self, out: str | Path, *, force: bool = False) -> None:
        self.out = Path(out).expanduser().resolve()
        self._force = force
        check_replaceable(self.out, force=force)
        token = secrets.token_hex(4)
        self._partial = self.out.with_name(f".{self.out.name}.partial-{token}")
        self._replaced = self.out.with_name(f".{self.out.name}.replaced-{token}")

    def __enter__(self) -> Self:
        try:
            self._partial.mkdir(parents=True)
        except OSError as error:
            raise _cannot_write(self.out, error) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._swap_in()
        finally:
            shutil.rmtree(self._partial, ignore_errors=True)
        if isinstance(error, OSError) and (
            error.errno in _DISK_FULL or str(error.filename or "").startswith(str(self._partial))
        ):
            raise _cannot_write(self.out, error) from error

    def path(self, name: str) -> Path:
        """Where to write the file `name` for now; its folder exists."""
        path = self._partial / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def files(self) -> list[str]:
        """Names of all files written so far, sorted, with forward slashes."""
        return sorted(path.relative_to(self._partial).as_posix() for path in self._partial.rglob("*") if path.is_file())

    def _swap_in(self) -> None:
        """Two renames; if the second fails the old folder comes back."""
        check_replaceable(self.out, force=self._force)  # it may have changed during a long run
        try:
            if self.out.exists():
                self.out.rename(self._replaced)
            try:
                self._partial.rename(self.out)
            except OSError:
                if self._replaced.exists():
                    self._replaced.rename(self.out)
                raise
        except OSError as error:
            raise _cannot_write(self.out, error) from error
        shutil.rmtree(self._replaced, ignore_errors=True)


def check_replaceable(out: str | Path, *, force: bool = False) -> None:
    """Whether a run may be written to `out`: it does not exist, is empty, or holds an evermap run and nothing else.

    Raises:
        ConfigError: it is a file, the working or home folder or one above, or holds other things (unless `force`).
    """
    out = Path(out).expanduser().resolve()
    if out.exists() and not out.is_dir():
        raise ConfigError("is a file; results need a folder", path=out, field="out", hint="another --out")
    if any(place.is_relative_to(out) for place in _places()):
        raise ConfigError("would replace the working or home folder", path=out, field="out", hint="a folder below it")
    if force or not out.exists():
        return
    foreign = _foreign_file(out)
    if foreign is not None:
        problem = f"holds '{foreign}', which no evermap run wrote"
        raise ConfigError(problem, path=out, field="out", hint="another --out, or --force to replace all of it")


def _places() -> list[Path]:
    """Folders that must not vanish."""
    places = []
    for find in (Path.cwd, Path.home):
        try:
            places.append(find().resolve())
        except (OSError, RuntimeError):  # no such folder: nothing to protect
            continue
    return places


def _foreign_file(folder: Path) -> str | None:
    """The first file in `folder` that its summary does not list; None where there is none."""
    try:
        summary = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
        ours = set(summary["outputs"]) if "evermap" in summary and "schema_version" in summary else set()
    except (OSError, ValueError, KeyError, TypeError):
        ours = set()
    there = (path.relative_to(folder).as_posix() for path in sorted(folder.rglob("*")) if not path.is_dir())
    return next((name for name in there if name not in ours and Path(name).name not in _IGNORED), None)


def _cannot_write(out: Path, error: OSError) -> ConfigError:
    return ConfigError(f"cannot be written: {error.strerror or error}", path=out, field="out", hint="another --out")


def write_run(
    out: str | Path,
    recording: Recording,
    result: SlamResult,
    config: Any = None,
    *,
    info: RunInfo | None = None,
    sections: Sequence[ReportSection] = (),
    figures: bool | None = None,
    report: bool | None = None,
    scene: bool | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Evaluates a run and writes its folder. Returns the content of `summary.json`.

    Args:
        out: the folder; an older run there is replaced at the end (see `RunFolder`).
        recording: what was processed.
        result: what came out.
        config: a `Config`, or any mapping that JSON can hold; None if there is none.
        info: what the numbers alone cannot say: command, seeds, measured times.
        sections: parts that the caller adds to the report.
        figures: whether to draw; None leaves it to `config.output.figures`, or draws.
        report: likewise `report.html`, `config.output.report`.
        scene: likewise `scene.rrd`, `config.output.rerun`; on None it is left out with a warning where rerun-sdk is
            missing.
        force: replace `out` whatever it holds.

    Raises:
        ConfigError: `out` must not or cannot be written.
        MissingExtraError: `scene` is True and rerun-sdk is missing.
    """
    from evermap.metrics.summary import RATE_HZ, compare_with_truth, metrics_dict

    wanted = getattr(config, "output", None)
    rate_hz = float(getattr(wanted, "score_rate_hz", RATE_HZ))
    info = info or RunInfo()
    with RunFolder(out, force=force) as folder:
        evaluation = compare_with_truth(recording, result, rate_hz=rate_hz)
        timing = timing_dict(recording, result, info)
        _write_estimates(folder, result)
        drawn: tuple[NamedFigure, ...] = ()
        draw = _choose(figures, wanted, "figures")
        tell = _choose(report, wanted, "report")
        if draw or tell:
            drawn = _draw(recording, result, evaluation, timing)
        if draw:
            _write_figures(folder, drawn)
        remarks = []
        if _choose(scene, wanted, "rerun"):
            remarks += _write_scene(folder, recording, result, evaluation, must=scene is True)

        outputs = sorted({*folder.files(), SUMMARY, *(["report.html"] if tell else [])})
        summary = summary_dict(
            recording,
            result,
            metrics_dict(evaluation),
            config=_plain(config),
            info=info,
            timing=timing,
            outputs=outputs,
            warnings=remarks,
        )
        folder.path(SUMMARY).write_text(summary_text(summary), encoding="utf-8")
        if tell:
            from evermap.viz.report import render_report

            page = render_report(recording, result, evaluation, summary, drawn, sections)
            folder.path("report.html").write_text(page, encoding="utf-8")
    return summary


def summary_text(summary: Mapping[str, Any]) -> str:
    """`summary.json` as text: keys sorted, floats in their shortest exact form, so equal runs give equal bytes."""
    return json.dumps(summary, indent=2, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n"


def _choose(asked: bool | None, wanted: Any, name: str) -> bool:
    return bool(getattr(wanted, name, True)) if asked is None else asked


def _plain(config: Any) -> Any:
    """Configuration as JSON values; a pydantic model dumps itself."""
    if config is None:
        return {}
    return config.model_dump(mode="json") if hasattr(config, "model_dump") else json.loads(json.dumps(config))


def _write_estimates(folder: RunFolder, result: SlamResult) -> None:
    from evermap.io.geojson import write_map_geojson
    from evermap.io.landmarks import write_map_parquet
    from evermap.io.tum import write_tum

    write_tum(result.trajectory, folder.path("trajectory.tum"))
    write_tum(result.online, folder.path("online.tum"))
    write_map_parquet(result.landmarks, folder.path("map.parquet"))
    write_map_geojson(result.landmarks, folder.path("map.geojson"))
    for rank, alternative in enumerate(result.alternatives, start=1):
        write_map_geojson(alternative.landmarks, folder.path(f"alternative_{rank}.geojson"))
    _write_innovations(result.innovations, folder.path("innovations.parquet"))
    lines = "".join(json.dumps(change_dict(change), allow_nan=False) + "\n" for change in result.changes)
    folder.path("changes.jsonl").write_text(lines, encoding="utf-8")


def _write_innovations(innovations: Innovations, path: Path) -> None:
    """One row a detection that had a prediction; columns as the attributes of `Innovations`."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = {name: getattr(innovations, name) for name in ("stamp_s", "detection", "landmark_id", "nis", "p_inlier")}
    pq.write_table(pa.table(columns), path)


def _draw(
    recording: Recording, result: SlamResult, evaluation: Evaluation, timing: Mapping[str, Any]
) -> tuple[NamedFigure, ...]:
    from evermap.viz.figures import draw_figures

    return draw_figures(recording, result, evaluation, real_time_factor=timing["real_time_factor"])


def _write_figures(folder: RunFolder, figures: Sequence[NamedFigure]) -> None:
    from evermap.viz.style import save_png, save_svg

    for named in figures:
        save_png(named.figure, folder.path(f"figures/{named.name}.png"))
        save_svg(named.figure, folder.path(f"figures/{named.name}.svg"))


def _write_scene(
    folder: RunFolder, recording: Recording, result: SlamResult, evaluation: Evaluation, *, must: bool
) -> list[str]:
    """Writes the scene; where it is only a default and cannot be written, a remark says so."""
    from evermap.errors import MissingExtraError
    from evermap.viz.rerun_scene import write_scene

    try:
        write_scene(recording, result, folder.path("scene.rrd"), evaluation=evaluation)
    except MissingExtraError as error:
        if must:
            raise
        return [f"scene.rrd was left out: {error.one_line()}"]
    return []


__all__ = ["SUMMARY_SCHEMA_VERSION", "RunFolder", "RunInfo", "check_replaceable", "summary_dict", "write_run"]
