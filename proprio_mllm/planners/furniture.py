"""Kinds of furniture by name, in lower case as `type_of` gives them: where things are, and what is known from the start.

Paper: none; planners know furniture by name because an observation lists a room's furniture from the start.
"""

from __future__ import annotations

from typing import Final

#: Where things usually are, in groups of decreasing likelihood.
SURFACES: Final = ("countertop", "diningtable", "coffeetable", "sidetable", "desk", "shelf", "dresser", "tvstand")
SEATS: Final = ("sofa", "bed", "chair", "stoveburner", "sinkbasin", "bathtubbasin", "toilet", "garbagecan")
CONTAINERS: Final = ("cabinet", "drawer", "fridge", "microwave", "laundryhamper", "box")
#: What cannot be carried, and so is known from the start; a test holds this against the catalogue.
FIXTURES: Final = frozenset(
    (
        "cabinet", "drawer", "fridge", "stoveburner", "stoveknob", "countertop", "sinkbasin", "faucet", "diningtable",
        "coffeetable", "sidetable", "desk", "shelf", "dresser", "tvstand", "sofa", "bed", "toilet", "bathtubbasin",
        "lightswitch",
    )
)  # fmt: skip
