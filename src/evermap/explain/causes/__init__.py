"""Causes as values: what each undoes of a recording and of a given map, what it costs, and the words for it.

A cause is undone on trial by a pure transformation of the inputs; the solution of what comes out is compared with that
of the inputs as given (`competition`). A *continuous* cause has a state of one number, 0 where all is as stated, with a
Gaussian prior; a *discrete* one has none. Mistakes that show in pairs of sightings alone (`slam.mistakes`) are causes,
too: the same values serve `check` and the competition.

`suspect` is what they have in common; the others list them by what they are of: readings in the `plane` and in `space`,
`sizes` and scales, the `odometry` and its clock, `mounts`, `lenses`, and the `given_map`.
"""

from __future__ import annotations

from evermap.explain.causes.given_map import suspect_map
from evermap.explain.causes.plane import suspect_in_plane
from evermap.explain.causes.space import suspect_in_space
from evermap.explain.causes.suspect import Inputs, Suspect
from evermap.slam.space.intake import without_range
from evermap.types import is_in_space


def list_suspects(inputs: Inputs, *, calibrations: bool = False) -> tuple[Suspect, ...]:
    """Return all causes that may be asked of a recording, and of the map that is given with it.

    Args:
        inputs: the recording and the map.
        calibrations: only those with a state that is one for the sensor, the odometry or the map as a whole. Of the
            others there is one for each landmark, and some are first sought in the readings.
    """
    recording, found = inputs.recording, list[Suspect]()
    if is_in_space(recording):
        has_metre = bool(recording.odometry is not None or inputs.prior_map is not None or recording.measurements)
        has_metre = has_metre and not without_range(recording).all()
        found += suspect_in_space(recording, calibrations=calibrations, has_metre=has_metre)
    else:
        found += suspect_in_plane(recording, calibrations=calibrations)
    if inputs.prior_map is not None:
        found += suspect_map(inputs.prior_map, recording)
    return tuple(one for one in found if not calibrations or (one.is_continuous and not one.is_of_landmark))
