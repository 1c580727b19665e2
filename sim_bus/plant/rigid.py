r"""The shaft of the paper: one rigid inertia with viscous and dry friction (equations 4 to 6).

::

    J dω/dt = u − B ω − T_f        u = torque − load, held constant over a step

`sim_bus.plant.friction` has T_f and the step of each friction model. `sim_bus.plant.two_mass` and
`sim_bus.plant.drill_string` are the other plants; `sim_bus.plant.kinds` selects one.
"""

from collections.abc import Callable
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
    """Return the state ``dt_s`` later, under constant torque.

    ``load_nm`` acts against positive speed, in addition to the constant load.
    """
    return stepper(params)(state, torque_nm, dt_s, load_nm)


def stepper(params: Params) -> Callable[..., ShaftState]:
    """Return `step` for one shaft, whose friction model is looked up once."""
    move, constant_nm = advance_of(params), params.load_nm

    def step_on(state: ShaftState, torque_nm: float, dt_s: float, load_nm: float = 0.0) -> ShaftState:
        speed, angle, bristle = state
        speed, bristle, travel = move(params, speed, bristle, torque_nm - load_nm - constant_nm, dt_s)
        return ShaftState(speed, angle + travel, bristle)

    return step_on


def friction_torque(params: Params, state: ShaftState, drive_nm: float = 0.0) -> float:
    """Return the dry friction against motion, N·m. At standstill the friction of a model that sticks balances
    ``drive_nm``.
    """
    return torque(params, state.speed_rad_s, state.bristle_rad, drive_nm)
