"""Settings of a map that lives on from session to session."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from evermap.config.section import Count, NotNegative, Positive, Probability, Section, Share


class FitConfig(Section):
    """When a session is believed to lie in the map, and which of its landmarks are believed."""

    least_fit: Share = Field(
        default=0.75, description="share of the sightings consistent within the session that must also fit the map"
    )
    most_lost: Share = Field(
        default=0.03,
        description="if this larger share of sightings fits within the session than with the map, the "
        "session is distorted",
    )
    inlier: Share = Field(default=0.5, description="inlier probability above which a sighting counts")
    sightings: Positive = Field(default=1.5, description="inliers that a landmark needs to be accepted")
    sightings_in_place: Positive = Field(default=0.5, description="the same for a landmark at its place in the map")
    misread_m: Positive = Field(
        default=0.3, description="distance within which a landmark may be another one with a misread identity [m]"
    )
    misread_share: Share = Field(
        default=0.2, description="maximum share of sightings for that, if it is never in one frame with the other one"
    )
    glimpse_m: Positive = Field(default=0.4, description="a landmark seen once this close to its place is present [m]")
    bent_m: Positive = Field(
        default=0.15, description="tolerance within which bodies with a common motion indicate a distorted session [m]"
    )
    bent_cliques: int = Field(default=3, ge=2, description="minimum number of bodies with a common motion for that")
    window: Count = Field(default=12, description="sightings by which each pose of a distorted session is aligned")
    bent_windows: Count = Field(
        default=3, description="so many of these that contradict the rest are wrong poses, not misread identities"
    )
    placing_m: Positive = Field(default=0.3, description="residual above which sightings are down-weighted in that [m]")
    loose_m: Positive = Field(
        default=0.5, description="position uncertainty above which silent odometry splits a session into parts [m]"
    )
    loose_rad: Positive = Field(default=0.1, description="the same for the heading [rad]")


class OverlayConfig(Section):
    """Priors of the search for what stands where the map has it."""

    nudge_m: Positive = Field(default=0.7, description="standard deviation of a small move, each axis [m]")
    share_nudged: Share = Field(default=0.5, description="share of moves that are small; the others are unbounded")
    turn_m: Positive = Field(
        default=0.35, description="standard deviation of the rotation of a moved body, at its members [m]"
    )
    p_split: Share = Field(default=1e-3, description="probability that landmarks assigned to one body are not")
    p_another_place: Share = Field(default=1e-3, description="probability that a session is from another place")
    smallest_room_m2: Positive = Field(
        default=50.0, description="minimum area in which moved bodies may be found [m^2]"
    )
    drifts_m: tuple[Positive, ...] = Field(
        default=(0.01, 0.02, 0.04, 0.08),
        min_length=1,
        description="candidate standard deviations of unmoved landmarks from session to session [m]",
    )
    free_m: Positive = Field(
        default=20.0, description="standard deviation of a session's place around the one agreed on, each axis [m]"
    )
    free_rad: Positive = Field(default=3.0, description="the same of its heading [rad]")
    lowest_room_m: Positive = Field(default=1.0, description="height of a room in space, at least [m]")
    stood_rad: tuple[Positive, ...] = Field(
        default=(0.02, 0.06, 0.15),
        min_length=1,
        description="standard deviations of a common apparent turn of unmoved landmarks in space [rad]",
    )
    turned_rad: tuple[Positive, ...] = Field(
        default=(0.2, 1.0), min_length=1, description="the same of landmarks that were moved [rad]"
    )
    p_coarser: Share = Field(default=0.5, description="probability of each of these, relative to the one before")


class MetreConfig(Section):
    """What sessions and robots say of the length of a metre, together."""

    walk: Positive = Field(
        default=0.002, description="standard deviation by which a map's metre wanders in a session, as a share"
    )
    contradicts: Positive = Field(
        default=4.0, description="standard deviations from which a session's metre contradicts the map's"
    )
    p_drifted: Share = Field(
        default=0.05, description="probability that a robot's metre is not what its sensor is said to know"
    )
    drifted: float = Field(default=4.0, ge=1.0, description="times by which it is off then, as standard deviation")
    p_told: Share = Field(default=0.95, description="probability from which a robot is reported as drifted")


class NamelessConfig(Section):
    """Landmarks without identities in a map: by their constellation."""

    fewest: Count = Field(default=4, description="landmarks that must be found in the map together")
    farthest_m: Positive = Field(default=2.0, description="how far a landmark that is the same may be off [m]")
    bent_m: Positive = Field(default=2.0, description="the same behind a stretch that is bent [m]")
    p_found: Share = Field(
        default=0.9, description="probability that a landmark next to a detected one is detected, too"
    )


class BoxesConfig(Section):
    """Boxes without identity in a map: which are the same from session to session."""

    drift_m: Positive = Field(
        default=0.2, description="standard deviation of the position of an unmoved box between sessions, each axis [m]"
    )
    height_m: Positive = Field(default=0.5, description="the same of its height over a street that is not flat [m]")
    far_share: Share = Field(default=0.3, description="share of boxes that are off by more ...")
    far_factor: float = Field(default=3.0, ge=1.0, description="... namely by so many times that")
    sigma_size_m: tuple[Positive, Positive, Positive] = Field(
        default=(0.4, 0.15, 0.15), description="standard deviations of one box's size, session to session [m]"
    )
    sigma_class_m: tuple[Positive, Positive, Positive] = Field(
        default=(0.6, 0.2, 0.25), description="standard deviations of the sizes of boxes of one class [m]"
    )
    size_nats: Positive = Field(default=8.0, description="evidence of size or heading against a match, at most [nats]")
    heading_rad: Positive = Field(default=0.15, description="standard deviation of headings [rad]")
    round: Positive = Field(default=1.3, description="boxes less long than this times their width have no heading")
    density: Positive = Field(default=0.02, description="least density of static boxes [1/m^2]")
    p_stands: Share = Field(default=0.9, description="probability that a box is detected at its place again")
    returns: Share = Field(
        default=0.5, description="prior probability that an arrival at a former place of a box is that box"
    )
    least_gone: Share = Field(default=0.02, description="least probability that a box left a place now taken")
    same_share: Positive = Field(default=0.6, description="boxes closer than this share of their widths are merged")
    at_once_s: NotNegative = Field(
        default=5.0, description="a box that is detected again at its place within this time had not left [s]"
    )
    named_m: Positive = Field(
        default=0.5, description="a landmark with an identity is where the map has it, if this near [m]"
    )
    shared_pairs: int = Field(default=3, ge=2, description="boxes that must agree with the odometry's frame ...")
    shared_nats: NotNegative = Field(default=4.0, description="... and evidence that it takes [nats]")
    found_pairs: int = Field(
        default=4, ge=2, description="boxes that must agree with a place that was searched for ..."
    )
    enough_pairs: int = Field(default=8, ge=2, description="... and so many end the search")
    lead_nats: NotNegative = Field(default=12.0, description="by which that place must beat all others [nats]")
    metre_sigmas: NotNegative = Field(
        default=2.0, description="standard deviations by which a session's metre must be off to be corrected"
    )
    near_m: Positive = Field(
        default=30.0, description="how far boxes may be off behind a stretch in which nothing was seen [m]"
    )
    largest_turn_rad: Positive = Field(default=0.3, description="how far they may be turned then [rad]")
    drift_share: NotNegative = Field(
        default=0.02, description="how far odometry may be off from one box to the next, of the distance"
    )
    most_drift_m: Positive = Field(default=0.5, description="the same, at most [m]")
    misfit: Positive = Field(
        default=3.0, description="mean squared deviation of boxes from which the odometry is believed less"
    )
    among_m: Positive = Field(default=15.0, description="boxes of the map this near: a session was here before [m]")
    least_share: Share = Field(
        default=0.3, description="share of the boxes seen among those of the map that must be boxes of it"
    )
    perhaps: Share = Field(default=0.2, description="belief from which a box of the map counts for that")
    tied_m: Positive = Field(
        default=80.0, description="beyond this distance from the landmarks shared with the map, misses are ignored [m]"
    )
    glimpse_m: Positive = Field(
        default=1.0, description="a detection this near to a box of the map may be of it, at no range [m] ..."
    )
    glimpse_share: NotNegative = Field(default=0.01, description="... and farther off by this share of its range")
    fewest_glimpses: Count = Field(default=2, description="such detections that a session takes")
    behind_m: Positive = Field(default=1.5, description="what is this much farther than another box is hidden [m] ...")
    covered: Positive = Field(default=0.4, description="... within this share of that box's length from its middle")


class LooksConfig(Section):
    """What counts as having looked at a place of the map."""

    range_margin_m: Positive = Field(
        default=0.2, description="softness of the edge of a sensor's range, where errors of pose and map decide [m]"
    )
    bearing_margin_rad: Positive = Field(default=0.05, description="the same of its field of view [rad]")
    worth_a_look: Share = Field(
        default=0.3, description="share of a sensor's detection probability from which a landmark is looked at"
    )
    settled_s: NotNegative = Field(default=300.0, description="a landmark seen this close to a look was there [s]")
    settled_online_s: NotNegative = Field(
        default=10.0, description="the same while the robot drives, as long as the session is not over [s]"
    )
    beside_m: Positive = Field(default=1.0, description="sightings this close to a place are along its line [m]")
    beside_rad: Positive = Field(default=0.15, description="so is a landmark seen behind it within this angle [rad]")
    along_m: Positive = Field(
        default=0.3, description="distance from a line of sight within which a sighting shows it to be clear [m]"
    )
    witnesses: Count = Field(default=3, description="frames in which another landmark must be seen along a line")
    sides: Count = Field(default=6, description="number of sectors around a place")
    most_sides: Count = Field(default=3, description="sectors from which a place counts as seen from all sides")
    together_m: NotNegative = Field(
        default=2.0, description="cliques missed from places this close may be hidden by one object [m]"
    )
    near_m: NotNegative = Field(
        default=0.6, description="a place is visible from positions this close to one from which it was seen [m]"
    )
    least_expected: Positive = Field(default=2.0, description="minimum expected detections of earlier looks")
    sticky: float = Field(default=2.0, ge=1.0, description="consecutive frames that count as one independent one")


class DecisionConfig(Section):
    """What is told of a session, and what a map forgets."""

    least_evidence: NotNegative = Field(
        default=1.5, description="log likelihood ratio of looks against a clique before it is reported as vanished"
    )
    credible: Share = Field(
        default=0.6,
        description="a missed clique is gone only if it also is under the upper bound of this lifetime interval",
    )
    same_place_m: Positive = Field(
        default=0.3, description="bodies this close to the former place of another one have taken its place [m]"
    )
    same_turn_rad: Positive = Field(default=0.3, description="bodies turned by less than this have not turned [rad]")
    same_spot_m: Positive = Field(default=0.1, description="bodies this close to their former place have not moved [m]")
    new_clique_p: Share = Field(default=0.9, description="belief in a new body before its sightings are counted")
    surely_away: Probability = Field(default=0.02, description="belief below which a clique may be forgotten")
    forgotten_p: Probability = Field(default=0.05, description="probability of a return below which it is forgotten")
    most_away: int = Field(
        default=20, ge=0, description="absent cliques that are kept, in addition to the number of present ones"
    )
    most_stays: Count = Field(default=5000, description="newest stays from which lifetimes are learned")


class GroupingConfig(Section):
    """Which landmarks are on one body, by how they moved."""

    p_one_body: Share = Field(default=0.9, description="probability that two landmarks of a clique are on one body")
    p_split_before: Share = Field(default=0.05, description="the same for two nearby ones of different cliques")
    p_other_class: Share = Field(default=0.001, description="the same for two nearby ones of different classes")
    p_moved: Share = Field(default=0.1, description="probability that a body moves between two sessions")
    move_sigma_m: Positive = Field(default=2.0, description="standard deviation of displacements, each axis [m]")
    misses_in_a_row: float = Field(
        default=4.0, ge=1.0, description="misses of one session that count as one independent one"
    )
    p_wrong: Share = Field(
        default=1e-3, description="probability that a landmark's identity is misread for a whole session"
    )


class LifetimeConfig(Section):
    """How lifetimes are learned from the history of a map."""

    newest: Count = Field(default=300, description="newest stays of a class from which its lifetime is learned")
    strength: Positive = Field(default=2.0, description="pseudo-events of the average over classes in each class")
    least_ended: Count = Field(default=5, description="ends in a chunk before it has its own lifetimes")
    sure: Share = Field(default=0.999, description="probability above which an end of a stay counts as certain")
    firmness: tuple[Positive, ...] = Field(
        default=(1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0),
        min_length=1,
        description="candidate numbers of pseudo-ends of a class in its chunks; learned",
    )
    prior_quantiles: Count = Field(default=64, description="number of stay lengths that represent a given prior")
    prior_shortest_s: Positive = Field(default=60.0, description="minimum of these lengths [s]")
    prior_longest_s: Positive = Field(default=1.5e9, description="length at which these are censored [s]")


class SightConfig(Section):
    """What is believed of lines of sight, and how it is learned."""

    most_looks: Positive = Field(
        default=200.0,
        description="maximum looks along one line; beyond it, old ones fade, so that a moved wall is learned",
    )
    strength: Positive = Field(default=4.0, description="pseudo-looks of the rate of all clear lines of that length")
    nominal_looks: Positive = Field(default=20.0, description="pseudo-looks of the nominal rate")
    p_blocked_detect: Share = Field(default=0.03, description="detection rate along blocked lines")
    least_rate: Share = Field(default=0.002, description="minimum detection rate of any kind of line")
    highest_rate: Share = Field(default=0.98, description="maximum detection rate of any kind of line")
    neighbour: Probability = Field(
        default=0.35, description="weight of looks from the eight cells around, in looks along the line"
    )
    clear: Share = Field(default=0.9, description="probability above which a line is known to be clear")
    blocked: Share = Field(default=0.25, description="probability below which a line is known to be blocked")
    p_hidden_unseen: Share = Field(
        default=0.1,
        description="probability that a place is hidden for a whole session (a shut door) if its lines "
        "were clear before",
    )
    p_hidden_beside: Share = Field(default=0.03, description="the same if another landmark is seen along them now")
    p_hidden_unknown: Share = Field(
        default=0.2, description="the same if they were unknown, but a landmark close to them and behind is seen"
    )
    hidden_looks: Positive = Field(default=5.0, description="pseudo-sessions of these probabilities")
    most_sessions: Positive = Field(default=2000.0, description="sessions of cliques after which old ones fade")

    @property
    def p_hidden(self) -> tuple[float, float, float]:
        """That a place cannot be seen for a whole session, by what is known of its lines; see `SightLines.hidden`."""
        return self.p_hidden_unseen, self.p_hidden_beside, self.p_hidden_unknown

    @property
    def rates(self) -> tuple[float, float]:
        """Bounds of detection rates along lines."""
        return self.least_rate, self.highest_rate


class LivingConfig(Section):
    """A map that lives on from session to session; parts are switched off only to see what they contribute."""

    search: Literal["joint", "gate", "none"] = Field(
        default="joint",
        description="how a session is aligned with the map: 'joint' searches over all moves together, with the "
        "trajectory marginalised; 'gate' tests one clique after the other, at the aligned poses; 'none': "
        "nothing moves",
    )
    existence: bool = Field(default=True, description="misses lower P(exists); off: landmarks exist permanently")
    returns: bool = Field(default=True, description="absent landmarks may return; off: they never do (Rosen 2016)")
    misses: bool = Field(default=True, description="use misses as evidence")
    cliques: bool = Field(default=True, description="landmarks on one body share one belief")
    clique_reach_m: Positive = Field(default=1.6, description="largest extent of a body that landmarks may share [m]")
    learn_lifetimes: bool = Field(
        default=True, description="learn lifetimes from this map's history; off: a wide prior"
    )
    prior_stays: int = Field(
        default=20,
        ge=1,
        le=100_000,
        description="pseudo-stays of a given lifetime prior, in addition to those of the map",
    )
    learn_sight: bool = Field(default=True, description="learn lines of sight; off: the nominal field of view")
    whole_places: Count = Field(
        default=600,
        description="maximum places of a map that is updated as a whole; in a larger one a session updates only its "
        "surroundings",
    )
    near_m: Positive = Field(
        default=10.0, description="margin beyond the sensor's range of the surroundings of a session [m]"
    )
    most_sites: int = Field(default=3, ge=1, le=100, description="maximum sites of one clique")
    fit: FitConfig = Field(default_factory=FitConfig, description="acceptance of a session")
    overlay: OverlayConfig = Field(default_factory=OverlayConfig, description="priors of moves")
    sight: SightConfig = Field(default_factory=SightConfig, description="lines of sight")
    looks: LooksConfig = Field(default_factory=LooksConfig, description="definition of a look")
    decisions: DecisionConfig = Field(default_factory=DecisionConfig, description="reporting and forgetting")
    grouping: GroupingConfig = Field(default_factory=GroupingConfig, description="assignment of landmarks to bodies")
    metre: MetreConfig = Field(default_factory=MetreConfig, description="the length of a metre")
    nameless: NamelessConfig = Field(default_factory=NamelessConfig, description="landmarks without identities")
    boxes: BoxesConfig = Field(default_factory=BoxesConfig, description="boxes without identities")
    lifetimes: LifetimeConfig = Field(default_factory=LifetimeConfig, description="learning of lifetimes")


class LiveConfig(Section):
    """A session that is fed while the robot drives."""

    reorder_s: NotNegative = Field(
        default=0.1, description="maximum delay of a reading behind the newest one, by their stamps [s]"
    )
    checkpoint_s: Positive = Field(
        default=5.0,
        description="interval at which readings are written to the disk: a crash loses so much, and some "
        "tenths more [s]",
    )
    revision_s: NotNegative = Field(
        default=300.0,
        description="interval at which the drive enters the map as a revision; 0: only at the end [s]",
    )
    readings_hz: Positive = Field(
        default=300.0,
        description="maximum mean rate of readings that enter the map; above it, whole frames are left out",
    )
    idle_s: Positive = Field(default=60.0, description="odometry that is kept where nothing is mapped, at least [s]")
    clocks_s: Positive = Field(default=5.0, description="more than the clocks of one robot are apart [s]")
    beliefs_s: Positive = Field(
        default=300.0, description="looks over so long become beliefs, and are not asked again [s]"
    )
    judge_s: Positive = Field(default=5.0, description="interval between searches for changes [s]")
    look_s: Positive = Field(default=0.5, description="time between two frames whose looks are used for that [s]")
