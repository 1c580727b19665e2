r"""Two masses on a torsion spring: the paper's figure 7, friction at both ends.

::

    J_r dω_r/dt = u − B_r ω_r − T_r − τ        motor: top drive
    J_L dω_L/dt = τ − load_L − B_L ω_L − T_L   bottom: collars and bit
    τ = k (θ_r − θ_L) + c (ω_r − ω_L)

    J kg·m², k N·m/rad, c and B N·m·s/rad, T dry friction and τ N·m

With a play of p between its flanks, the spring is loose while |θ_r − θ_L| ≤ p/2, and its twist counts from the nearer
flank. A flank pushes and does not pull.

Source: the paper, section 2.3, which shows the model and then uses equations 4 to 6 instead.

A step of h uses the mid-point rule for the spring alone: τ is computed with the twist at mid-step and the mean of the
speed differences before and after, which two passes find. Then each end moves by itself, exactly as its friction model
does. So an end sticks exactly while the spring's torque is below its breakaway torque. The method is of second order: a
torsional oscillation of natural frequency Ω = √(k (1/J_r + 1/J_L)) is too fast by the share (Ωh)²/24, and keeps its
energy. Steps are divided so that Ωh ≤ 0.1 and c (1/J_r + 1/J_L) h ≤ 0.1.
"""

from collections.abc import Callable
from math import sqrt
from typing import Literal, NamedTuple, Self

from pydantic import model_validator

from profiles import NonNegative, Positive, refuse_if
from sim_bus.plant.friction import MotorEnd, ShaftParams, advance_of

FASTEST_RAD_S = 1000.0
"""Highest natural frequency, rad/s. A higher one would need hundreds of pieces per step."""
_CUT = 0.1


class Bottom(ShaftParams):
    """Rotating parts at the lower end."""

    inertia_kg_m2: Positive = 374.0
    viscous_nm_s_rad: NonNegative = 4.0
    coulomb_nm: NonNegative = 30.0
    static_nm: NonNegative = 40.0


class TwoMassParams(MotorEnd):
    """Parameters of two masses: the motor's end, as for a rigid shaft, the spring, and the bottom."""

    kind: Literal["two_mass"] = "two_mass"
    inertia_kg_m2: Positive = 1500.0
    stiffness_nm_rad: Positive = 473.0
    damping_nm_s_rad: NonNegative = 23.2
    play_rad: NonNegative = 0.0
    bottom: Bottom = Bottom()

    @property
    def mobility_1_kg_m2(self) -> float:
        """Mobility of the spring's ends: 1/J_r + 1/J_L, 1/(kg·m²)."""
        return 1.0 / (self.inertia_kg_m2 + self.added_inertia_kg_m2) + 1.0 / self.bottom.inertia_kg_m2

    @model_validator(mode="after")
    def _slow_enough(self) -> Self:
        swing = sqrt(self.stiffness_nm_rad * self.mobility_1_kg_m2)
        decay = self.damping_nm_s_rad * self.mobility_1_kg_m2
        cure = f"more than {FASTEST_RAD_S:g} can't be simulated; that is one rigid shaft (kind: rigid)"
        refuse_if(
            [("stiffness_nm_rad", f"the two ends would swing at {swing:.4g} rad/s; {cure}")] * (swing > FASTEST_RAD_S)
            + [("damping_nm_s_rad", f"it would damp at a rate of {decay:.4g} 1/s; {cure}")] * (decay > FASTEST_RAD_S)
        )
        return self


class TwoMassState(NamedTuple):
    """State, motor end first. The twist is ``angle_rad − bottom_angle_rad``."""

    speed_rad_s: float = 0.0
    angle_rad: float = 0.0
    bristle_rad: float = 0.0
    bottom_speed_rad_s: float = 0.0
    bottom_angle_rad: float = 0.0
    bottom_bristle_rad: float = 0.0


def step(params: TwoMassParams, state: TwoMassState, torque_nm: float, dt_s: float,
         load_nm: float = 0.0, bottom_load_nm: float = 0.0) -> TwoMassState:
    """Return the state ``dt_s`` later, under constant torque; ``load_nm`` acts at the motor, against positive speed.

    ``bottom_load_nm`` acts at the bottom in the same way, in addition to its own load.
    """
    return stepper(params)(state, torque_nm, dt_s, load_nm, bottom_load_nm)


def stepper(params: TwoMassParams) -> Callable[..., TwoMassState]:
    """Return `step` for one shaft. Constants that follow from its parameters are computed once."""
    bottom, stiffness, damping = params.bottom, params.stiffness_nm_rad, params.damping_nm_s_rad
    mobility, constant_nm, bottom_nm = params.mobility_1_kg_m2, params.load_nm, bottom.load_nm
    fastest = max(sqrt(stiffness * mobility), damping * mobility)
    move, low_move = advance_of(params), advance_of(bottom)

    def piece(state: TwoMassState, drive: float, below_nm: float, dt_s: float) -> TwoMassState:
        speed, angle, bristle, low_speed, low_angle, low_bristle = state
        difference = speed - low_speed
        spring = stiffness * _beyond_play(params, angle - low_angle + 0.5 * dt_s * difference)
        torque = _pushed(params, spring, damping * difference)
        end, end_bristle, travel = move(params, speed, bristle, drive - torque, dt_s)
        low_end, low_end_bristle, low_travel = low_move(bottom, low_speed, low_bristle, torque - below_nm, dt_s)
        if damping > 0.0:
            torque = _pushed(params, spring, 0.5 * damping * (difference + end - low_end))
            end, end_bristle, travel = move(params, speed, bristle, drive - torque, dt_s)
            low_end, low_end_bristle, low_travel = low_move(bottom, low_speed, low_bristle, torque - below_nm, dt_s)
        return TwoMassState(end, angle + travel, end_bristle, low_end, low_angle + low_travel, low_end_bristle)

    def step_on(
        state: TwoMassState, torque_nm: float, dt_s: float, load_nm: float = 0.0, bottom_load_nm: float = 0.0
    ) -> TwoMassState:
        count = 1 + int(fastest * dt_s / _CUT)
        drive, against_bottom = torque_nm - load_nm - constant_nm, bottom_nm + bottom_load_nm
        for _ in range(count):
            state = piece(state, drive, against_bottom, dt_s / count)
        return state

    return step_on


def spring_torque(params: TwoMassParams, state: TwoMassState) -> float:
    """Return the torque τ that the string takes from the motor, N·m."""
    twist = _beyond_play(params, state.angle_rad - state.bottom_angle_rad)
    damped = params.damping_nm_s_rad * (state.speed_rad_s - state.bottom_speed_rad_s)
    return _pushed(params, params.stiffness_nm_rad * twist, damped)


def _beyond_play(params: TwoMassParams, twist_rad: float) -> float:
    """Return the twist of the spring, counted from the nearer flank; 0 between the flanks."""
    half = 0.5 * params.play_rad
    return twist_rad - min(max(twist_rad, -half), half) if half else twist_rad


def _pushed(params: TwoMassParams, spring_nm: float, damped_nm: float) -> float:
    """Return the torque of spring and damper; with play only if it pushes."""
    if not params.play_rad:
        return spring_nm + damped_nm
    return max(spring_nm + damped_nm, 0.0) if spring_nm > 0.0 else min(spring_nm + damped_nm, 0.0) if spring_nm else 0.0
