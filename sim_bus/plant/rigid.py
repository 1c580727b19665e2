r"""The shaft as the paper takes it: one rigid inertia with viscous and dry friction (its equations 4 to 6).

::

    J dω/dt = u − B ω − T_f        u = torque − load, held constant over a step

T_f, with how a step of each model is made, stands in `sim_bus.plant.friction`. What hangs on a string or has two masses
is in `sim_bus.plant.two_mass` and `sim_bus.plant.drill_string`; `sim_bus.plant.kinds` chooses.
"""

from typing import Literal, NamedTuple

from sim_bus.plant.friction import MotorEnd, advance_of, torque


class Params(MotorEnd):
    """Parameters of the shaft. The defaults are the field-like rig of the identification study."""

    kind: Literal["rigid"] = "rigid"


class ShaftState(NamedTuple):
    """State of the shaft: speed, angle, and the deflection of the bristle (0 without one)."""

    speed_rad_s: float = 0.0
    angle_rad: float = 0.0
    bristle_rad: float = 0.0


def step(params: Params, state: ShaftState, torque_nm: float, dt_s: float, load_nm: float = 0.0) -> ShaftState:
    """The state ``dt_s`` later, under constant torque.

    ``load_nm`` acts against positive speed, on top of the constant load.
    """
    speed, angle, bristle = state
    drive = torque_nm - load_nm - params.load_nm
    move = advance_of(params)
    speed, bristle, travel = move(params, speed, bristle, drive, dt_s)
    return ShaftState(speed, angle + travel, bristle)


def friction_torque(params: Params, state: ShaftState, drive_nm: float = 0.0) -> float:
    """Dry friction in N·m, as it acts against motion; where the model sticks, at rest it balances ``drive_nm``."""
    return torque(params, state.speed_rad_s, state.bristle_rad, drive_nm)
