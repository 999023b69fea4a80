"""Settings of the estimator, corrections of the sensor, and what a run writes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from pydantic import ValidationInfo, field_validator

from evermap.config.section import Count, NotNegative, Positive, Probability, Section, Share, key, part
from evermap.errors import ConfigError
from evermap.types import NOT_IN_SPACE, FloatArray, Sensor, SensorKind, SpatialSensor

SIGMAS = {
    "range_bias_m": 0.1,
    "range_slope": 0.02,
    "range_skew_per_rad": 0.1,
    "range_curvature_per_rad2": 0.5,
    "bearing_bias_rad": 0.05,
    "mount_forward_m": 0.03,
    "mount_left_m": 0.03,
    "odometry_delay_s": 0.3,
    "odometry_forward_scale": 0.05,
    "odometry_turn_scale": 0.1,
    "odometry_turn_slip_m": 0.05,
}
OfSensor = tuple[Positive, Positive, Positive, Positive, Positive]
KINDS: dict[SensorKind, OfSensor] = {
    SensorKind.LASER: (0.05, 0.002, 0.002, 0.002, 0.01),
    SensorKind.CAMERA: (0.1, 0.02, 0.1, 0.5, 0.05),
    SensorKind.TAG: (0.05, 0.02, 0.05, 0.1, 0.05),
    SensorKind.STEREO: (0.05, 0.02, 0.05, 0.1, 0.03),
    SensorKind.UWB: (0.3, 0.005, 0.02, 0.02, 0.05),
}
InSpace = tuple[Positive, Positive, NotNegative, NotNegative]
KINDS_IN_SPACE: dict[SensorKind, InSpace] = {
    SensorKind.LASER: (0.001, 0.02, 0.001, 0.003),
    SensorKind.CAMERA: (0.02, 0.02, 0.1, 0.005),
    SensorKind.TAG: (0.005, 0.005, 0.02, 0.005),
    SensorKind.STEREO: (0.01, 0.01, 0.03, 0.003),
    SensorKind.UWB: (0.003, 0.1, 0.002, 0.05),
}


class CalibrationConfig(Section):
    """Which calibration states are estimated, and what is believed of them before."""

    fix: dict[str, float] = key(
        {}, "calibration states held at a value instead of estimated, by name, e.g. odometry_delay_s = 0.0"
    )
    sigma: dict[str, Positive] = key(SIGMAS, "standard deviations of their priors, each in its own unit")
    kinds: dict[SensorKind, OfSensor] = key(
        KINDS, "those of the first five, which depend on the kind of sensor, where it is stated"
    )
    sigma_askew_rad: Positive = key(0.03, "of the direction in which a robot drives, from its front, if unstated [rad]")
    p_needed: Share = key(0.5, "prior probability that a state is not as stated")
    p_needed_known: Share = key(0.9, "the same of a sensor that is stated to be of another kind than a laser")
    p_needed_mount: Share = key(
        0.1, "the same of each coordinate of the mount, which one measures, if it has no data sheet"
    )
    p_spare: Share = key(0.01, "probability to be needed below which a state is held as stated")

    @field_validator("sigma", "kinds")
    @classmethod
    def _all(cls, given: dict[Any, Any], info: ValidationInfo) -> dict[Any, Any]:
        usual: dict[Any, Any] = SIGMAS if info.field_name == "sigma" else KINDS
        if unknown := given.keys() - usual.keys():
            raise ValueError(f"no calibration state is called '{min(unknown)}': {', '.join(usual)}")
        return usual | given


class OdometryConfig(Section):
    """What is believed of the odometry, beside its noise."""

    silence_s: Positive = key(1.0, "gap of the odometry beyond which the last velocity is not continued [s]")
    silent_variance: Positive = key(0.25, "variance that such a silence adds every second, at least [m^2/s, rad^2/s]")
    longest_silence_s: Positive = key(60.0, "after a longer silence no more is unknown than after this [s]")
    turn_s: Positive = key(2.0, "span over which turns stand out from jitter [s]")
    stands_out: Positive = key(3.0, "standard deviations of the jitter by which it does")
    loose_rad: Positive = key(0.3, "heading that a silence leaves unknown, from which a recording is in parts [rad]")


class VotesConfig(Section):
    """Identities that were read wrongly, by other detections of the seconds around."""

    window_s: Positive = key(5.0, "before and after a detection, the odometry hardly drifts [s]")
    sigma_m: Positive = key(0.05, "error of a detection's place at no distance [m] ...")
    sigma_share: NotNegative = key(0.05, "... and as a share of its range")
    gate: Positive = key(2.0, "standard deviations within which another detection is of the same place")
    fewest: Count = key(2, "detections with another id that contradict one, at least ...")
    times: NotNegative = key(3.0, "... and more than so many times those with its own")
    fewest_doubles: Count = key(3, "frames that have an id at two places, from which on it is on two landmarks")
    surprising: Positive = key(50.0, "squared normalised residual from which a sighting disputes where its landmark is")


class RangesConfig(Section):
    """Detections without a bearing: where their landmarks are, before the estimator begins."""

    window_s: Positive = key(20.0, "span of ranges that locate a landmark, or the double, and so on [s]")
    drift_share: NotNegative = key(0.03, "drift of the odometry over it, as a share of the way")
    fewest: Count = key(6, "ranges that this takes")
    most_ranges: Count = key(200, "ranges that are used, at most")
    starts: int = key(16, "directions from which the place is sought", ge=4)
    steps: Count = key(30, "steps from each")
    tail: Positive = key(2.0, "standard deviations beyond which a range is probably an outlier")
    most_sigma_m: Positive = key(1.0, "standard deviation from which a place is not known [m]")
    apart_m: Positive = key(1.0, "distance from which another place is another one [m] ...")
    rival_nats: NotNegative = key(6.0, "... and how much worse it must be [nats]")
    first_m: Positive = key(1.0, "least standard deviation of the place at which the estimator begins [m]")


class LocalizeConfig(Section):
    """When the place of a robot in a map is known, and when it is lost; landmarks are found by their identity."""

    fewest: Count = key(3, "landmarks that must have the relative positions of the map")
    enough: Count = key(5, "so many do by no accident, even if they are fewer than half")
    alone_s: NotNegative = key(10.0, "where no third landmark comes into view for so long, two are enough [s]")
    spread_m: Positive = key(1.0, "how far apart they must be, for a recording that is smoothed afterwards [m]")
    spread_online_m: Positive = key(
        2.0, "the same for a robot that is followed in the map: farther than on one body [m]"
    )
    track_s: Positive = key(30.0, "age of sightings that odometry still ties to the newest [s]")
    least_belief: Share = key(0.05, "least probability that a landmark is at its known place, if it is seen there")
    believed: Share = key(0.5, "belief from which not to be seen is a miss")
    sure_m: Positive = key(0.5, "no landmark is expected while the position is less certain than this [m]")
    least_p_detect: Share = key(0.01, "P(detect) from which a landmark is expected in view")
    doubt: Positive = key(1.0, "by which a place is doubted for each frame that has its landmark elsewhere [nats] ...")
    most_doubt: Positive = key(9.0, "... and by which in all, at most [nats]")
    remembered: Count = key(8, "landmarks, compared last, that judge whether the robot is lost")
    least_remembered: Count = key(3, "the same, at least")
    memory_s: Positive = key(20.0, "age up to which they do [s]")
    better_by: float = key(1.5, "times that another pose must fit better than this one", ge=1.0)


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
    rounds: int = key(10, "maximum rounds of selecting modes and relinearising", ge=1, le=100)
    mcts_budget: int = key(200, "iterations of the tree search for every decision", ge=1)
    mcts_window_s: Positive | None = key(40.0, "window of the tree search [s]; unset: from the start")


class ChangesConfig(Section):
    """The joint search over changes."""

    p_moved: float = key(0.01, "prior probability that anything moved at all", gt=0, lt=1)
    move_sigma_m: Positive = key(0.7, "standard deviation of a displacement, each axis [m]")
    p_rotated: Probability = key(0.1, "share of moves with a rotation")
    turn_sigma_rad: Positive = key(0.5, "standard deviation of such a rotation [rad]")
    rigid_m: Positive = key(0.005, "members of a group keep their distances to within this [m]")
    p_swapped: Share = key(1e-5, "probability that any two landmarks of a map were mixed up")
    displaced_log_odds: float = key(
        7.0, "prior log odds against a temporary displacement of a landmark [nats]", gt=0, le=50
    )
    map_factor_spread: Positive = key(0.35, "standard deviation of the logarithm of a factor on the sigmas of a map")
    softness_m: tuple[Positive, ...] = key(
        (0.005, 0.01, 0.02, 0.04),
        "candidate common errors of the sightings of a landmark in a part of the session; chosen by evidence [m]",
        min_length=1,
    )
    usual_softness_m: Positive = key(0.02, "the same during the search for swaps and temporary displacements [m]")
    most_groups: Count = key(4, "maximum number of moved groups")
    most_candidates: Count = key(40, "maximum number of candidates for moves, the likeliest")
    visit_gap_s: Positive = key(10.0, "gap between sightings after which a new visit begins [s]")
    interval: Share = key(0.95, "probability of the reported interval of a change")
    rival_nats: NotNegative = key(5.0, "maximum distance of a reported alternative from the best explanation [nats]")
    most_rivals: int = key(2, "maximum number of reported alternatives", ge=0)
    disagreement: Positive = key(4.0, "chi-square per degree of freedom above which a map without changes does not fit")
    loose_map_m: Positive = key(1.0, "standard deviation of a map that must not distort the session [m]")

    @property
    def spread(self) -> FloatArray:
        """(3,) standard deviations of a displacement in x [m] and y [m], and of its angle [rad]."""
        return np.array([self.move_sigma_m, self.move_sigma_m, self.turn_sigma_rad])


class CheckConfig(Section):
    """What makes a recording odd; see `slam.check`."""

    lags_s: tuple[Positive, ...] = key(
        (1.0, 4.0), "minimum time between compared sightings; the maximum is twice as long [s]", min_length=1
    )
    most_pairs: Count = key(1000, "pairs of sightings compared for each lag, at most")
    fits: Positive = key(0.03, "usual difference between two readings: share of the range, and rad")
    apart: Positive = key(3.0, "difference in median residuals by which a pair distinguishes two explanations")
    agreed: Share = key(0.8, "share of those pairs that a mistake must explain to be reported")
    fewest: Count = key(20, "minimum number of such pairs")
    gain: Positive = key(20.0, "minimum gain in log likelihood of a mistake over all pairs")
    off: Positive = key(0.3, "median residual above which readings and odometry are unrelated")
    own_ids: Count = key(
        50, "number of landmarks above which hardly any second sighting indicates that ids name detections"
    )
    far_off: Positive = key(5.0, "standard deviations of its prior beyond which a calibration state is reported")


class CleaningConfig(Section):
    """What is left out of the recording of a session as impossible; see `slam.cleaning`."""

    fastest: Positive = key(100.0, "speed above which odometry is dropped [m/s, rad/s]")
    hardest: Positive = key(20.0, "acceleration above which odometry is a spike [m/s^2, rad/s^2]")
    sharpest: Positive = key(2.0, "change of speed that is never a spike [m/s, rad/s]")
    too_far: float = key(2.0, "factor on the maximum range above which a reading is dropped", ge=1.0)
    far_from_median: float = key(100.0, "the same on the median range, for a sensor without a maximum range", ge=1.0)
    ranges_only: Share = key(0.2, "share of readings without a bearing above which a sensor measures ranges only")
    moved: Positive = key(0.1, "motion after which identical readings indicate stale data [m, rad]")
    stray_s: Positive = key(
        10.0, "distance from neighbouring stamps, and of frames from odometry, above which they are dropped [s]"
    )
    step_s: Positive = key(1.0, "smallest step of a clock that is repaired [s]")
    around: int = key(9, "messages that a stamp is compared with; an odd number", ge=3, le=999)

    @field_validator("around")
    @classmethod
    def _odd(cls, around: int) -> int:
        if around % 2 == 0:
            raise ValueError(f"must be an odd number, not {around}")
        return around


class ConstellationConfig(Section):
    """Maps that are aligned by the constellation of their landmarks alone."""

    near_m: Positive = key(0.5, "distance within which two landmarks are a pair, once aligned [m]")
    least_span_m: Positive = key(0.5, "landmarks that are closer than this fix no heading [m]")
    span_slack_m: NotNegative = key(0.2, "tolerance of distances within both maps, beside their uncertainty [m]")
    free_m: Positive = key(5.0, "standard deviation of the offset around a candidate motion [m]")
    free_rad: Positive = key(2.0, "standard deviation of its rotation [rad]")
    certain_nats: NotNegative = key(7.0, "evidence of an alignment over no alignment, and over its best rival [nats]")
    lead_nats: NotNegative = key(20.0, "the same over its best rival, if a large map was searched [nats]")
    stiff_m: Positive = key(0.2, "landmarks known this well relative to each other are one rigid part of a map [m]")
    longest_side_m: Positive = key(25.0, "longest side of an indexed triangle [m]")
    side_sigmas: Positive = key(3.4, "standard deviations by which the sides of matching triangles may differ ...")
    side_slack_m: NotNegative = key(0.02, "... and by this in addition [m]")
    same_place_m: Positive = key(5.0, "motions that differ by less at the centre of a session are one alignment [m]")
    least_found: Share = key(0.4, "least share of a group that must be found in a map")
    reach_m: Positive = key(15.0, "distance within which places are compared, once an alignment is known [m]")


class ReadingsConfig(Section):
    """Columns that describe landmarks, such as radius or colour."""

    misread_nats: NotNegative = key(2.995732273553991, "evidence of one reading for or against a match, at most [nats]")
    most_readings: Count = key(4, "readings that a visit counts as, at most: their errors are correlated")
    least_nats: NotNegative = key(0.1, "mean evidence per pair of visits, below which columns are not used [nats]")
    confidence: Share = key(0.999, "confidence that landmarks differ in a column, to use it")
    fewest_in_halves: int = key(6, "readings of a visit from which its first and second half are compared", ge=2)
    p_wrong: Share = key(0.1, "prior share of visits that are assigned to the wrong landmark ...")
    wrong_worth: Positive = key(2.0, "... and the visits that this prior counts as")
    preferred_nats: NotNegative = key(2.0, "gain in log likelihood that a smaller error of visits needs [nats]")
    fewest_pairs: Positive = key(3.0, "pairs of visits from which that error is learned")


class ParticlesConfig(Section):
    """Whole histories of associations, drawn where many detections are ambiguous."""

    new_nats: NotNegative = key(2.995732273553991, "log odds of clutter against a landmark that is new [nats]")
    wider: tuple[Positive, ...] = key(
        (1.2, 1.5), "factors on the noise of sightings, one after the other", min_length=1
    )
    bent: Positive = key(0.3, "error of known landmarks, as a share of the distance to the nearest one")


class AnonymousInSpaceConfig(Section):
    """The same in space, where it differs."""

    least_extent_m: Positive = key(1.0, "least extent of the landmarks along each axis [m]")
    least_volume_m3: Positive = key(20.0, "least volume that they span [m^3]")
    shared_rad: Positive = key(0.05, "error that all sightings of an orientation have in common [rad]")
    alike_rad: Positive = key(0.2, "spread of the orientations of landmarks on one wall [rad]")
    turn_sigmas: Positive = key(4.0, "standard deviations by which orientations of one landmark may differ ...")
    turn_floor_rad: Positive = key(0.1, "... where their least error is this [rad]")
    same_turn_rad: Positive = key(0.5, "alignments with a map whose orientation differs by less are one [rad]")
    tail: float = key(5.0, "factor on the error of detections in the tail ...", ge=1)
    tail_share: Share = key(0.1, "... and their share")
    widened: Positive = key(1.5, "factor on the variance of a detection, for the uncertainty of the poses")


class AssociationConfig(Section):
    """Landmarks without identities, associated by geometry."""

    gate_confidence: Share = key(0.999, "share of true pairs inside the gates")
    loose_gate: Positive = key(
        60.0, "squared distance up to which landmarks are compared, before shared errors are known"
    )
    p_match: Share = key(0.95, "probability from which a detection is assigned at once ...")
    p_return: Share = key(0.99, "... and to a landmark that was out of view, which closes a loop")
    tight_m2: Positive = key(0.04, "area of a gate in which a wrong choice is harmless for a while [m^2]")
    followed: float = key(2.0, "a landmark is tracked while it at most multiplies the noise of readings by this", ge=1)
    unmet_share: Share = key(0.1, "share of landmarks near tracked ones that are not mapped yet")
    p_new: Share = key(0.1, "probability to be new from which a detection starts a landmark")
    p_merge: Share = key(0.97, "probability from which two landmarks are merged")
    p_own: Share = key(0.5, "least probability of the landmark that a detection ends with")
    forget_s: Positive = key(20.0, "gap after which a new visit begins, and landmarks with too few sightings go [s]")
    fewest_to_pair: Count = key(2, "sightings from which two landmarks may be merged")
    least_landmarks: Positive = key(2.0, "least number of landmarks in their density ...")
    least_area_m2: Positive = key(20.0, "... and the least area that they span [m^2]")
    odometry_caution: Positive = key(2.0, "factor on the odometry noise during association")
    slip: Positive = key(3.0, "factor on that in a step with slipping wheels ...")
    slip_nats: NotNegative = key(2.995732273553991, "... and its prior log odds [nats]")
    noise_caution: Positive = key(1.3, "factor on the learned noise of sightings")
    noise_floor: Positive = key(0.5, "prior of that noise, as a share of the stated one ...")
    pseudo_sightings: Positive = key(100.0, "... and the sightings that this counts as")
    clipped_at: Positive = key(9.0, "squared normalised residual that counts in full where variances are learned")
    shared_m: Positive = key(0.02, "error that all sightings of a landmark have in common [m] ...")
    shared_share: NotNegative = key(0.5, "... and as a share of their range noise")
    name_nats: NotNegative = key(
        4.605170185988092, "evidence of an identity that two landmarks share, per reading [nats] ..."
    )
    most_names: Count = key(10, "... of which so many count, at most")
    rise_nats: NotNegative = key(7.0, "rise of the cost that is accepted for a merge [nats] ...")
    rise_per_sighting: NotNegative = key(1.75, "... for each sighting of the lesser one [nats] ...")
    most_rise_nats: NotNegative = key(100.0, "... and in all, at most [nats]")
    landmark_nats: NotNegative = key(7.0, "cost of a further landmark [nats]")
    few_nats: NotNegative = key(7.0, "evidence for merging two pairs or one, while later frames may tell more [nats]")
    double_nats: NotNegative = key(5.0, "evidence against a pair for each frame that shows both [nats]")
    in_turn_nats: NotNegative = key(0.2, "evidence for a pair for each frame that shows only one of them [nats] ...")
    most_in_turn_nats: NotNegative = key(10.0, "... and in all, at most: one may hide the other")
    around_frames: Count = key(3, "frames before and after, in which it should have been seen")
    contradiction: Share = key(0.95, "confidence from which a visit contradicts all others")
    fewest_displaced: Count = key(4, "landmarks from which a stretch is displaced as a whole")
    least_seen: Share = key(1.0 / 3.0, "sightings below this share of the usual number are of no landmark")
    doubtful_share: Probability = key(0.008, "share of ambiguous detections from which particles are drawn")
    constellation: ConstellationConfig = part(ConstellationConfig, "aligned maps")
    readings: ReadingsConfig = part(ReadingsConfig, "columns of detections")
    particles: ParticlesConfig = part(ParticlesConfig, "drawn histories")
    space: AnonymousInSpaceConfig = part(AnonymousInSpaceConfig, "points and tags")


class MapInSpaceConfig(Section):
    """What of a given map in space stands where it says, and what was moved."""

    sigma: Positive = key(0.02, "standard deviation of landmarks that state none [m, rad]")
    loose_m: Positive = key(0.05, "least standard deviation of a map before static landmarks are identified [m, rad]")
    pseudo_count: Positive = key(6.0, "residuals that the accuracy which a map states counts for where that is learned")
    p_moved: Share = key(0.03, "probability that a landmark moved since the map was made")
    moved_m: tuple[Positive, ...] = key((0.15, 0.5, 2.0), "standard deviations of how far, all alike [m]", min_length=1)
    moved_rad: tuple[Positive, ...] = key((0.05, 0.5), "standard deviations of its turn, all alike [rad]", min_length=1)
    moved_nats: NotNegative = key(5.0, "what it costs that a landmark was moved, instead of the robot [nats]")
    least_seen: Positive = key(1.0, "sum of inlier probabilities below which a landmark was not seen at its place")
    drift_rad: Positive = key(0.02, "standard deviation of the orientation of unmoved landmarks between sessions [rad]")
    p_told: Share = key(0.5, "probability from which a landmark is reported as moved")


class RepairConfig(Section):
    """Other explanations of the same views in space: poses, orientations, and identities that several carry."""

    stretch_nats: Positive = key(6.0, "by which a stretch of frames must prefer other poses to try them [nats]")
    gain_nats: Positive = key(3.0, "by which all must be more probable in the end [nats]")
    jumps: Count = key(4, "stretches between jumps of the odometry that are tried without these together, at most")
    other_rad: Positive = key(0.3, "orientations that differ by more are two [rad]")
    same_rad: Positive = key(0.05, "orientations that agree to within this are the same [rad]")
    together_m: Positive = key(0.5, "outliers of one identity that are this close are another landmark [m]")
    fewest: Count = key(5, "detections that this takes")
    fewest_frames: Count = key(3, "frames that it takes")


class TrafficConfig(Section):
    """Boxes without identity around a robot with odometry: errors that repeat themselves, by what stands."""

    sigma_scale: Positive = key(0.05, "standard deviation of the scale of ranges, a share")
    sigma_bend: Positive = key(
        1e-3, "angle that the odometry turns too little by the metre, standard deviation [rad/m]"
    )
    error_log_odds: float = key(-3.0, "prior log odds that there is such an error [nats]", ge=-50, le=50)
    still_mps: Positive = key(0.1, "standard deviation of the measured velocity of a static object [m/s]")
    moving_mps: Positive = key(3.0, "the same of what moves [m/s]")
    witnesses: Count = key(10, "fewest objects that must show a drift of the odometry")
    better_by: float = key(2.0, "factor by which their residuals must become smaller", ge=1.0)
    tilt_rad: Positive = key(0.05, "boxes are upright to within this [rad]")


class SpaceConfig(Section):
    """What is believed of sensors in space, and estimated beside poses and landmarks."""

    mount_sigma_m: float = key(
        0.0, "standard deviation of the mounts' positions [m]; 0: exactly as stated", ge=0, le=10
    )
    mount_sigma_rad: float = key(
        0.0, "standard deviation of the mounts' orientations [rad]; 0: exactly as stated", ge=0, le=3
    )
    scale_sigma: float = key(
        0.005, "standard deviation of the odometry's scale, where tags of known sizes tell it; 0: exact", ge=0, le=1
    )
    delay_sigma_s: float = key(
        0.0, "standard deviation of the delay of the sensors' stamps [s]; 0: no delay", ge=0, le=10
    )
    range_scale: float | None = key(
        None,
        "factor on the ranges of boxes without identity; unset: estimated from static objects, in the odometry's scale",
        gt=0.5,
        lt=2.0,
    )
    kinds: dict[SensorKind, InSpace] = key(
        KINDS_IN_SPACE,
        "of a stated kind of sensor: standard deviation of the scale of its ranges, a share, and the next three keys",
    )
    sigma_m: Positive = key(0.005, "noise of unstated positions at no range [m] ...")
    sigma_along: NotNegative = key(0.02, "... along the ray, as a share of the range ...")
    sigma_across: NotNegative = key(0.01, "... and across")
    sigma_rad: Positive = key(0.05, "standard deviation of an orientation that states none [rad]")
    sigma_px: Positive = key(2.0, "noise of a tag's corners in the image, to start from [px]")
    corner_m: Positive = key(1e-3, "position of a tag by its corners is no better than this [m]")
    widest: Positive = key(3.0, "corners farther off the axis than this, over the depth, are not used")
    nearest_m: Positive = key(0.02, "nothing nearer to a sensor than this is used [m]")
    range_within_s: Positive = key(15.0, "views within this time give a detection without range one [s]")
    least_parallax: Positive = key(0.25, "largest standard deviation of such a range, as a share of it")
    drift_m: Positive = key(0.05, "drift of odometry to start from [m/sqrt(s)]")
    drift_rad: Positive = key(0.02, "the same of its heading [rad/sqrt(s)]")
    steady_m: Positive = key(3e-4, "no odometry drifts less than this [m/sqrt(s)]")
    steady_rad: Positive = key(1e-5, "the same of its heading [rad/sqrt(s)]")
    hand_mps: Positive = key(1.0, "how fast a camera without odometry may go [m/s]")
    hand_radps: Positive = key(0.7, "and turn [rad/s]")
    tied_s: NotNegative = key(0.25, "frames without odometry this close are tied by how far it may go between them [s]")
    pseudo_count: Positive = key(10.0, "residuals that noise levels to start from count for in what is learned")
    least_noise: tuple[Positive, Positive, Positive, Positive, Positive, Positive] = key(
        (1e-4, 1e-5, 0.05, 0.05, 0.05, 0.03),
        "least noise levels that are learned: drift [m, rad by sqrt(s)], across, along, turn, corners [px]",
    )
    outlier_log_odds: tuple[Positive, Positive, Positive] = key(
        (10.5, 14.0, 16.0), "half the squared residual at which positions, poses and corners are as likely outliers"
    )
    jump_log_odds: Positive = key(
        28.0, "the same of odometry, which may slip: six numbers, each a hundred times as wide"
    )
    inlier: Share = key(0.5, "inlier probability, or sum of such, from which something was seen")
    field_margin_rad: NotNegative = key(0.02, "a field of view is as wide as what was seen in it, and this wider [rad]")
    range_margin: float = key(1.1, "nothing is expected farther than this times the farthest", ge=1.0)
    usual_range: Share = key(0.9, "share of sightings that were nearer than what a look at an empty place reaches")
    faced: Share = key(0.2, "median cosine of incidence from which landmarks are taken to have a face")
    widest_rad: float = key(1.4835298641951802, "incidence from which a face is hardly seen [rad]", gt=0, lt=1.6)
    map: MapInSpaceConfig = part(MapInSpaceConfig, "a map that is given")
    repair: RepairConfig = part(RepairConfig, "other explanations")
    traffic: TrafficConfig = part(TrafficConfig, "boxes without identity")

    @field_validator("kinds")
    @classmethod
    def _all_kinds(cls, given: dict[SensorKind, InSpace]) -> dict[SensorKind, InSpace]:
        return KINDS_IN_SPACE | given


class NoiseConfig(Section):
    """Noise levels that a run starts from, where the sensor states none."""

    sigma_range_m: Positive = key(0.1, "standard deviation of ranges [m]")
    sigma_bearing_rad: Positive = key(0.02, "standard deviation of bearings [rad]")
    forward_by_distance: Positive = key(0.05, "of forward motion, by distance [m/sqrt(m)]")
    forward_by_turn: Positive = key(0.05, "of forward motion, by angle turned [m/sqrt(rad)]")
    sideways_by_distance: Positive = key(0.03, "of sideways motion, by distance [m/sqrt(m)]")
    turn_by_time: Positive = key(0.01, "of turning, by time [rad/sqrt(s)]")
    turn_by_turn: Positive = key(0.05, "of turning, by angle turned [rad/sqrt(rad)]")
    pseudo_count: Positive = key(1.0, "pseudo-residuals of these levels")


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
    rejected_in_a_row: Count = key(
        5, "sightings of a landmark in a row, rejected as outliers, from which another optimum is sought"
    )
    narrowing: tuple[Positive, ...] = key(
        (10.0, 3.0), "noise of detections on the way to that optimum, as multiples of what it is"
    )
    estimate_noise: bool = key(True, "learn noise levels from the recording; off: keep the nominal ones")
    odometry_noise_factor: Positive = key(1.0, "factor on the initial odometry noise, kept if estimate_noise is off")
    seed: int = key(0, "random seed", ge=0)
    calibration: CalibrationConfig = part(CalibrationConfig, "calibration states")
    modes: ModesConfig = part(ModesConfig, "methods 'max-mixture' to 'viterbi': landmarks with several positions")
    changes: ChangesConfig = part(ChangesConfig, "method 'joint': groups of moved landmarks")
    noise: NoiseConfig = part(NoiseConfig, "noise levels to start from")
    odometry: OdometryConfig = part(OdometryConfig, "silences and jitter of the odometry")
    votes: VotesConfig = part(VotesConfig, "identities that were read wrongly")
    association: AssociationConfig = part(AssociationConfig, "landmarks without identities")
    ranges: RangesConfig = part(RangesConfig, "detections without a bearing")
    localize: LocalizeConfig = part(LocalizeConfig, "where a robot is in a map")
    space: SpaceConfig = part(SpaceConfig, "sensors in space")
    check: CheckConfig = part(CheckConfig, "thresholds of the recording check")
    cleaning: CleaningConfig = part(CleaningConfig, "limits for dropping defects of a recording")


class SensorConfig(Section):
    """Corrections of what the recording says about its sensor; unset fields keep the recording's value."""

    range_min_m: float | None = key(None, "minimum range [m]", ge=0)
    range_max_m: Positive | None = key(None, "maximum range [m]")
    bearing_min_rad: float | None = key(None, "right edge of the field of view [rad]", ge=-3.2, le=3.2)
    bearing_max_rad: float | None = key(None, "left edge of the field of view [rad]", ge=-3.2, le=3.2)
    sigma_range_m: Positive | None = key(None, "nominal range noise [m]; a starting value")
    sigma_bearing_rad: Positive | None = key(None, "nominal bearing noise [rad]; a starting value")
    p_detect: Probability | None = key(None, "probability of detecting a landmark in view")
    p_false: Probability | None = key(None, "probability of a false detection in a frame")
    mount_robot_sensor: tuple[float, float, float] | None = key(
        None, "pose of the sensor on the robot: x [m], y [m], theta [rad]"
    )
    kind: SensorKind | None = key(None, "kind of sensor, which sets the priors of its errors")
    sigma_scale: float | None = key(None, "relative standard deviation of the scale of its ranges", ge=0, le=1)
    sigma_offset_m: float | None = key(None, "standard deviation of the offset of its ranges [m]", ge=0)
    sigma_angle_rad: float | None = key(None, "standard deviation of its mounting angle [rad]", ge=0, le=6.3)
    sigma_position_m: float | None = key(
        None, "standard deviation of its position on the robot, along each axis [m]", ge=0, le=1e3
    )
    sigma_odometer_scale: float | None = key(
        None, "relative standard deviation of the scale of the odometer", ge=0, le=1
    )
    sigma_askew_rad: float | None = key(
        None, "standard deviation of the driving direction relative to the front [rad]", ge=0, le=6.3
    )

    def applied_to(self, sensor: Sensor) -> Sensor:
        """Return the recording's sensor with the fields that are set here; ConfigError if then nothing can be in
        view.
        """
        merged = replace(sensor, **self.model_dump(exclude_none=True))
        for low, high in (("range_min_m", "range_max_m"), ("bearing_min_rad", "bearing_max_rad")):
            if getattr(merged, low) >= getattr(merged, high):
                problem = f"{getattr(merged, low):g} is not below {high} = {getattr(merged, high):g}"
                raise ConfigError(problem, field=f"sensor.{low}")
        return merged

    def applied_in_space(self, sensors: Sequence[SpatialSensor]) -> tuple[SpatialSensor, ...]:
        """Return the sensors of a recording in space with the fields that are set here, each the same.

        Raises:
            ConfigError: a field that means nothing in space, or nothing can be in range.
        """
        given = self.model_dump(exclude_none=True)
        for name, hint in NOT_IN_SPACE.items():
            if name in given:
                raise ConfigError("is not used for a recording in space", field=f"sensor.{name}", hint=hint)
        merged = tuple(replace(sensor, **given) for sensor in sensors)
        for one in merged:
            if one.range_min_m >= one.range_max_m:
                problem = f"{one.range_min_m:g} is not below range_max_m = {one.range_max_m:g}"
                raise ConfigError(problem, field="sensor.range_min_m")
        return merged


class OutputConfig(Section):
    """What is written beside the numbers."""

    figures: bool = key(True, "draw the figures")
    report: bool = key(True, "write report.html")
    rerun: bool = key(False, "write scene.rrd for the rerun viewer, if rerun-sdk is installed")
    mcap: bool = key(False, "write run.mcap for Foxglove and ROS 2, which needs rosbags")
    score_rate_hz: float = key(2.0, "rate at which a trajectory is compared with truth", gt=0, le=1000)
