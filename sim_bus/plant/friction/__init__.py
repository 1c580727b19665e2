"""Dry friction of one shaft: a file for each model, with its equation, units and source.

Each model has the same two functions of a `ShaftParams` and its state, under a torque ``drive`` that is constant over
the step::

    advance(shaft, speed, bristle, drive, dt) -> (speed, bristle, travel)      rad/s, rad, rad
    torque(shaft, speed, bristle, drive)      -> N·m against motion, viscous friction not in it

| model | state | sticks | source |
|---|---|---|---|
| coulomb | – | exactly, to F_c | Coulomb 1785 |
| stribeck | – | exactly, to F_s | Stribeck 1902, Armstrong-Hélouvry 1991 |
| dahl | bristle | as a spring | Dahl 1968 |
| lugre | bristle | as a damped spring | Canudas de Wit, Olsson, Åström, Lischinsky 1995 |
"""

from collections.abc import Callable

from sim_bus.plant.friction import coulomb, dahl, lugre, stribeck
from sim_bus.plant.friction.shaft import Harmonic, MotorEnd, ShaftParams

__all__ = ["MODELS", "Advance", "Harmonic", "MotorEnd", "ShaftParams", "advance", "advance_of", "torque"]

Advance = Callable[[ShaftParams, float, float, float, float], tuple[float, float, float]]

Torque = Callable[[ShaftParams, float, float, float], float]

MODELS: dict[str, tuple[Advance, Torque]] = {
    "coulomb": (coulomb.advance, coulomb.torque),
    "stribeck": (stribeck.advance, stribeck.torque),
    "dahl": (dahl.advance, dahl.torque),
    "lugre": (lugre.advance, lugre.torque),
}
"""Every model by its name in plant.yaml, which `ShaftParams.friction` lists too."""


def advance_of(shaft: ShaftParams) -> Advance:
    """Return the solver of this shaft. Without dry friction it is Coulomb's, with F_c = 0."""
    return MODELS[shaft.friction][0] if shaft.coulomb_nm > 0.0 else coulomb.advance


def advance(shaft: ShaftParams, speed: float, bristle: float, drive: float, dt_s: float) -> tuple[float, float, float]:
    """Return (speed, bristle, travel) after ``dt_s`` under the constant torque ``drive``."""
    return advance_of(shaft)(shaft, speed, bristle, drive, dt_s)


def torque(shaft: ShaftParams, speed: float, bristle: float, drive: float = 0.0) -> float:
    """Return the dry friction against motion, N·m. At standstill the friction of a model that sticks balances
    ``drive``.
    """
    of_model = MODELS[shaft.friction][1] if shaft.coulomb_nm > 0.0 else coulomb.torque
    return of_model(shaft, speed, bristle, drive)
