"""Association of detections with landmarks by geometry alone, for recordings without identities."""

from __future__ import annotations

from evermap.config import SlamConfig
from evermap.types import AnyRecording, SpatialRecording


def with_identities(recording: AnyRecording, settings: SlamConfig) -> AnyRecording:
    """Return the recording with landmark ids by geometry, if `slam.unknown_ids` is set.

    Errors are those of `identify.identified` in the plane, and of `in_space.identified_in_space`.
    """
    if not settings.unknown_ids:
        return recording
    from evermap.slam.association.identify import identified
    from evermap.slam.association.in_space import identified_in_space
    from evermap.slam.intake import beliefs

    keep_ids = settings.unknown_ids == "empty"
    if isinstance(recording, SpatialRecording):
        return identified_in_space(recording, settings, keep_ids=keep_ids)
    believed = beliefs(recording.sensor, settings)
    return identified(recording, *believed, keep_ids=keep_ids, settings=settings)
