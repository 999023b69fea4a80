"""The MRCLAM table for people: means over robots, what was expected beside what came out, and Markdown."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from evermap_studies.markdown import markdown_table, number

Row = Mapping[str, Any]

SETTING_NAMES = {
    "calibrated": "unknown map",
    "plain": "unknown map, `plain`",
    "true_map": "true map given",
    "odometry": "odometry alone",
}


@dataclass(frozen=True, slots=True)
class Expectation:
    """A promise: `statistic` of `key` over the robots in a setting; a ceiling, or a floor."""

    what: str
    setting: str
    key: str
    statistic: str
    limit: float
    unit: str
    floor: bool = False


EXPECTED = (
    Expectation("position error, mean of the robots", "calibrated", "pose_rmse_m", "mean", 0.09, "m"),
    Expectation("position error, worst robot", "calibrated", "pose_rmse_m", "max", 0.13, "m"),
    Expectation("heading error, mean of the robots", "calibrated", "heading_rmse_deg", "mean", 1.5, "deg"),
    Expectation("landmark error, mean of the robots", "calibrated", "landmark_rmse_m", "mean", 0.08, "m"),
    Expectation("true map given: position error, mean", "true_map", "pose_rmse_m", "mean", 0.045, "m"),
    Expectation("true map given: heading error, mean", "true_map", "heading_rmse_deg", "mean", 1.2, "deg"),
    Expectation("speed, streaming, slowest robot", "calibrated", "real_time_factor_streaming", "min", 50.0, "x", True),
)

_STATISTICS: dict[str, Callable[[Sequence[float]], float]] = {
    "mean": lambda values: sum(values) / len(values),
    "max": max,
    "min": min,
}


def means(rows: Iterable[Row]) -> list[dict[str, Any]]:
    """Arithmetic means over the robots of every data set and setting; None where no robot has a value."""
    groups: dict[tuple[int, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["dataset"], row["setting"]), []).append(row)
    out = []
    for (dataset, setting), group in groups.items():
        mean: dict[str, Any] = {"dataset": dataset, "setting": setting, "robots": [row["robot"] for row in group]}
        for key in group[0]:
            if key not in ("dataset", "setting", "robot"):
                mean[key] = _statistic("mean", group, key)
        out.append(mean)
    return out


def verdicts(rows: Iterable[Row], dataset: int) -> list[dict[str, Any]]:
    """Every expectation with what was measured on a data set; `met` is None where nothing was."""
    rows = [row for row in rows if row["dataset"] == dataset]
    out = []
    for promise in EXPECTED:
        value = _statistic(promise.statistic, [row for row in rows if row["setting"] == promise.setting], promise.key)
        met = None if value is None else value >= promise.limit if promise.floor else value <= promise.limit
        out.append(
            {
                "what": promise.what,
                "setting": promise.setting,
                "key": promise.key,
                "statistic": promise.statistic,
                "at_least" if promise.floor else "at_most": promise.limit,
                "unit": promise.unit,
                "measured": value,
                "met": met,
            }
        )
    return out


def as_markdown(table: Mapping[str, Any]) -> str:
    """The whole table as Markdown; no trailing line end."""
    parts = [_expected(table), _machine(table)]
    for dataset in dict.fromkeys(row["dataset"] for row in table["rows"]):
        rows = [row for row in table["rows"] if row["dataset"] == dataset]
        averages = [row for row in table["means"] if row["dataset"] == dataset]
        parts += [f"### Dataset {dataset}", _errors(rows, averages)]
        if any(row.get("bound_heading_rmse_deg") is not None for row in rows):
            parts += [_blind(rows, averages)]
        parts += [_speed(rows, averages)]
    return "\n\n".join(parts)


def _expected(table: Mapping[str, Any]) -> str:
    lines = []
    for row in table["expected"]:
        bound = f"≤ {row['at_most']:g}" if "at_most" in row else f"≥ {row['at_least']:g}"
        verdict = "–" if row["met"] is None else "yes" if row["met"] else "**no**"
        form = "{:.0f}" if row["unit"] == "x" else "{:.3f}" if row["unit"] == "m" else "{:.2f}"
        unit = {"x": "× real time", "deg": "°"}.get(row["unit"], row["unit"])
        lines.append((row["what"], f"{bound} {unit}", f"{number(form, row['measured'])} {unit}", verdict))
    return markdown_table(("Dataset 6, all robots", "expected", "measured", "met"), lines)


def _errors(rows: Sequence[Row], averages: Sequence[Row]) -> str:
    columns = (
        ("position [m]", "pose_rmse_m", "{:.3f}"),
        ("heading [°]", "heading_rmse_deg", "{:.2f}"),
        ("heading in view [°]", "heading_in_view_deg", "{:.2f}"),
        ("landmarks [m]", "landmark_rmse_m", "{:.3f}"),
        ("landmarks, own alignment [m]", "landmark_rmse_own_alignment_m", "{:.3f}"),
        ("online position [m]", "online_pose_rmse_m", "{:.3f}"),
        ("NIS", "nis_mean", "{:.2f}"),
        ("NEES", "nees", "{:.2f}"),
        ("NEES in band", "pose_nees_in_band_share", "{:.0%}"),
    )
    return _by_setting(columns, rows, averages)


def _blind(rows: Sequence[Row], averages: Sequence[Row]) -> str:
    columns = (
        ("longest blind time [s]", "longest_blind_s", "{:.0f}"),
        ("share of the run in view", "in_view_share", "{:.0%}"),
        ("heading, whole run [°]", "heading_rmse_deg", "{:.2f}"),
        ("heading, in view [°]", "heading_in_view_deg", "{:.2f}"),
        ("heading, true poses at all sightings [°]", "bound_heading_rmse_deg", "{:.2f}"),
        ("position, true poses at all sightings [m]", "bound_pose_rmse_m", "{:.3f}"),
    )
    only = [row for row in rows if row["setting"] == "calibrated"]
    return _by_setting(columns, only, [row for row in averages if row["setting"] == "calibrated"])


def _speed(rows: Sequence[Row], averages: Sequence[Row]) -> str:
    columns = (
        ("recording [s]", "duration_s", "{:.0f}"),
        ("streaming [× real time]", "real_time_factor_streaming", "{:.0f}"),
        ("with final smoothing [× real time]", "real_time_factor_whole", "{:.0f}"),
        ("step, median [ms]", "step_p50_ms", "{:.2f}"),
        ("step, 99 % [ms]", "step_p99_ms", "{:.1f}"),
        ("step, longest [ms]", "step_max_ms", "{:.0f}"),
    )
    timed = [row for row in rows if row["setting"] != "odometry"]
    return _by_setting(columns, timed, [row for row in averages if row["setting"] != "odometry"])


def _by_setting(columns: Sequence[tuple[str, str, str]], rows: Sequence[Row], averages: Sequence[Row]) -> str:
    """Rows of a setting together, their mean last; no column without a value."""
    known = [column for column in columns if any(_value(row, column[1]) is not None for row in rows)]
    lines: list[tuple[str, ...]] = []
    for setting, title in SETTING_NAMES.items():
        group = [row for row in (*rows, *averages) if row["setting"] == setting]
        for row in group:
            cells = (number(form, _value(row, key)) for _, key, form in known)
            lines.append((title, str(row.get("robot", "mean")), *cells))
    return markdown_table(("setting", "robot", *(title for title, _, _ in known)), lines)


def _value(row: Row, key: str) -> float | None:
    """NEES where the covariances hold: at the first pose's frame if that is the map's, else after the alignment."""
    if key != "nees":
        return row.get(key)
    anchored: float | None = row.get("pose_nees_anchored_mean")
    return row.get("pose_nees_mean") if anchored is None else anchored


def _machine(table: Mapping[str, Any]) -> str:
    machine, versions = table["machine"], table["machine"]["versions"]
    runs = sum(row["setting"] != "odometry" for row in table["rows"])
    return (
        f"evermap {table['evermap']}, Python {versions['python']}, gtsam {versions['gtsam']}, {machine['processor']}; "
        f"{runs} runs one after the other in {table['processing_s']:.0f} s, {machine['cores_used']:.2f} cores busy."
    )


def _statistic(name: str, rows: Sequence[Row], key: str) -> float | None:
    values = [float(row[key]) for row in rows if row.get(key) is not None]
    return _STATISTICS[name](values) if values else None
