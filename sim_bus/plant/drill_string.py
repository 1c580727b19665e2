r"""A drill string: the torsional wave equation between the motor and the bottom end.

::

    ρI ∂ω/∂t = ∂τ/∂x − d ω        ∂τ/∂t = G I ∂ω/∂x                 (x from the bottom upwards)

    v = √(G/ρ)   delay T = L/v   impedance Z = I √(Gρ)        I = π (D⁴ − d_i⁴)/32

    ρ kg/m³, G Pa, I m⁴, L, D, d_i m; drag d N·m·s/rad per m; τ N·m; Z N·m·s/rad; v m/s

Source: d'Alembert's waves; for strings S. L. Chen and M. Géradin (1995), J. D. Jansen (1993).

**Characteristics.** Wave a = τ + Zω travels down and wave b = Zω − τ travels up, both unchanged at speed v. The string
is divided into M cells of one tick T/M ≤ 2 ms each, so that a tick moves each wave by one cell. The delay is exact,
without interpolation and dispersion. Drag acts between cells, β = d L/M each: arriving a and b leave as

    Zω = (a + b) Z/(2Z + β)        b_above = 2 Zω − a        a_below = 2 Zω − b

This takes β ω² from the energy and never adds any. Half a β acts at each end.

**Ends.** An arriving wave is known for the whole tick. So an end is one shaft with the string's impedance as additional
viscous friction, J dω/dt = u + b − (B + Z + β/2) ω − T_f at the top and J dω/dt = a − … at the bottom. Its step is that
of its friction model, with sticking. It sends back 2Z (mean ω) minus the arriving wave, with means over a tick. At the
top the mean is taken over steps of any length, divided at the ticks. A free bottom has no inertia, a clamped one never
turns.
"""

from math import ceil, pi, sqrt
from typing import Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from profiles import NonNegative, Positive, refuse_if
from sim_bus.plant.friction import MotorEnd, ShaftParams, advance_of
from sim_bus.plant.two_mass import Bottom

LONGEST_TICK_S = 0.002
MOST_CELLS = 20_000

Wave = NDArray[np.float64]


class StringParams(MotorEnd):
    """Parameters of a string: the motor's end, as for a rigid shaft, the pipe (5 inch, 19.5 lb/ft), and the bottom."""

    kind: Literal["string"] = "string"
    inertia_kg_m2: Positive = 1500.0
    length_m: Positive = 2300.0
    outer_diameter_m: Positive = 0.127
    inner_diameter_m: NonNegative = 0.1086
    shear_modulus_pa: Positive = 79.3e9
    density_kg_m3: Positive = 7850.0
    drag_nm_s_rad_m: NonNegative = 0.005
    """Viscous drag of the mud, N·m·s/rad per metre."""
    bottom_end: Literal["free", "clamped", "mass"] = "mass"
    bottom: Bottom = Bottom()
    """Bottom parameters, used with bottom_end: mass."""

    @model_validator(mode="after")
    def _is_a_string(self) -> Self:
        cells = self.delay_s / LONGEST_TICK_S
        refuse_if(
            [("inner_diameter_m", f"must be less than outer_diameter_m ({self.outer_diameter_m:g})")]
            * (self.inner_diameter_m >= self.outer_diameter_m)
            + [("length_m", f"waves would take {self.delay_s:.3g} s from end to end; {LONGEST_TICK_S:g} to "
                            f"{MOST_CELLS * LONGEST_TICK_S:g} s can be simulated")] * (not 1.0 <= cells <= MOST_CELLS)
        )
        return self

    @property
    def polar_moment_m4(self) -> float:
        """Polar moment I of the pipe's section, m⁴."""
        return pi / 32.0 * (self.outer_diameter_m**4 - self.inner_diameter_m**4)

    @property
    def delay_s(self) -> float:
        """Travel time T of a wave from one end to the other, s."""
        return self.length_m * sqrt(self.density_kg_m3 / self.shear_modulus_pa)

    @property
    def impedance_nm_s_rad(self) -> float:
        """Characteristic impedance Z, N·m·s/rad: torque that a wave carries, per rad/s."""
        return self.polar_moment_m4 * sqrt(self.shear_modulus_pa * self.density_kg_m3)


class StringState(NamedTuple):
    """State, motor end first. The bottom and the waves are those of the last whole tick. Arrays are never changed in
    place.
    """

    speed_rad_s: float
    angle_rad: float
    bristle_rad: float
    bottom_speed_rad_s: float
    bottom_angle_rad: float
    bottom_bristle_rad: float
    down_nm: Wave
    """Wave a in each cell, from the top, N·m."""
    up_nm: Wave
    """Wave b in each cell, from the top, N·m."""
    into_tick_s: float
    """Time since the last whole tick, s."""
    tick_angle_rad: float
    """Angle of the motor at the last whole tick, rad."""


class DrillString:
    """Solver for a `StringState`. It holds constants computed from the parameters, and nothing that changes."""

    def __init__(self, params: StringParams) -> None:
        self.params = params
        self.cells = ceil(params.delay_s / LONGEST_TICK_S * (1.0 - 1e-9))
        self.tick_s = params.delay_s / self.cells
        self.impedance_nm_s_rad = params.impedance_nm_s_rad
        self._drag = params.drag_nm_s_rad_m * params.length_m / self.cells
        self._pass = 2.0 * self.impedance_nm_s_rad / (2.0 * self.impedance_nm_s_rad + self._drag)
        self._top, self._bottom = self._with_string(params), self._with_string(params.bottom)
        self._move, self._bottom_move = advance_of(self._top), advance_of(self._bottom)
        self._load_nm = params.load_nm

    def rest(self) -> StringState:
        """Return the state at standstill without twist."""
        silence = np.zeros(self.cells)
        return StringState(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, silence, silence, 0.0, 0.0)

    def step(
        self, state: StringState, torque_nm: float, dt_s: float, load_nm: float = 0.0, bottom_load_nm: float = 0.0
    ) -> StringState:
        """Return the state ``dt_s`` later, under constant torque; ``load_nm`` acts at the motor, against positive
        speed.

        ``bottom_load_nm`` acts at the bottom in the same way, in addition to its own load, for the ticks that end
        within the step.
        """
        drive = torque_nm - load_nm - self._load_nm
        left = dt_s
        while left > 0.0:
            speed, angle, bristle, low_speed, low_angle, low_bristle, down, up, into_tick_s, tick_angle = state
            until_tick = self.tick_s - into_tick_s
            piece = min(left, until_tick)
            speed, bristle, travel = self._move(self._top, speed, bristle, drive + up.item(0), piece)
            state = StringState(speed, angle + travel, bristle, low_speed, low_angle, low_bristle,
                                down, up, into_tick_s + piece, tick_angle)
            if piece >= until_tick:
                state = self._tick(state, bottom_load_nm)
            left -= piece
        return state

    def top_torque_nm(self, state: StringState) -> float:
        """Return the torque τ at the top, which the string takes from the motor, N·m."""
        return self.impedance_nm_s_rad * state.speed_rad_s - float(state.up_nm[0])

    def _tick(self, state: StringState, bottom_load_nm: float) -> StringState:
        """Advance the waves by one cell and the bottom by one tick."""
        down, up, twice = state.down_nm, state.up_nm, 2.0 * self.impedance_nm_s_rad
        arrived = down.item(-1)
        speed = bristle = travel = 0.0             # of a clamped bottom
        if self.params.bottom_end == "free":
            speed = arrived / (self.impedance_nm_s_rad + 0.5 * self._drag)
            travel = speed * self.tick_s
        elif self.params.bottom_end != "clamped":
            shaft = self._bottom
            speed, bristle, travel = self._bottom_move(
                shaft, state.bottom_speed_rad_s, state.bottom_bristle_rad, arrived - shaft.load_nm - bottom_load_nm,
                self.tick_s)
        angle = state.bottom_angle_rad + travel
        falling, rising = down[:-1], up[1:]        # waves that meet between two cells
        between = falling + rising
        between *= self._pass
        new_down, new_up = np.empty(self.cells), np.empty(self.cells)
        np.subtract(between, rising, new_down[1:])
        np.subtract(between, falling, new_up[:-1])
        mean = (state.angle_rad - state.tick_angle_rad) / self.tick_s
        new_down[0] = twice * mean - up.item(0)
        new_up[-1] = twice * travel / self.tick_s - arrived
        return StringState(state.speed_rad_s, state.angle_rad, state.bristle_rad, speed, angle, bristle,
                           new_down, new_up, 0.0, state.angle_rad)

    def _with_string(self, shaft: ShaftParams) -> ShaftParams:
        seen = shaft.viscous_nm_s_rad + self.impedance_nm_s_rad + 0.5 * self._drag
        return shaft.model_copy(update={"viscous_nm_s_rad": seen})
