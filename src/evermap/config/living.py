"""Settings of a map that lives on from session to session."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from evermap.config.section import Count, NotNegative, Positive, Probability, Section, Share


class FitConfig(Section):
    """When a session is believed to lie in the map, and which of its landmarks are believed."""

    least_fit: Share = Field(
        default=0.75, description="share of the sightings that fit in a session by itself that must fit in the map, too"
    )
    most_lost: Share = Field(
        default=0.03, description="a session whose sightings fit less often in the map by this share was bent"
    )
    inlier: Share = Field(default=0.5, description="inlier probability from which on a sighting counts")
    sightings: Positive = Field(default=1.5, description="inliers that a landmark needs to be believed")
    sightings_in_place: Positive = Field(default=0.5, description="the same where it stands as in the map")
    misread_m: Positive = Field(
        default=0.3, description="a landmark this close to another one may be that one, its identity misread [m]"
    )
    misread_share: Share = Field(
        default=0.2, description="it is, if it was seen so seldom beside it, and never in one frame with it"
    )
    glimpse_m: Positive = Field(default=0.4, description="a landmark seen once this close to its place is there [m]")
    bent_m: Positive = Field(default=0.15, description="bodies that moved alike to within this are a bend [m]")
    bent_cliques: int = Field(default=3, ge=2, description="bodies that must have moved alike for that")
    window: Count = Field(default=12, description="sightings by which each pose of a bent session is placed")
    bent_windows: Count = Field(
        default=3, description="so many of these that contradict the rest are wrong poses, not misread identities"
    )
    placing_m: Positive = Field(default=0.3, description="residual from which sightings count for less in that [m]")
    loose_m: Positive = Field(
        default=0.5, description="a session is in parts where odometry was silent and nothing else ties it so well [m]"
    )
    loose_rad: Positive = Field(default=0.1, description="the same for the heading [rad]")


class OverlayConfig(Section):
    """Priors of the search for what stands where the map has it."""

    nudge_m: Positive = Field(default=0.7, description="standard deviation of a small move, each axis [m]")
    share_nudged: Share = Field(default=0.5, description="share of moves that are small; the others lead anywhere")
    turn_m: Positive = Field(default=0.35, description="standard deviation of how members of a moved body turn [m]")
    p_split: Share = Field(default=1e-3, description="probability that landmarks taken for one body are not")
    p_another_place: Share = Field(default=1e-3, description="probability that a session is of another place")
    smallest_room_m2: Positive = Field(default=50.0, description="least area that moved bodies may be found in [m^2]")
    drifts_m: tuple[Positive, ...] = Field(
        default=(0.01, 0.02, 0.04, 0.08),
        min_length=1,
        description="standard deviations by which landmarks that nobody moved may be off from session to session [m]",
    )
    free_m: Positive = Field(
        default=20.0, description="standard deviation of a session's place around the one agreed on, each axis [m]"
    )
    free_rad: Positive = Field(default=3.0, description="the same of its heading [rad]")
    lowest_room_m: Positive = Field(default=1.0, description="height of a room in space, at least [m]")
    stood_rad: tuple[Positive, ...] = Field(
        default=(0.02, 0.06, 0.15),
        min_length=1,
        description="standard deviations by which landmarks in space that stand seem turned, all alike [rad]",
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
    p_told: Share = Field(default=0.95, description="probability from which a robot is told to have drifted")


class NamelessConfig(Section):
    """Landmarks without identities in a map: by their constellation."""

    fewest: Count = Field(default=4, description="landmarks that must be found in the map together")
    farthest_m: Positive = Field(default=2.0, description="how far a landmark that is the same may be off [m]")
    bent_m: Positive = Field(default=2.0, description="the same behind a stretch that is bent [m]")
    p_found: Share = Field(
        default=0.9, description="that a landmark which stands beside one that was found is found, too"
    )


class BoxesConfig(Section):
    """Boxes without identity in a map: which are the same from session to session."""

    drift_m: Positive = Field(
        default=0.2, description="by which a box that nobody moved seems to be elsewhere, each axis [m]"
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
    size_nats: Positive = Field(default=8.0, description="that size, or heading, may say against two boxes being one")
    heading_rad: Positive = Field(default=0.15, description="standard deviation of headings [rad]")
    round: Positive = Field(default=1.3, description="boxes less long than this times their width have no heading")
    density: Positive = Field(default=0.02, description="boxes where things stand, at least [1/m^2]")
    p_stands: Share = Field(default=0.9, description="that a box which stands is seen at its place again")
    returns: Share = Field(
        default=0.5, description="that what comes to where a box of the map had stood is that box, beforehand"
    )
    least_gone: Share = Field(default=0.02, description="least probability that a box left, where another one stands")
    same_share: Positive = Field(
        default=0.6, description="boxes that stand closer than this share of their widths are one"
    )
    at_once_s: NotNegative = Field(
        default=5.0, description="a box that left, and stands there again so shortly after, had not left [s]"
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
        default=80.0, description="farther from what ties a session to the map, misses say nothing [m]"
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
    settled_s: NotNegative = Field(default=300.0, description="what is seen within this time of a look was there [s]")
    settled_online_s: NotNegative = Field(
        default=10.0, description="the same while the robot drives, as long as the session is not over [s]"
    )
    beside_m: Positive = Field(default=1.0, description="what is seen this close to a place is seen along its line [m]")
    beside_rad: Positive = Field(default=0.15, description="what is seen behind it at this angle is, too [rad]")
    along_m: Positive = Field(default=0.3, description="distance from a line of sight that shows it to be clear [m]")
    witnesses: Count = Field(default=3, description="frames in which something else must be seen along a line")
    sides: Count = Field(default=6, description="sectors around a place that count as sides of it")
    most_sides: Count = Field(default=3, description="sides that count for having been seen all around")
    together_m: NotNegative = Field(
        default=2.0, description="cliques missed from places this close may be hidden by the same thing [m]"
    )
    near_m: NotNegative = Field(
        default=0.6, description="positions this close to one from which a place was seen see it, too [m]"
    )
    least_expected: Positive = Field(
        default=2.0, description="detections that earlier looks must be expected to have given to count as looks"
    )
    sticky: float = Field(default=2.0, ge=1.0, description="frames in a row that say as much as an independent one")


class DecisionConfig(Section):
    """What is told of a session, and what a map forgets."""

    least_evidence: NotNegative = Field(
        default=1.5, description="log likelihood ratio of looks against a clique before it is told to have left"
    )
    credible: Share = Field(
        default=0.6,
        description="what is missed is gone if it is for the upper bound of this lifetime interval, too",
    )
    same_place_m: Positive = Field(
        default=0.3, description="bodies this close to where another one stood have taken its place [m]"
    )
    same_turn_rad: Positive = Field(default=0.3, description="bodies turned by less than this have not turned [rad]")
    same_spot_m: Positive = Field(default=0.1, description="bodies this close to where they stood have not moved [m]")
    new_clique_p: Share = Field(default=0.9, description="belief in a new body before its sightings are counted")
    surely_away: Probability = Field(default=0.02, description="belief below which a clique may be forgotten")
    forgotten_p: Probability = Field(default=0.05, description="probability of a return below which it is forgotten")
    most_away: int = Field(
        default=20, ge=0, description="cliques that are away and remembered, beside as many as stand"
    )
    most_stays: Count = Field(default=5000, description="newest stays that lifetimes are learned from")


class GroupingConfig(Section):
    """Which landmarks are on one body, by how they moved."""

    p_one_body: Share = Field(default=0.9, description="that two landmarks of a clique are on one body")
    p_split_before: Share = Field(default=0.05, description="that two near ones of different cliques are")
    p_other_class: Share = Field(default=0.001, description="that two near ones of different classes are")
    p_moved: Share = Field(default=0.1, description="that a body moves between two sessions")
    move_sigma_m: Positive = Field(default=2.0, description="standard deviation of displacements, each axis [m]")
    misses_in_a_row: float = Field(
        default=4.0, ge=1.0, description="misses of one session that say as much as an independent one"
    )
    p_wrong: Share = Field(default=1e-3, description="that detections of a landmark are of another, a session long")


class LifetimeConfig(Section):
    """How lifetimes are learned from the history of a map."""

    newest: Count = Field(default=300, description="stays of a class that are learned from: the last that began")
    strength: Positive = Field(default=2.0, description="events that the average over classes counts for in each")
    least_ended: Count = Field(default=5, description="ends in a chunk before it has lifetimes of its own")
    sure: Share = Field(default=0.999, description="ends of stays that are more probable count as certain")
    firmness: tuple[Positive, ...] = Field(
        default=(1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0),
        min_length=1,
        description="ends that the lifetimes of a class may count for in those of a chunk; how many is learned",
    )
    prior_quantiles: Count = Field(default=64, description="lengths of stays that stand for a prior that a user gives")
    prior_shortest_s: Positive = Field(default=60.0, description="shorter ones of these count as this long [s]")
    prior_longest_s: Positive = Field(default=1.5e9, description="of longer ones of these no more is known [s]")


class SightConfig(Section):
    """What is believed of lines of sight, and how it is learned."""

    most_looks: Positive = Field(
        default=200.0, description="looks along one line; with more, old ones fade, so that a moved wall is learned"
    )
    strength: Positive = Field(
        default=4.0, description="looks along one line that the rate of all clear lines of its length is worth"
    )
    nominal_looks: Positive = Field(
        default=20.0, description="looks that the nominal rate is worth against those along all lines of a length"
    )
    p_blocked_detect: Share = Field(default=0.03, description="detection rate along blocked lines")
    least_rate: Share = Field(default=0.002, description="no kind of line has a lower detection rate")
    highest_rate: Share = Field(default=0.98, description="no kind of line has a higher detection rate")
    neighbour: Probability = Field(
        default=0.35, description="what looks from the eight cells around say of a line, in looks along it"
    )
    clear: Share = Field(default=0.9, description="a line is known to be clear from this probability on")
    blocked: Share = Field(default=0.25, description="a line is known to be blocked up to this probability")
    p_hidden_unseen: Share = Field(
        default=0.1, description="that a place is hidden a session long (a shut door) if its lines were clear before"
    )
    p_hidden_beside: Share = Field(default=0.03, description="the same if something else is seen along them now")
    p_hidden_unknown: Share = Field(
        default=0.2, description="the same if they were unknown, but something close to them and behind is seen"
    )
    hidden_looks: Positive = Field(default=5.0, description="sessions that these are worth against what is learned")
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
        description="how a session is laid over the map: 'joint' weighs all that may have moved together, with the "
        "trajectory marginalised; 'gate' one clique after the other, at the aligned poses; 'none' nothing moves",
    )
    existence: bool = Field(default=True, description="believe less in what is not seen; off: all exists for ever")
    returns: bool = Field(default=True, description="what is away may come back; off: gone is for ever (Rosen 2016)")
    misses: bool = Field(default=True, description="learn from expected detections that did not come")
    cliques: bool = Field(default=True, description="landmarks on one body share their fate")
    clique_reach_m: Positive = Field(default=1.6, description="largest extent of a body that landmarks may share [m]")
    learn_lifetimes: bool = Field(
        default=True, description="learn from this map's history how long things stay; off: anything is possible"
    )
    prior_stays: int = Field(
        default=20,
        ge=1,
        le=100_000,
        description="stays that a given prior of a lifetime is worth, beside those that the map sees",
    )
    learn_sight: bool = Field(
        default=True, description="learn from where to where the sensor sees; off: its nominal field of view"
    )
    whole_places: Count = Field(
        default=600,
        description="places up to which a map is updated as one; of a larger one a session touches what is near",
    )
    near_m: Positive = Field(
        default=10.0, description="beyond the sensor's range, what is near a session: all that it may move with [m]"
    )
    most_sites: int = Field(default=3, ge=1, le=100, description="sites that are remembered of one clique, at most")
    fit: FitConfig = Field(default_factory=FitConfig, description="whether a session lies in the map")
    overlay: OverlayConfig = Field(default_factory=OverlayConfig, description="priors of what moved")
    sight: SightConfig = Field(default_factory=SightConfig, description="lines of sight")
    looks: LooksConfig = Field(default_factory=LooksConfig, description="what counts as a look")
    decisions: DecisionConfig = Field(default_factory=DecisionConfig, description="what is told and forgotten")
    grouping: GroupingConfig = Field(default_factory=GroupingConfig, description="which landmarks are on one body")
    metre: MetreConfig = Field(default_factory=MetreConfig, description="the length of a metre")
    nameless: NamelessConfig = Field(default_factory=NamelessConfig, description="landmarks without identities")
    boxes: BoxesConfig = Field(default_factory=BoxesConfig, description="boxes without identities")
    lifetimes: LifetimeConfig = Field(default_factory=LifetimeConfig, description="how lifetimes are learned")


class LiveConfig(Section):
    """A session that is fed while the robot drives."""

    reorder_s: NotNegative = Field(
        default=0.1, description="how much later than the newest one a reading may come, by their stamps [s]"
    )
    checkpoint_s: Positive = Field(
        default=5.0, description="readings go to the disk this often: a crash costs so much, and some tenths more [s]"
    )
    revision_s: NotNegative = Field(
        default=300.0,
        description="while it maps, what was driven enters the map as a revision this often; 0: only at the end [s]",
    )
    readings_hz: Positive = Field(
        default=300.0,
        description="readings a second that are kept for the map, on average: of more, whole frames are left out",
    )
    idle_s: Positive = Field(default=60.0, description="odometry that is kept where nothing is mapped, at least [s]")
    clocks_s: Positive = Field(default=5.0, description="more than the clocks of one robot are apart [s]")
    beliefs_s: Positive = Field(
        default=300.0, description="looks over so long become beliefs, and are not asked again [s]"
    )
    judge_s: Positive = Field(default=5.0, description="how often it is asked what has changed [s]")
    look_s: Positive = Field(default=0.5, description="time between two frames whose looks are asked for that [s]")
