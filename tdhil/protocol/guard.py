"""The guard over every command and every sample. Pure: it looks, and raises.

In torque mode it does not wait for the speed limit to be crossed. What is reported is old: with a reporting
lag τ and a reaction time t_r the shaft will have reached, before anything the host does can act,

    ω_pred = ω_reported + |T_net| / J_min · (t_r + τ_max)        T_net = T − T_c − B ω

and it is ω_pred that must stay below the window's upper end (a quantum of speed at 250 Hz is already 2.6 rad/s², so
differentiating the reported speed instead would see nothing but noise).
"""

from __future__ import annotations

import math

from drivers.drive import Command, Mode, PowerState, Sample
from drivers.errors import CommandRejected, CommunicationLost, DriveFault, LimitHit
from tdhil.protocol.excitation import RigGuess
from tdhil.protocol.settings import ControlAssumptions, MachineLimits

LONGEST_AGE_S = 0.25
"""Feedback may be missing for this long at most; the drive goes on by itself meanwhile, at what it was last told."""


class Guard:
    """Holds the machine's limits over one run. ``model`` and ``expected`` are set by the stages as they learn."""

    def __init__(
        self,
        limits: MachineLimits,
        period_s: float,
        speed_resolution_rad_s: float,
        torque_resolution_nm: float,
        assumptions: ControlAssumptions | None = None,
    ) -> None:
        assumptions = assumptions or ControlAssumptions()
        self._limits = limits
        self._horizon_s = assumptions.reaction_s + assumptions.largest_speed_lag_s
        self._smallest_share = assumptions.smallest_inertia_share
        # Noise and quantisation about zero are no reverse rotation.
        self._reverse_rad_s = max(5.0 * speed_resolution_rad_s, 0.02 * limits.speed_max_rad_s)
        # The reported torque is noisy and may overshoot; what was commanded is held exactly.
        self._torque_seen_nm = 1.25 * limits.torque_nm + 10.0 * torque_resolution_nm
        # Half of what the drive's watchdog grants the host, and never on account of two lost frames.
        self._stale_limit = max(3, math.ceil(min(LONGEST_AGE_S, 0.5 * limits.watchdog_s) / period_s))
        self._stale = 0
        self._started_s: float | None = None
        self.expected: PowerState | None = None
        self.model: RigGuess | None = None

    def check_command(self, command: Command) -> None:
        """Raise CommandRejected for a setpoint that must not reach the bus."""
        speed, torque = command.speed_rad_s, command.torque_nm
        if not (math.isfinite(speed) and math.isfinite(torque)):
            raise CommandRejected(f"setpoint is not finite (speed {speed}, torque {torque})", where="guard")
        if abs(torque) > self._limits.torque_nm * (1.0 + 1e-9):
            raise CommandRejected(
                f"torque setpoint {torque:.1f} N·m is beyond the limit of {self._limits.torque_nm:g} N·m", where="guard"
            )
        lowest = -self._limits.speed_max_rad_s if self._limits.allow_reverse else 0.0
        if not lowest <= speed <= self._limits.speed_max_rad_s:
            raise CommandRejected(
                f"speed setpoint {speed:.3f} rad/s is outside {lowest:g} to {self._limits.speed_max_rad_s:g} rad/s",
                where="guard",
            )

    def start_clock(self, time_s: float) -> None:
        """The time limit counts from here."""
        self._started_s = time_s

    def left_s(self, time_s: float) -> float:
        """What the time limit leaves, s."""
        return self._limits.time_s - (0.0 if self._started_s is None else time_s - self._started_s)

    def check_sample(self, command: Command, sample: Sample) -> None:
        """Raise what the sample shows: CommunicationLost, DriveFault or LimitHit."""
        self._check_age(sample)
        if self.expected is not None and sample.state is not self.expected:
            raise DriveFault(
                f"the drive left the state '{self.expected.value}' and shows '{sample.state.value}'",
                where=f"statusword {sample.status:04X}h at {sample.time_s:.3f} s",
                next_step="Look into the drive's fault list; STO, a fault or a second master may have done it",
            )
        speed = sample.speed_rad_s
        if not (math.isfinite(speed) and math.isfinite(sample.torque_nm)):
            raise DriveFault(
                f"the feedback is not finite (speed {speed}, torque {sample.torque_nm})",
                where=f"guard at {sample.time_s:.3f} s",
                next_step="Do word order and scaling in the profile fit this drive?",
            )
        if speed > self._limits.speed_max_rad_s or (
            self._limits.allow_reverse and speed < -self._limits.speed_max_rad_s
        ):
            raise LimitHit(
                f"speed {speed:.3f} rad/s is beyond the limit of {self._limits.speed_max_rad_s:g} rad/s",
                where=f"guard at {sample.time_s:.3f} s",
                next_step="The shaft was stopped. Was the load lost? Check limits.speed_max_rad_s in rig.yaml",
            )
        if not self._limits.allow_reverse and speed < -self._reverse_rad_s:
            raise LimitHit(
                f"the shaft turns backwards ({speed:.3f} rad/s) and allow_reverse is false",
                where=f"guard at {sample.time_s:.3f} s",
                next_step="The shaft was stopped. Reverse rotation backs off tool joints",
            )
        if abs(sample.torque_nm) > self._torque_seen_nm:
            raise LimitHit(
                f"torque {sample.torque_nm:.1f} N·m is beyond the limit of {self._limits.torque_nm:g} N·m",
                where=f"guard at {sample.time_s:.3f} s",
                next_step="The shaft was stopped. Does the drive's rated torque match rig.yaml?",
            )
        if self._started_s is not None and sample.time_s - self._started_s > self._limits.time_s:
            raise LimitHit(
                f"the run has taken longer than {self._limits.time_s:g} s",
                where=f"guard at {sample.time_s:.3f} s",
                next_step="Raise limits.time_s in rig.yaml or ask for fewer periods",
            )
        if command.mode is Mode.TORQUE and self.model is not None:
            self._check_prediction(self.model, command, speed, sample.time_s)

    @staticmethod
    def foresight_s(assumptions: ControlAssumptions) -> float:
        """What a plan must keep free: the guard adds this times the acceleration to the speed."""
        return (assumptions.reaction_s + assumptions.largest_speed_lag_s) / assumptions.smallest_inertia_share

    def predicted_speed(self, model: RigGuess, torque_nm: float, speed_rad_s: float) -> float:
        """Where the shaft may be, rad/s, before the host can act on what it now sees."""
        net_nm = torque_nm - model.steady_torque_nm(speed_rad_s)
        return speed_rad_s + net_nm / (self._smallest_share * model.inertia_kg_m2) * self._horizon_s

    def _check_prediction(self, model: RigGuess, command: Command, speed_rad_s: float, time_s: float) -> None:
        predicted = self.predicted_speed(model, command.torque_nm, speed_rad_s)
        if predicted > self._limits.speed_max_rad_s:
            raise LimitHit(
                f"the speed is about to leave its window: {speed_rad_s:.3f} rad/s reported and"
                f" {command.torque_nm:.1f} N·m lead to {predicted:.3f} rad/s,"
                f" beyond {self._limits.speed_max_rad_s:g} rad/s",
                where=f"guard at {time_s:.3f} s",
                next_step="The shaft was stopped. Lower the amplitude or the offset",
            )

    def _check_age(self, sample: Sample) -> None:
        if sample.fresh:
            self._stale = 0
            return
        self._stale += 1
        if self._stale >= self._stale_limit:
            raise CommunicationLost(
                f"no feedback for {self._stale} cycles",
                where=f"guard at {sample.time_s:.3f} s",
                next_step="Check the drive's supply and the bus; the drive's own watchdog stops the shaft",
            )
