"""The error tree of all rooms that talk to a drive.

::

    TdhilError                      what, where, next step
    ├── DataFileError               rig.yaml:12: unknown key 'speed_max'
    ├── PreflightRefused            the drive's identity is not the profile's; nothing has moved
    │   └── ObjectRefused           SDO abort 06090030h on 6072h; Modbus exception 2 on register 40111
    ├── CommunicationLost           no statusword for 5 cycles; adapter unplugged; SDO time-out; Modbus CRC
    ├── DriveFault                  EMCY 3210h in motion; fault state; state machine stuck; Modbus exception in motion
    │   ├── SensorFault             EMCY 7305h in motion: the sensor of speed and position is at fault
    │   ├── ModeNotConfirmed        6061h did not follow 6060h in time
    │   └── ReportsContradict       the reported speed fell by 4 rad/s while the reported torque accelerates the shaft
    ├── LimitHit                    speed left its window; torque or time limit reached
    ├── StopNotConfirmed            no standstill was detected after the stop sequence
    └── CommandRejected             a NaN or out-of-range setpoint; it never reached the bus

Errors of a single bus are leaves of these (`drivers.modbus.pdu`). `tdhil.errors` assigns the exit codes.
"""

from profiles import DataFileError, MessageCode, Problem, TdhilError

__all__ = [
    "CommandRejected",
    "CommunicationLost",
    "DataFileError",
    "DriveFault",
    "LimitHit",
    "ModeNotConfirmed",
    "ObjectRefused",
    "PreflightRefused",
    "Problem",
    "ReportsContradict",
    "SensorFault",
    "StopNotConfirmed",
    "TdhilError",
]


class PreflightRefused(TdhilError):
    """Refused before the shaft has moved: identity, limits, watchdog, mode or confirmation."""

    entry = MessageCode.PREFLIGHT_REFUSED


class ObjectRefused(PreflightRefused):
    """The drive aborted the transfer of an object. Objects are read and written only before the shaft moves."""

    entry = MessageCode.OBJECT_REFUSED


class CommunicationLost(TdhilError):
    """The drive can't be reached, or its frames are not received."""

    entry = MessageCode.COMMUNICATION_LOST


class DriveFault(TdhilError):
    """The drive itself reports a fault or leaves the requested state."""

    entry = MessageCode.DRIVE_FAULT


class SensorFault(DriveFault):
    """The drive reports a fault of its sensor of speed and position: its reported speed is in doubt."""


class ModeNotConfirmed(DriveFault):
    """The drive did not confirm the requested mode of operation."""

    entry = MessageCode.MODE_NOT_CONFIRMED


class ReportsContradict(DriveFault):
    """Two reports of the drive can't both be true for one shaft."""

    entry = MessageCode.REPORTS_CONTRADICT


class LimitHit(TdhilError):
    """A limit of the rig (speed window, torque, time) was reached or will be."""

    entry = MessageCode.LIMIT_HIT


class StopNotConfirmed(TdhilError):
    """The stop sequence ran, but standstill was not confirmed."""

    entry = MessageCode.STOP_NOT_CONFIRMED


class CommandRejected(TdhilError):
    """A setpoint that must not reach the bus: not finite, or outside the limits."""

    entry = MessageCode.COMMAND_REJECTED
