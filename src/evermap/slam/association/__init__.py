"""Association of detections with landmarks by geometry alone, for recordings without identities."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from evermap.config import AssociationConfig, SlamConfig
from evermap.types import AnyRecording, AssociationEvidence, is_in_space

if TYPE_CHECKING:
    from evermap.slam.association.identify import Associated


def associate(recording: AnyRecording, settings: SlamConfig, *, keep_ids: bool) -> Associated:
    """Associate the detections of a recording by geometry.

    Args:
        recording: as read.
        settings: of the estimator.
        keep_ids: detections with an id keep it, those without may be of the same landmarks; else ids are ignored.

    Raises:
        DataError: too few frames with detections, or too many for the memory; in space, no odometry.
    """
    from evermap.slam.association.identify import associated
    from evermap.slam.association.in_space import associate_in_space
    from evermap.slam.intake import beliefs

    if is_in_space(recording):
        return associate_in_space(recording, settings, keep_ids=keep_ids)
    return associated(recording, *beliefs(recording.sensor, settings), keep_ids=keep_ids, settings=settings)


class Identified(NamedTuple):
    """A recording with landmark ids by geometry, and what speaks for them; None where they were given."""

    recording: AnyRecording
    evidence: AssociationEvidence | None


def describe_doubts(evidence: AssociationEvidence, settings: AssociationConfig) -> tuple[str, ...]:
    """Return what makes an association doubtful, one line each."""
    found = []
    if evidence.lead_nats < -settings.landmark_nats:
        found.append(
            f"no loop is closed: odometry alone, with {evidence.n_alone} landmarks, explains the detections without "
            f"identity better, by {-evidence.lead_nats:.0f} nats"
        )
    if evidence.nats_per_closure > settings.bent_nats:
        found.append(
            f"landmarks seen again contradict the odometry, by {evidence.nats_per_closure:.1f} nats each (1 is "
            f"right; {evidence.n_closures} of them): some are probably mistaken for others"
        )
    if evidence.dropped > settings.dropped_share:
        found.append(f"{evidence.dropped:.0%} of the detections without identity fit no landmark")
    return tuple(found)


def with_identities(recording: AnyRecording, settings: SlamConfig) -> AnyRecording:
    """Return the recording of `identify_landmarks`."""
    return identify_landmarks(recording, settings).recording


def identify_landmarks(recording: AnyRecording, settings: SlamConfig) -> Identified:
    """Return the recording with landmark ids by geometry, if `slam.unknown_ids` is set; errors as of `associate`.

    Landmarks without an id are numbered from 1 by first detection, without the ids in use; `UNKNOWN` if a detection is
    of no landmark with enough sightings. Those of a map are found by `maps.sessions.nameless`.
    """
    if not settings.unknown_ids:
        return Identified(recording, None)
    from evermap.slam.association.assignment import with_ids
    from evermap.slam.association.identify import numbered

    keep_ids = settings.unknown_ids == "empty"
    found = associate(recording, settings, keep_ids=keep_ids)
    landmark_id = numbered(found.names, found.name)
    named = with_ids(recording, found.landmark_row, found.name, landmark_id)  # type: ignore[type-var]
    return Identified(named if keep_ids else replace(named, landmark_names={}), found.evidence)
