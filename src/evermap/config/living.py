"""Settings of a map that lives on from session to session."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from evermap.config.section import Positive, Section


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
    most_sites: int = Field(default=3, ge=1, le=100, description="sites that are remembered of one clique, at most")
