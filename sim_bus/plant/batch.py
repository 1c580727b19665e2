r"""Many rigid shafts at once: the equations of `sim_bus.plant.rigid`, one state array, one fixed step for each run.

::

    J dω/dt = u − B ω − T_f          u = torque − load, held constant over a step

The state is an array of three rows (speed, angle, bristle) and one column per run. Parameters and step are arrays of
one entry per run: runs of different duration have the same number of steps. Every formula is the scalar plant's (exact
for Coulomb friction; bristle exact and speed of second order for Dahl's), evaluated for all runs, with masks that
select between cases. The result agrees with the scalar plant to 1e-9, relative to the larger of 1 and the value, over a
run of thousands of steps. The difference is the last bit of numpy's exponential.

A bristle needs a short step, σ h²/J ≤ 0.005. Otherwise the scalar plant divides the step into pieces, whose number
differs between runs; here such a step is refused.

There is no clock and no seed here: the caller provides the time and the generator of `white_torque`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

SPEED, ANGLE, BRISTLE = 0, 1, 2
"""Rows of the state."""

LARGEST_BRISTLE_STEP = 0.005
"""Largest σ h²/J, as in the scalar plant. Above it the scalar plant divides the step."""

_TINY = 1e-15
_LIGHTLY_DAMPED = 0.02
_SHORT_PATH = 1e-6


@dataclass(frozen=True)
class Shafts:
    """Parameters of the shafts: one entry per run, like `sim_bus.plant.rigid.Params`."""

    inertia_kg_m2: FloatArray
    viscous_nm_s_rad: FloatArray
    coulomb_nm: FloatArray
    dahl_stiffness_nm_rad: FloatArray
    dahl: BoolArray
    """True: Dahl's bristle; False: Coulomb friction."""

    @classmethod
    def of(
        cls, inertia_kg_m2: ArrayLike, viscous_nm_s_rad: ArrayLike, coulomb_nm: ArrayLike,
        dahl_stiffness_nm_rad: ArrayLike, dahl: ArrayLike,
    ) -> Shafts:
        """Return shafts from numbers or lists, each expanded to the number of runs of the longest."""
        numbers = np.broadcast_arrays(
            *(np.atleast_1d(np.asarray(one, dtype=np.float64))
              for one in (inertia_kg_m2, viscous_nm_s_rad, coulomb_nm, dahl_stiffness_nm_rad, dahl))
        )
        inertia, viscous, coulomb, stiffness, bristles = (np.array(one) for one in numbers)
        if np.any(inertia <= 0.0) or np.any(stiffness <= 0.0) or np.any(viscous < 0.0) or np.any(coulomb < 0.0):
            raise ValueError("inertia and stiffness must be positive, friction not negative")
        # A bristle without friction carries no load, and its equation divides by the friction.
        return cls(inertia, viscous, coulomb, stiffness, (bristles != 0.0) & (coulomb > 0.0))

    def __len__(self) -> int:
        return len(self.inertia_kg_m2)

    def at_rest(self) -> FloatArray:
        """Return the state of shafts that have never moved."""
        return np.zeros((3, len(self)))


class FixedStep:
    """Solver of one step of ``dt_s`` for all shafts (one number, or one for each run)."""

    def __init__(self, shafts: Shafts, dt_s: ArrayLike) -> None:
        self.shafts = shafts
        self.dt_s = np.array(np.broadcast_to(np.asarray(dt_s, dtype=np.float64), (len(shafts),)))
        if not np.all(self.dt_s > 0.0):
            raise ValueError("the step must be positive")
        stiff = shafts.dahl_stiffness_nm_rad * self.dt_s**2 / shafts.inertia_kg_m2
        if np.any(stiff[shafts.dahl] > LARGEST_BRISTLE_STEP):
            raise ValueError(f"σ h²/J = {stiff[shafts.dahl].max():.3g}: the step is too long for the bristle")
        self._response = self._respond(self.dt_s)
        with np.errstate(divide="ignore"):
            self._limit = np.where(shafts.dahl, shafts.coulomb_nm / shafts.dahl_stiffness_nm_rad, 1.0)
        self._any_dahl, self._all_dahl = bool(shafts.dahl.any()), bool(shafts.dahl.all())

    def advance(self, state: FloatArray, drive_nm: FloatArray) -> FloatArray:
        """Return the state one step later under the torque ``drive_nm`` (motor torque minus load)."""
        speed, angle, bristle = state
        if not self._any_dahl:
            end, travel = self._coulomb(speed, drive_nm)
            return np.stack((end, angle + travel, np.zeros_like(end)))
        end, deflection, travel = self._dahl(speed, bristle, drive_nm)
        if not self._all_dahl:
            other, other_travel = self._coulomb(speed, drive_nm)
            mask = self.shafts.dahl
            end, travel = np.where(mask, end, other), np.where(mask, travel, other_travel)
            deflection = np.where(mask, deflection, 0.0)
        return np.stack((end, angle + travel, deflection))

    def _respond(self, dt_s: FloatArray) -> FloatArray:
        """Return (1 − e^−x)/B with x = B h/J, and h/J for B → 0: speed gained per unit of net torque."""
        viscous, inertia = self.shafts.viscous_nm_s_rad, self.shafts.inertia_kg_m2
        damped = viscous * dt_s > _TINY * inertia
        return np.where(damped, -np.expm1(-viscous * dt_s / inertia) / np.where(damped, viscous, 1.0), dt_s / inertia)

    def _coulomb(self, speed: FloatArray, drive: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (speed, travel), exact. A run that reaches zero sticks there, or continues with the rest
        of the step.
        """
        shafts, dt = self.shafts, self.dt_s
        dry, viscous, inertia = shafts.coulomb_nm, shafts.viscous_nm_s_rad, shafts.inertia_kg_m2
        holds = np.abs(drive) <= dry
        side = np.where(speed == 0.0, np.sign(drive), np.sign(speed))
        net = drive - side * dry
        end = speed + (net - viscous * speed) * self._response
        travel = self._travel(speed, end, net, dt)
        still = (speed == 0.0) & holds
        crosses = (end * side < 0.0) & ~still
        if crosses.any():
            with np.errstate(all="ignore"):      # runs without a zero crossing; their values are not used
                damped = np.abs(speed) * viscous > _TINY * np.abs(net)
                slowed = np.log1p(np.where(damped, -speed * viscous / net, 0.0)) * inertia / viscous
                crossing = np.where(crosses, np.where(damped, slowed, -speed * inertia / net), 0.0)
            rest = np.maximum(dt - crossing, 0.0)
            further = np.where(holds, 0.0, drive - np.sign(drive) * dry)
            onward, nothing = further * self._respond(rest), np.zeros_like(speed)
            end = np.where(crosses, onward, end)
            both = self._travel(speed, nothing, net, crossing) + self._travel(nothing, onward, further, rest)
            travel = np.where(crosses, both, travel)
        return np.where(still, 0.0, end), np.where(still, 0.0, travel)

    def _travel(self, begin: FloatArray, end: FloatArray, net: FloatArray, dt_s: FloatArray) -> FloatArray:
        """Return the travel under Coulomb friction between two speeds of one sign: momentum balance, or mean speed."""
        viscous, inertia = self.shafts.viscous_nm_s_rad, self.shafts.inertia_kg_m2
        light = viscous * dt_s <= _LIGHTLY_DAMPED * inertia
        mean = 0.5 * (begin + end) * dt_s
        if light.all():
            return mean
        return np.where(light, mean, (net * dt_s - inertia * (end - begin)) / np.where(light, 1.0, viscous))

    def _dahl(
        self, speed: FloatArray, bristle: FloatArray, drive: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return (speed, bristle, travel). The step of a run that passes zero is divided there."""
        dt = self.dt_s
        end, deflection = self._dahl_piece(speed, bristle, drive, dt, self._response)
        travel = 0.5 * (speed + end) * dt
        crosses = speed * end < 0.0
        if crosses.any():
            share = np.where(crosses, speed / np.where(crosses, speed - end, 1.0), 1.0)
            crossing = dt * share
            _, at_zero = self._dahl_piece(speed, bristle, drive, crossing, self._respond(crossing))
            rest = np.where(crosses, dt - crossing, dt)
            after, deflected = self._dahl_piece(np.zeros_like(speed), at_zero, drive, rest, self._respond(rest))
            end, deflection = np.where(crosses, after, end), np.where(crosses, deflected, deflection)
            travel = np.where(crosses, 0.5 * (speed * crossing + after * rest), travel)
        return end, deflection, travel

    def _dahl_piece(
        self, speed: FloatArray, bristle: FloatArray, drive: FloatArray, dt: FloatArray, response: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return (speed, bristle) after ``dt`` without a change of the speed's sign. Two passes find the speed at
        mid-step.
        """
        stiffness, limit = self.shafts.dahl_stiffness_nm_rad, self._limit
        free = drive - self.shafts.viscous_nm_s_rad * speed
        middle = speed + 0.5 * (free - stiffness * bristle) * response
        end, deflection = speed, bristle
        for _ in range(2):
            target = np.copysign(limit, middle)
            path = np.abs(middle) * dt / limit
            gap = bristle - target
            decay = np.exp(-path)
            long = path > _SHORT_PATH
            if long.all():
                deflection = target + gap * decay
                mean = target + gap * (1.0 - decay) / path
            else:
                deflection = np.where(long, target + gap * decay, bristle - gap * path)
                slipped = target + gap * (1.0 - decay) / np.where(long, path, 1.0)
                mean = np.where(long, slipped, bristle - 0.5 * gap * path)
            end = speed + (free - stiffness * mean) * response
            middle = 0.5 * (speed + end)
        return end, deflection


def white_torque(power_nm2_s: FloatArray, dt_s: FloatArray, steps: int, rng: np.random.Generator) -> FloatArray:
    """Return band-limited white torque, held over each step: (steps, runs) in N·m.

    White noise of the two-sided density P, in (N·m)²·s, averaged over a step h has the variance P/h: the standard
    deviation is √(P/h). A power in (N·m)², as sometimes printed, is not a density.
    """
    return rng.standard_normal((steps, len(power_nm2_s))) * np.sqrt(power_nm2_s / dt_s)
