"""What is written, a live session, a table of looks, a table of lifetimes."""

from __future__ import annotations

from typing import Literal

from evermap.config.section import Count, NotNegative, Positive, Probability, Section, key, rule
from evermap.types import DEFAULT_P_FALSE, DEFAULT_P_MISS, DEFAULT_PRIOR


class OutputConfig(Section):
    """What is written beside the numbers."""

    figures: bool = key(True, "draw the figures")
    report: bool = key(True, "write report.html")
    rerun: bool = key(False, "write scene.rrd for the rerun viewer, if rerun-sdk is installed")
    mcap: bool = key(False, "write run.mcap for Foxglove and ROS 2, which needs rosbags")
    score_rate_hz: float = key(2.0, "rate at which a trajectory is compared with truth", gt=0, le=1000)


class LiveConfig(Section):
    """A session that is fed while the robot drives."""

    reorder_s: NotNegative = key(0.1, "maximum delay of a reading behind the newest one, by their stamps [s]")
    checkpoint_s: Positive = key(
        2.0, "interval at which readings are written to the disk: a crash loses so much, and some tenths more [s]"
    )
    revision_s: NotNegative = key(
        300.0, "interval at which the drive enters the map as a revision; 0: only at the end [s]"
    )
    readings_hz: Positive = key(
        300.0, "maximum mean rate of readings that enter the map; above it, whole frames are left out"
    )
    idle_s: Positive = rule(60.0, "odometry that is kept where nothing is mapped, at least [s]")
    clocks_s: Positive = rule(5.0, "more than the clocks of one robot are apart [s]")
    beliefs_s: Positive = rule(300.0, "looks over so long become beliefs, and are not asked again [s]")
    judge_s: Positive = rule(5.0, "interval between searches for changes [s]")
    look_s: Positive = rule(0.5, "time between two frames whose looks are used for that [s]")


NO_RECURRENCE = "none"


class PersistConfig(Section):
    """Beliefs, changes and forecasts of a table of looks."""

    prior: str = key(DEFAULT_PRIOR, "lifetime of features that stay once")
    class_priors: dict[str, str] = key({}, "the same for single classes, by name")
    recurrent: str = key(NO_RECURRENCE, "how features return: 'none' for one stay, a kind of model to learn, or 'auto'")
    per: Literal["auto", "all", "class", "feature"] = key("auto", "which features share a learned model")
    model: str = key("", "file of a learned model; '' learns it from the table")
    learn_from: int = key(
        100_000, "maximum number of looks to learn from: all looks at a random subset of features", ge=2
    )
    most_features_alone: Count = rule(32, "with more features, 'auto' learns one model for all")
    fewest_looks_alone: Count = rule(200, "looks per feature above which 'auto' learns a model for each")
    query: Literal["times", "grid"] = key(
        "times", "'times' asks for the belief at the time of every row, 'grid' at regular times"
    )
    step_s: Positive | None = key(None, "step of grid and forecasts [s]; unset: chosen")
    horizon_s: Positive | None = key(
        None, "how far to forecast beyond the latest look [s]; unset: a share of the looks' span"
    )
    forecast_steps: Count = rule(10, "steps of a forecast, where step_s is unset")
    grid_steps: Count = rule(200, "about so many steps of the grid, where step_s is unset")
    horizon_share: Positive = rule(0.25, "horizon as a share of the span, where none is given")
    confidence: float = key(0.9, "belief above which a change is reported", gt=0.5, lt=1.0)
    tail: float = rule(
        0.025, "probability that a change lies before the interval given for it, and as much after it", gt=0.0, lt=0.5
    )
    p_miss: Probability = key(DEFAULT_P_MISS, "P(no detection | there) if the table has no p_miss")
    p_false: Probability = key(DEFAULT_P_FALSE, "P(detection | not there) if the table has no p_false")
    figures: int = key(12, "number of features with an individual figure", ge=0)
    rows_at_once: int = key(5_000_000, "rows that are held in memory; a larger Parquet table is done in parts", ge=1)

    @property
    def stays_once(self) -> bool:
        """Whether features have one lifetime and never return."""
        return self.recurrent == NO_RECURRENCE and not self.model

    @property
    def learns(self) -> bool:
        """Whether a model is learned from the looks."""
        return self.recurrent != NO_RECURRENCE and not self.model


class SurvivalConfig(Section):
    """Lifetimes estimated from a table of which only bounds are known."""

    estimator: str = key("npmle", "estimator, as listed by `evermap survival fit --help`")
    by: str = key("", "groups that are estimated separately: '', 'class', 'chunk', or 'class,chunk'")
    chunk_m: Positive = key(10.0, "side of the square chunks [m]")
