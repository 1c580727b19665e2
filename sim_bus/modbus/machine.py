"""Simulated drive with the interface of a profile: registers, words, watchdog, loops and shaft, without its bus.

Plant and control advance on the drive's own grid, the control period of plant.yaml. A request acts between two steps.
The module owns no clock: the caller of `run_until` states the time.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Self

import numpy as np

from profiles.modbus import ModbusProfile, ModbusWatchdog
from sim_bus.cia402 import Application, OperationMode
from sim_bus.inverter import Inverter
from sim_bus.modbus.control_words import FAMILIES, Wiring
from sim_bus.modbus.parameters import ParameterStore, reporting_lag_s
from sim_bus.modbus.registers import Answer, Bank, Map
from sim_bus.modbus.wrong_maps import Wrong
from sim_bus.params import RigParams
from sim_bus.trace import ROW_PERIOD_US, ShaftTrace

# ---------------------------------------------------------------------------------------------------------------------
# The drive's supervision of its host. It begins with the first message that feeds it, and acts once if none comes.
# Pure.


_OWN = "_of_this_connection"


class SimulatedWatchdog:
    """Requests that feed the watchdog, and its time-out."""

    def __init__(self, watchdog: ModbusWatchdog) -> None:
        self._fed_by = watchdog.fed_by.removesuffix(_OWN)
        self._own_only = watchdog.fed_by.endswith(_OWN)
        self._commander: int | None = None
        self._fed_s: float | None = None
        self.lost = False
        """True if the host has been found silent and was not received since."""

    def heard(self, time_s: float, *, wrote: bool, commanded: bool, connection: int = 0) -> None:
        """Record a request to this drive. ``connection`` distinguishes clients: the first one that commands is the
        host.
        """
        if commanded and (self._commander is None or self.lost):
            self._commander = connection
        if self._own_only and connection != self._commander:
            return
        if {"writes": wrote, "control_word": commanded}.get(self._fed_by, True):
            self._fed_s = time_s
            self.lost = False

    def expired(self, time_s: float, timeout_s: float) -> bool:
        """Return True once after the host was silent for ``timeout_s``; 0 s switches the supervision off."""
        if self._fed_s is None or timeout_s <= 0.0 or time_s - self._fed_s < timeout_s:
            return False
        self._fed_s = None
        self.lost = True
        return True


# ---------------------------------------------------------------------------------------------------------------------

_REACTIONS = {"none": 0, "fault_reaction": 1, "coast": 2, "quick_stop": 3, "ramp_stop": 3}
"""Codes of the reactions, as in 6007h."""
_SLOW_DOWN_RAMP = 1
RAMP_RAD_S2 = 1.5
"""Acceleration of a speed-only drive, whose setpoint passes a ramp generator (ATV320 ACC 9001 and DEC 9002, Delta
Pr.01-12 and 01-13, Danfoss 3-41 and 3-42, Lenze 6048h and 6049h): set short, as the profiles' hints advise. From
standstill to the default rig's speed limit in 14 s. The profiles have no register for it, so it is not reported."""


class Machine:
    """A drive on Modbus with its shaft."""

    def __init__(self, params: RigParams, profile: ModbusProfile, *, seed: int = 0, trace: Path | None = None,
                 wrongs: tuple[Wrong, ...] = (), stepped: bool = True) -> None:
        self._profile = profile
        self.parameters = ParameterStore(profile, params, wrongs)
        # The reporting lags are those of the profile's drive, and the quantisation is that of the registers.
        reporting: dict[str, float] = {"speed_quantum_rpm": 0.0, "torque_quantum_permille": 0.0}
        for signal in ("speed", "torque"):
            lag_s = reporting_lag_s(profile, self.parameters, signal)
            if lag_s is not None:
                reporting[f"{signal}_lag_s"] = lag_s
        rig = params.model_copy(update={"reporting": params.reporting.model_copy(update=reporting)})
        self.inverter = Inverter(rig, np.random.default_rng(seed))
        self.application = application = Application(self.inverter)
        wiring = _wiring(profile)
        application.set_mode((OperationMode.PROFILE_VELOCITY if wiring.ramps else OperationMode.CYCLIC_VELOCITY).value)
        application.settings.accel_rad_s2 = application.settings.decel_rad_s2 = RAMP_RAD_S2
        self.words = FAMILIES[profile.control.family](application, wiring)
        self._map = Map(profile, self.parameters, self.words, wrongs, stepped=stepped, on_stage=self._told_stage)
        cycle = profile.cycle
        self._bank = Bank(self._map.slots, cycle.functions, self._written, largest_read=cycle.largest_read,
                          largest_write=cycle.largest_write)
        self.watchdog = SimulatedWatchdog(profile.watchdog)
        self._trace = ShaftTrace(trace)
        self._period_s = params.drive.control_period_s
        self._steps = 0
        self._next_row_us = 0
        self._torque_share = 1.0
        self._connection = 0
        self._was_told = False         # the present request reports a stage
        self.on_time: Callable[[int], None] | None = None      # called with plant time in µs after each step
        self.on_stage: Callable[[int], None] = lambda _number: None
        application.on_event = self.note
        self._obey_parameters()
        self.note("power on")

    @property
    def time_s(self) -> float:
        """Plant time, s."""
        return self._steps * self._period_s

    def request(self, pdu: bytes, connection: int = 0) -> bytes:
        """Return the reply to a request at the present time; ``connection`` distinguishes clients."""
        self._connection = connection
        self._was_told = False
        answer = self._bank.answer(pdu)
        if not self._was_told:          # a write to the marker feeds no watchdog
            self._fed(answer)
        return answer.pdu

    def refuse(self, pdu: bytes, code: int) -> bytes:
        """Scripted: receive a request without executing it, and reply with the exception of this code."""
        self._fed(Answer(b""))
        return bytes((pdu[0] | 0x80, code))

    def heat(self, temperature_c: float) -> None:
        """Scripted: set this temperature, °C, for all that the drive reports."""
        self._map.temperature_c = temperature_c

    def leave_torque(self, share: float) -> None:
        """Scripted: limit the torque internally to this share of the torque limits."""
        self._torque_share = share
        self._obey_parameters()

    def run_until(self, time_s: float) -> None:
        """Advance everything up to the last step of the grid that is not later."""
        last = int(time_s / self._period_s * (1.0 + 1e-12) + 1e-6)
        if last > self._steps:
            self.application.regulate()
        while self._steps < last:
            self._steps += 1
            self.application.step(self._period_s)
            self._row()
            self._watch()
            if self.on_time is not None:
                self.on_time(round(1e6 * self.time_s))

    def trip(self) -> None:
        """Enter a fault of the drive itself."""
        self.application.fault()
        self.note("fault")

    def note(self, event: str) -> None:
        """Add a row with an event to the trace; '' is a new state."""
        state = self.application.state.value
        self._trace.row(self.time_s, self.inverter.speed_rad_s, self.inverter.torque_nm, state,
                        event or f"state: {state}")

    def close(self) -> None:
        """Close the trace; safe to repeat."""
        self._trace.close()

    def flush(self) -> None:
        """Write buffered rows, so that readers of the trace see them."""
        self._trace.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- inside --------------------------------------------------------------------------------------------

    def _written(self) -> None:
        self._obey_parameters()
        self._map.act()

    def _obey_parameters(self) -> None:
        limits, parameters = self.inverter.control.limits, self.parameters
        limits.torque_forward_nm = self._torque_share * parameters.limit_nm("torque_limit")
        limits.torque_reverse_nm = self._torque_share * parameters.limit_nm("torque_limit_reverse")
        limits.speed_rad_s = parameters.speed_limit_rad_s()
        self.application.settings.quick_stop_rad_s2 = parameters.quick_stop_rad_s2()

    def _told_stage(self, number: int) -> None:
        self._was_told = True
        self.note(f"stage {number}")
        self.on_stage(number)

    def _fed(self, answer: Answer) -> None:
        lost = self.watchdog.lost
        self.watchdog.heard(self.time_s, wrote=answer.wrote, commanded=answer.commanded,
                            connection=self._connection)
        if lost and not self.watchdog.lost:
            self.application.warning = False
            self.note("host is back")

    def _watch(self) -> None:
        watchdog = self._profile.watchdog
        if watchdog.kind == "none" or watchdog.parameter is None:
            return
        if self.watchdog.expired(self.time_s, self.parameters.value(watchdog.parameter)):
            self._host_lost()

    def _host_lost(self) -> None:
        """Execute the profile's reaction. There is none if the parameter that selects it does not have the required
        value.
        """
        self.note("host silent")
        watchdog, settings = self._profile.watchdog, self.application.settings
        self.application.warning = True
        self.words.set_quick_stop()
        if watchdog.reaction == "ramp_stop":
            settings.quick_stop_option = _SLOW_DOWN_RAMP
        chosen = self.parameters.met(watchdog.reaction_parameter)
        settings.connection_option = _REACTIONS[watchdog.reaction] if chosen else 0
        self.application.abort_connection()
        if settings.connection_option:
            self.words.host_lost()
        self.application.regulate()

    def _row(self) -> None:
        time_us = round(self.time_s * 1e6)
        if time_us >= self._next_row_us:
            self._next_row_us = (time_us // ROW_PERIOD_US + 1) * ROW_PERIOD_US
            self._trace.row(self.time_s, self.inverter.speed_rad_s, self.inverter.torque_nm,
                            self.application.state.value)


def _wiring(profile: ModbusProfile) -> Wiring:
    return Wiring(
        torque_bits=profile.control.torque_bits if profile.modes.torque else 0,
        mode_register=profile.modes.by == "register",
        reverse_bits=profile.control.reverse_bits or 0,
        switch_while_enabled=profile.modes.switch_while_enabled,
        brakes_in_torque=profile.quick_stop.decelerates_in_torque_mode,
        holds_after_quick_stop=profile.quick_stop.ends == "quick_stop",
        ramps=not profile.modes.torque,
        status_address=profile.cycle.status.register_.address,
    )
