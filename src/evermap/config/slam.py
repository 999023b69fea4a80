"""The estimator of a session, in the plane and in space."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import field_validator

from evermap.config.association import AssociationConfig
from evermap.config.section import Count, NotNegative, Positive, Probability, Section, Share, key, part, rule
from evermap.config.sensor import CalibrationConfig, OdometryConfig
from evermap.config.space import SpaceConfig
from evermap.types import FloatArray


class VotesConfig(Section):
    """Identities that were read wrongly, by other detections of the seconds around."""

    window_s: Positive = rule(5.0, "before and after a detection, the odometry hardly drifts [s]")
    sigma_m: Positive = rule(0.05, "error of a detection's place at no distance [m] ...")
    sigma_share: NotNegative = rule(0.05, "... and as a share of its range")
    gate: Positive = rule(2.0, "standard deviations within which another detection is of the same place")
    fewest: Count = rule(2, "detections with another id that contradict one, at least ...")
    times: NotNegative = rule(3.0, "... and more than so many times those with its own")
    fewest_doubles: Count = rule(3, "frames that have an id at two places, from which on it is on two landmarks")
    surprising: Positive = rule(
        50.0, "squared normalised residual from which a sighting disputes where its landmark is"
    )


class RangesConfig(Section):
    """Detections without a bearing: where their landmarks are, before the estimator begins."""

    window_s: Positive = rule(20.0, "span of ranges that locate a landmark, or the double, and so on [s]")
    drift_share: NotNegative = rule(0.03, "drift of the odometry over it, as a share of the way")
    fewest: Count = rule(6, "ranges that this takes")
    most_ranges: Count = rule(200, "ranges that are used, at most")
    starts: int = rule(16, "directions from which the place is sought", ge=4)
    steps: Count = rule(30, "steps from each")
    tail: Positive = rule(2.0, "standard deviations beyond which a range is probably an outlier")
    most_sigma_m: Positive = rule(1.0, "standard deviation from which a place is not known [m]")
    apart_m: Positive = rule(1.0, "distance from which another place is another one [m] ...")
    rival_nats: NotNegative = rule(6.0, "... and how much worse it must be [nats]")
    first_m: Positive = rule(1.0, "least standard deviation of the place at which the estimator begins [m]")


class RoomConfig(Section):
    """What tells that landmarks lie over a map from landmarks of another place, where each stands anywhere."""

    p_another_place: Share = rule(1e-3, "probability that a session is from another place")
    smallest_room_m2: Positive = rule(50.0, "minimum area in which moved landmarks may be found [m^2]")
    lowest_room_m: Positive = rule(1.0, "height of a room in space, at least [m]")
    lead_nats: NotNegative = key(
        3.0, "log odds of an alignment over the next best one, from which it is accepted [nats]"
    )


class LocalizeConfig(RoomConfig):
    """When the place of a robot in a map is known, and when it is lost; landmarks are found by their identity."""

    fewest: Count = key(3, "landmarks that must have the relative positions of the map")
    p_stands: Share = rule(0.9, "probability that a landmark is where the map has it, at most: groups move together")
    certain_nats: NotNegative = key(
        6.0, "log odds of an alignment over another place, from which it is accepted [nats]"
    )
    enough: Count = rule(5, "landmarks of the map that a live session has met when it is entered")
    alone_s: NotNegative = key(10.0, "where no third landmark comes into view for so long, two are enough [s]")
    spread_m: Positive = rule(1.0, "how far apart they must be, for a recording that is smoothed afterwards [m]")
    spread_online_m: Positive = rule(
        2.0, "the same for a robot that is followed in the map: farther than on one body [m]"
    )
    track_s: Positive = rule(30.0, "age of sightings that odometry still ties to the newest [s]")
    least_belief: Share = rule(0.05, "least probability that a landmark is at its known place, if it is seen there")
    believed: Share = rule(0.5, "belief from which not to be seen is a miss")
    sure_m: Positive = rule(0.5, "no landmark is expected while the position is less certain than this [m]")
    least_p_detect: Share = rule(0.01, "P(detect) from which a landmark is expected in view")
    doubt: Positive = rule(1.0, "by which a place is doubted for each frame that has its landmark elsewhere [nats] ...")
    most_doubt: Positive = rule(9.0, "... and by which in all, at most [nats]")
    remembered: Count = rule(8, "landmarks, compared last, that judge whether the robot is lost")
    least_remembered: Count = rule(3, "the same, at least")
    memory_s: Positive = rule(20.0, "age up to which they do [s]")
    better_by: float = rule(1.5, "times that another pose must fit better than this one", ge=1.0)


class ModesConfig(Section):
    """Landmarks with several positions (Nielsen and Hendeby 2024): gates, switching, selectors."""

    gate_probability: Probability = key(
        0.95, "a detection outside this confidence region of all modes starts a new mode"
    )
    switch_probability: Probability = key(
        1e-4, "probability of a landmark to be in another mode at the next look; ignored with a lifetime"
    )
    births: Literal["evidence", "gate"] = key(
        "evidence", "'evidence' keeps a new mode that explains more than it costs, 'gate' every one, as the paper does"
    )
    lifetime: str | None = key(
        None, "prior of how long a mode lasts, e.g. 'exponential:half-life=30d'; unset: constant"
    )
    rounds: int = rule(10, "maximum rounds of selecting modes and relinearising", ge=1, le=100)
    mcts_budget: int = key(200, "iterations of the tree search for every decision", ge=1)
    mcts_window_s: Positive | None = key(40.0, "window of the tree search [s]; unset: from the start")


class ChangesConfig(Section):
    """The joint search over changes."""

    p_moved: float = key(0.01, "prior probability that anything moved at all", gt=0, lt=1)
    move_sigma_m: Positive = key(0.7, "standard deviation of a displacement, each axis [m]")
    far: float = rule(10.0, "how much farther some things are moved than most, across the room", gt=1.0)
    p_far: Share = rule(0.1, "share of things that are")
    body_m: Positive = rule(0.5, "usual distance of two landmarks on a body that turned [m]")
    p_rotated: Probability = rule(0.1, "share of moves with a rotation")
    turn_sigma_rad: Positive = rule(0.5, "standard deviation of such a rotation [rad]")
    rigid_m: Positive = rule(0.005, "members of a group keep their distances to within this [m]")
    p_swapped: Share = rule(1e-5, "probability that any two landmarks of a map were mixed up")
    displaced_log_odds: float = rule(
        7.0, "prior log odds against a temporary displacement of a landmark [nats]", gt=0, le=50
    )
    map_factor_spread: Positive = rule(0.35, "standard deviation of the logarithm of a factor on the sigmas of a map")
    softness_m: tuple[Positive, ...] = rule(
        (0.005, 0.01, 0.02, 0.04),
        "candidate common errors of the sightings of a landmark in a part of the session; chosen by evidence [m]",
        min_length=1,
    )
    usual_softness_m: Positive = rule(0.02, "the same during the search for swaps and temporary displacements [m]")
    most_groups: Count = key(4, "maximum number of moved groups")
    most_candidates: Count = rule(40, "maximum number of candidates for moves, the likeliest")
    visit_gap_s: Positive = rule(10.0, "gap between sightings after which a new visit begins [s]")
    interval: Share = rule(0.95, "probability of the reported interval of a change")
    rival_nats: NotNegative = rule(5.0, "maximum distance of a reported alternative from the best explanation [nats]")
    most_rivals: int = rule(2, "maximum number of reported alternatives", ge=0)
    disagreement: Positive = rule(
        4.0, "chi-square per degree of freedom above which a map without changes does not fit"
    )
    loose_map_m: Positive = rule(1.0, "standard deviation of a map that must not distort the session [m]")

    @property
    def spread(self) -> FloatArray:
        """(3,) standard deviations of a displacement in x [m] and y [m], and of its angle [rad]."""
        return np.array([self.move_sigma_m, self.move_sigma_m, self.turn_sigma_rad])


class CheckConfig(Section):
    """What makes a recording odd; see `slam.check`."""

    lags_s: tuple[Positive, ...] = rule(
        (1.0, 4.0), "minimum time between compared sightings; the maximum is twice as long [s]", min_length=1
    )
    most_pairs: Count = rule(1000, "pairs of sightings compared for each lag, at most")
    fits: Positive = rule(0.03, "usual difference between two readings: share of the range, and rad")
    apart: Positive = rule(3.0, "difference in median residuals by which a pair distinguishes two explanations")
    agreed: Share = rule(0.8, "share of those pairs that a mistake must explain to be reported")
    fewest: Count = rule(20, "minimum number of such pairs")
    gain: Positive = rule(20.0, "minimum gain in log likelihood of a mistake over all pairs")
    off: Positive = rule(0.3, "median residual above which readings and odometry are unrelated")
    own_ids: Count = rule(
        50, "number of landmarks above which hardly any second sighting indicates that ids name detections"
    )
    far_off: Positive = rule(5.0, "standard deviations of its prior beyond which a calibration state is reported")


class CleaningConfig(Section):
    """What is left out of the recording of a session as impossible; see `slam.cleaning`."""

    fastest: Positive = key(100.0, "speed above which odometry is dropped [m/s, rad/s]")
    hardest: Positive = key(20.0, "acceleration above which odometry is a spike [m/s^2, rad/s^2]")
    sharpest: Positive = rule(2.0, "change of speed that is never a spike [m/s, rad/s]")
    too_far: float = rule(2.0, "factor on the maximum range above which a reading is dropped", ge=1.0)
    far_from_median: float = rule(100.0, "the same on the median range, for a sensor without a maximum range", ge=1.0)
    ranges_only: Share = rule(0.2, "share of readings without a bearing above which a sensor measures ranges only")
    moved: Positive = rule(0.1, "motion after which identical readings indicate stale data [m, rad]")
    stray_s: Positive = key(
        10.0, "distance from neighbouring stamps, and of frames from odometry, above which they are dropped [s]"
    )
    step_s: Positive = rule(1.0, "smallest step of a clock that is repaired [s]")
    around: int = rule(9, "messages that a stamp is compared with; an odd number", ge=3, le=999)

    @field_validator("around")
    @classmethod
    def _odd(cls, around: int) -> int:
        if around % 2 == 0:
            raise ValueError(f"must be an odd number, not {around}")
        return around


class ExplainConfig(Section):
    """Causes other than changes of landmarks: when they are asked, and what they must gain."""

    on: bool = key(True, "ask for causes where a session contradicts what was stated")
    rejected: Share = rule(0.08, "share of rejected detections from which causes are asked")
    innovations: Positive = rule(1.35, "mean squared normalised innovation, a number, from which causes are asked")
    states: Positive = rule(
        4.0, "standard deviations of a calibration state from its prior from which causes are asked"
    )
    noise: Positive = rule(3.0, "factor of a noise level on what is stated from which causes are asked")
    late_s: Positive = rule(0.1, "delay of a clock from which it is told as a cause, though estimated anyway [s]")
    map_changed: Share = rule(0.4, "share of a given map that has changed from which the map itself is asked")
    lead_nats: NotNegative = key(6.0, "log evidence by which a cause must win, its price paid [nats]")
    rival: Share = rule(0.1, "probability from which a cause is named beside a change that may be instead")
    most_causes: Count = rule(2, "causes that are combined, at most")
    most_tried: Count = rule(4, "causes under which a session is solved again, for each that is added, at most")
    most_solutions: Count = rule(12, "solutions in all, at most")


class NoiseConfig(Section):
    """Noise levels that a run starts from, where the sensor states none."""

    sigma_range_m: Positive = key(0.1, "standard deviation of ranges [m]")
    sigma_bearing_rad: Positive = key(0.02, "standard deviation of bearings [rad]")
    forward_by_distance: Positive = key(0.05, "of forward motion, by distance [m/sqrt(m)]")
    forward_by_turn: Positive = key(0.05, "of forward motion, by angle turned [m/sqrt(rad)]")
    sideways_by_distance: Positive = key(0.03, "of sideways motion, by distance [m/sqrt(m)]")
    turn_by_time: Positive = key(0.01, "of turning, by time [rad/sqrt(s)]")
    turn_by_turn: Positive = key(0.05, "of turning, by angle turned [rad/sqrt(rad)]")
    pseudo_count: Positive = rule(1.0, "pseudo-residuals of these levels")


class SlamConfig(Section):
    """The estimator."""

    method: Literal["nohyp", "max-mixture", "nn", "em", "mcts", "viterbi", "joint"] = key(
        "joint", "method that finds moved landmarks; 'nohyp' assumes a static world"
    )

    sensor_model: Literal["calibrated", "plain"] = key(
        "calibrated", "'calibrated' estimates sensor and odometry errors with the map, 'plain' trusts all readings"
    )
    unknown_ids: bool | Literal["empty"] = key(
        False, "associate by geometry: true ignores all identities, 'empty' associates only detections without one"
    )
    vote_ids: bool = key(
        True,
        "remove identities that other detections at the same place within seconds contradict, and those on "
        "two landmarks",
    )
    robust: bool = key(True, "down-weight detections with a wrong identity; off only for comparison")
    outlier_log_odds: float = key(
        7.0, "an outlier is as likely as an inlier at a squared normalised residual of twice this", gt=0, le=50
    )
    fewest_sightings: Count = key(3, "fewest sightings that locate a landmark: one or two may have a wrong identity")
    rejected_in_a_row: Count = rule(
        5, "sightings of a landmark in a row, rejected as outliers, from which another optimum is sought"
    )
    narrowing: tuple[Positive, ...] = rule(
        (10.0, 3.0), "noise of detections on the way to that optimum, as multiples of what it is"
    )
    estimate_noise: bool = key(True, "learn noise levels from the recording; off: keep the nominal ones")
    odometry_noise_factor: Positive = key(1.0, "factor on the initial odometry noise, kept if estimate_noise is off")
    online: bool = key(False, "also compute what the robot knew at the time of each frame: `online.tum`, step times")
    plane: bool | None = key(
        None, "estimate a recording in space in the plane, or not; without: where it is one of a robot on a floor"
    )
    seed: int = key(0, "random seed", ge=0)
    calibration: CalibrationConfig = part(CalibrationConfig, "calibration states")
    modes: ModesConfig = part(ModesConfig, "methods 'max-mixture' to 'viterbi': landmarks with several positions")
    changes: ChangesConfig = part(ChangesConfig, "method 'joint': groups of moved landmarks")
    noise: NoiseConfig = part(NoiseConfig, "noise levels to start from")
    explain: ExplainConfig = part(ExplainConfig, "causes other than changes of landmarks")
    odometry: OdometryConfig = part(OdometryConfig, "silences and jitter of the odometry")
    votes: VotesConfig = part(VotesConfig, "identities that were read wrongly")
    association: AssociationConfig = part(AssociationConfig, "landmarks without identities")
    ranges: RangesConfig = part(RangesConfig, "detections without a bearing")
    localize: LocalizeConfig = part(LocalizeConfig, "where a robot is in a map")
    space: SpaceConfig = part(SpaceConfig, "sensors in space")
    check: CheckConfig = part(CheckConfig, "thresholds of the recording check")
    cleaning: CleaningConfig = part(CleaningConfig, "limits for dropping defects of a recording")
