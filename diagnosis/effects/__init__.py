"""The catalogue: every effect, in the order in which effects are applied to a simulation.

    from diagnosis.effects import EFFECTS

A new effect is one class in one of these modules; the decorator `catalogue` adds it.
"""

# Effects join the catalogue in the order of these imports.
# isort: off
from diagnosis.effects.base import EFFECTS
from diagnosis.effects import (
    joints,
    actuators,
    drives,
    friction,
    transmissions,
    environment,
    bodies,
)

# isort: on

__all__ = [
    "EFFECTS",
    "actuators",
    "bodies",
    "drives",
    "environment",
    "friction",
    "joints",
    "transmissions",
]
