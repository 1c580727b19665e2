"""What a drive reported last, in its own counts, and the Sample in SI at the motor shaft that is made of it."""

from collections.abc import Mapping

from drivers.canopen.state_machine import INTERNAL_LIMIT, SPEED_ZERO, TARGET_REACHED, State, decode, power_state
from drivers.cia402.objects import Units
from drivers.drive import Mode, PowerState, Sample

_PROFILE_VELOCITY = 3


class Reported:
    """As TPDOs or single answers brought it; what hasn't come yet is zero."""

    def __init__(self) -> None:
        self.state = State.NOT_READY
        self.shown_code = 0            # 6061h
        self._status = 0
        self._speed_raw = 0
        self._torque_raw: float = 0
        self._demand_raw: int | None = None

    def take(self, status: int, speed_raw: int, torque_raw: float | None) -> None:
        """6041h, 606Ch and 6077h (or the manufacturer's object) of one instant; None: the torque stays as it was."""
        self._status, self._speed_raw = status, speed_raw
        self._torque_raw = self._torque_raw if torque_raw is None else torque_raw
        self.state = decode(status)

    def take_slow(self, shown_code: int, demand_raw: int | None) -> None:
        """6061h, and 6074h where the drive has it."""
        self.shown_code, self._demand_raw = shown_code, demand_raw

    def sample(self, time_s: float, age_s: float, fresh: bool, units: Units, modes: Mapping[int, Mode]) -> Sample:
        """``time_s`` and ``age_s`` in control time; ``modes`` by their codes of 6061h."""
        status = self._status
        power = power_state(self.state)
        reached = bool(status & TARGET_REACHED) and power is PowerState.QUICK_STOP
        zero = bool(status & SPEED_ZERO) and self.shown_code == _PROFILE_VELOCITY and power is PowerState.ENABLED
        demand = self._demand_raw
        return Sample(
            time_s,
            age_s,
            0.0,
            fresh,
            self._speed_raw * units.speed_rad_s_per_lsb,
            self._torque_raw * units.torque_nm_per_lsb,
            None if demand is None else demand * units.torque_nm_per_lsb,
            modes.get(self.shown_code),
            power,
            reached or zero,
            bool(status & INTERNAL_LIMIT),
            status,
        )
