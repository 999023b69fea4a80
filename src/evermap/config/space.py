"""Recordings in space."""

from __future__ import annotations

import math

from pydantic import field_validator

from evermap.config.section import Count, NotNegative, Positive, Section, Share, key, part, rule
from evermap.config.sensor import KINDS_IN_SPACE, InSpace
from evermap.types import SensorKind


class MapInSpaceConfig(Section):
    """What of a given map in space stands where it says, and what was moved."""

    sigma: Positive = key(0.02, "standard deviation of landmarks that state none [m, rad]")
    scale_sigma: float = key(
        0.02,
        "standard deviation of the odometry's scale, if unstated, where a given map tells it; 0: exact",
        ge=0,
        le=1,
    )
    loose_m: Positive = rule(0.05, "least standard deviation of a map before static landmarks are identified [m, rad]")
    pseudo_count: Positive = rule(
        6.0, "residuals that the accuracy which a map states counts for where that is learned"
    )
    p_moved: Share = key(0.03, "probability that a landmark moved since the map was made")
    moved_m: tuple[Positive, ...] = rule(
        (0.15, 0.5, 2.0), "standard deviations of how far, all alike [m]", min_length=1
    )
    moved_rad: tuple[Positive, ...] = rule(
        (0.05, 0.5), "standard deviations of its turn, all alike [rad]", min_length=1
    )
    moved_nats: NotNegative = rule(5.0, "what it costs that a landmark was moved, instead of the robot [nats]")
    least_seen: Positive = rule(1.0, "sum of inlier probabilities below which a landmark was not seen at its place")
    drift_rad: Positive = rule(
        0.02, "standard deviation of the orientation of unmoved landmarks between sessions [rad]"
    )
    p_told: Share = rule(0.5, "probability from which a landmark is reported as moved")


class RepairConfig(Section):
    """Other explanations of the same views in space: poses, orientations, and identities that several carry."""

    stretch_nats: Positive = rule(6.0, "by which a stretch of frames must prefer other poses to try them [nats]")
    gain_nats: Positive = rule(3.0, "by which all must be more probable in the end [nats]")
    jumps: Count = rule(4, "stretches between jumps of the odometry that are tried without these together, at most")
    other_rad: Positive = rule(0.3, "orientations that differ by more are two [rad]")
    same_rad: Positive = rule(0.05, "orientations that agree to within this are the same [rad]")
    together_m: Positive = rule(0.5, "outliers of one identity that are this close are another landmark [m]")
    fewest: Count = rule(5, "detections that this takes")
    fewest_frames: Count = rule(3, "frames that it takes")


class TrafficConfig(Section):
    """Boxes without identity around a robot with odometry: errors that repeat themselves, by what stands."""

    sigma_scale: Positive = rule(0.05, "standard deviation of the scale of ranges, a share")
    sigma_bend: Positive = rule(
        1e-3, "angle that the odometry turns too little by the metre, standard deviation [rad/m]"
    )
    error_log_odds: float = rule(-3.0, "prior log odds that there is such an error [nats]", ge=-50, le=50)
    still_mps: Positive = rule(0.1, "standard deviation of the measured velocity of a static object [m/s]")
    moving_mps: Positive = rule(3.0, "the same of what moves [m/s]")
    witnesses: Count = rule(10, "fewest objects that must show a drift of the odometry")
    better_by: float = rule(2.0, "factor by which their residuals must become smaller", ge=1.0)
    tilt_rad: Positive = rule(0.05, "boxes are upright to within this [rad]")
    beside_s: Positive = rule(1.0, "time to a look at a landmark within which that locates the robot [s]")


class BodiesConfig(Section):
    """Bodies that carry landmarks, and may move while the robot is there."""

    limit_mps: Positive = key(0.15, "speed at which it is as probable that a body stands as that it moves [m/s]")
    margin_s: NotNegative = rule(0.5, "time before and after a motion in which nothing of it is used [s]")
    unseen_s: Positive = key(5.0, "a body that was not seen for longer may have moved in the meantime [s]")
    lost_s: Positive = rule(1.0, "a box that comes back elsewhere after this time may be around another body [s]")
    stray_m: Positive = rule(0.3, "radius of one of the places of a landmark that is on no known body, at least [m]")


class UpConfig(Section):
    """Where up is in a map in space, which its floor, figures from above and Nav2's files need."""

    direction: tuple[float, float, float] | None = key(
        None, "direction of up in the frame of the map, as [0, 0, 1]; without: as measured, or as the robot moved"
    )
    spread_m: Positive = rule(
        0.5,
        "least standard deviation of positions along the second axis of a plane of motion [m]: within the reach of "
        "an arm, 1.7 m, a hand may move a camera in any plane",
    )
    flatness: Share = rule(0.25, "greatest standard deviation across a plane of motion over that along its second axis")
    turned: Share = rule(
        0.5, "least variance of the headings on the circle that shows an axis of all turns: 160 degrees evenly"
    )
    sway_rad: Positive = rule(0.2, "greatest standard deviation about such an axis [rad]: what is carried level")
    wheels_rad: Positive = rule(0.01, "the same of an odometry of wheels, which has no other turns [rad]")
    tags: Count = rule(3, "fewest tags on walls that show that a camera is not upside down ...")
    tags_agree: Share = rule(0.8, "... if at least this share of them hang upright in it")
    evident: Share = rule(
        0.5,
        "least cosine between an axis and the sensors' up that tells which end of it is up, and of a mean direction",
    )

    @field_validator("direction")
    @classmethod
    def _check_direction(cls, given: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
        if given is not None and not 0.0 < math.hypot(*given) < math.inf:
            raise ValueError("three numbers, not all zero, as [0, 0, 1]")
        return given


class SpaceConfig(Section):
    """What is believed of sensors in space, and estimated beside poses and landmarks."""

    mount_sigma_m: float = key(
        0.0, "standard deviation of the mounts' positions [m]; 0: exactly as stated", ge=0, le=10
    )
    mount_sigma_rad: float = key(
        0.0, "standard deviation of the mounts' orientations [rad]; 0: exactly as stated", ge=0, le=3
    )
    scale_sigma: float = key(
        0.005,
        "standard deviation of the odometry's scale, where tags of known sizes tell it, or nothing does (directions); "
        "0: exact",
        ge=0,
        le=1,
    )
    delay_sigma_s: float = key(
        0.3, "standard deviation of the delay of the sensors' stamps [s]; 0: no delay", ge=0, le=10
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
    sigma_m: Positive = key(
        0.005, "noise of unstated positions at no range [m], to start from: it is learned by range ..."
    )
    sigma_along: NotNegative = rule(0.02, "... along the ray, as a share of the range ...")
    sigma_across: NotNegative = rule(0.01, "... and across")
    sigma_rad: Positive = key(0.05, "standard deviation of an orientation that states none [rad]")
    sigma_px: Positive = key(2.0, "noise of a tag's corners in the image, to start from [px]")
    corner_m: Positive = rule(1e-3, "position of a tag by its corners is no better than this [m]")
    widest: Positive = rule(3.0, "corners farther off the axis than this, over the depth, are not used")
    nearest_m: Positive = rule(0.02, "nothing nearer to a sensor than this is used [m]")
    range_within_s: Positive = rule(15.0, "views within this time give a detection without range one [s]")
    least_parallax: Positive = rule(0.25, "largest standard deviation of such a range, as a share of it")
    drift_m: Positive = rule(0.05, "drift of odometry to start from [m/sqrt(s)]")
    drift_rad: Positive = rule(0.02, "the same of its heading [rad/sqrt(s)]")
    steady_m: Positive = rule(3e-4, "no odometry drifts less than this [m/sqrt(s)]")
    steady_rad: Positive = rule(1e-5, "the same of its heading [rad/sqrt(s)]")
    hand_mps: Positive = key(1.0, "how fast a camera without odometry may go [m/s]")
    hand_radps: Positive = key(0.7, "and turn [rad/s]")
    tied_s: NotNegative = rule(
        0.25, "frames without odometry this close are tied by how far it may go between them [s]"
    )
    pseudo_count: Positive = rule(10.0, "residuals that noise levels to start from count for in what is learned")
    least_noise: tuple[Positive, Positive, Positive, Positive, Positive, Positive] = rule(
        (1e-4, 1e-5, 0.05, 0.05, 0.05, 0.03),
        "least noise levels that are learned: drift [m, rad by sqrt(s)], across, along, turn, corners [px]",
    )
    outlier_log_odds: tuple[Positive, Positive, Positive] = rule(
        (10.5, 14.0, 16.0), "half the squared residual at which positions, poses and corners are as likely outliers"
    )
    jump_log_odds: Positive = rule(
        28.0, "the same of odometry, which may slip: six numbers, each a hundred times as wide"
    )
    inlier: Share = rule(0.5, "inlier probability, or sum of such, from which something was seen")
    field_margin_rad: NotNegative = rule(
        0.02, "a field of view is as wide as what was seen in it, and this wider [rad]"
    )
    range_margin: float = rule(1.1, "nothing is expected farther than this times the farthest", ge=1.0)
    usual_range: Share = rule(0.9, "share of sightings that were nearer than what a look at an empty place reaches")
    faced: Share = rule(0.2, "median cosine of incidence from which landmarks are taken to have a face")
    widest_rad: float = rule(1.4835298641951802, "incidence from which a face is hardly seen [rad]", gt=0, lt=1.6)
    up: UpConfig = part(UpConfig, "where up is")
    map: MapInSpaceConfig = part(MapInSpaceConfig, "a map that is given")
    repair: RepairConfig = part(RepairConfig, "other explanations")
    traffic: TrafficConfig = part(TrafficConfig, "boxes without identity")
    bodies: BodiesConfig = part(BodiesConfig, "landmarks on bodies that move")

    @field_validator("kinds")
    @classmethod
    def _all_kinds(cls, given: dict[SensorKind, InSpace]) -> dict[SensorKind, InSpace]:
        return KINDS_IN_SPACE | given
