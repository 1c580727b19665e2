"""The error tree of everything that talks to a drive.

::

    TdhilError                      what, where, next step
    ├── DataFileError               rig.yaml:12: unknown key 'speed_max'
    ├── PreflightRefused            the drive's identity is not the profile's; nothing has moved
    │   └── ObjectRefused           SDO abort 06090030h on 6072h; Modbus exception 2 on register 40111
    ├── CommunicationLost           no statusword for 5 cycles; adapter unplugged; SDO time-out; Modbus CRC
    ├── DriveFault                  EMCY 7305h in motion; fault state; state machine stuck; Modbus exception in motion
    │   ├── ModeNotConfirmed        6061h did not follow 6060h in time
    │   └── ReportsContradict       the reported speed fell by 4 rad/s while the reported torque accelerates the shaft
    ├── LimitHit                    speed left its window; torque or time limit reached
    ├── StopNotConfirmed            the shaft was not seen at rest after the stop sequence
    └── CommandRejected             a NaN or out-of-range setpoint; never reached the bus

Those of one bus only are leaves of these (`drivers.modbus.pdu`). `tdhil.errors` says which of them ends with which
exit code.
"""

from profiles import DataFileError, Problem, TdhilError

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
    "StopNotConfirmed",
    "TdhilError",
]


class PreflightRefused(TdhilError):
    """Refused before the shaft has moved: identity, limits, watchdog, mode or confirmation."""


class ObjectRefused(PreflightRefused):
    """The drive aborted the transfer of an object; objects are read and written before the shaft moves only."""


class CommunicationLost(TdhilError):
    """The drive can't be heard or reached any more."""


class DriveFault(TdhilError):
    """The drive itself reports a fault or leaves the state it was asked to hold."""


class ModeNotConfirmed(DriveFault):
    """The drive did not take over the mode of operation it was asked for."""


class ReportsContradict(DriveFault):
    """Two reports of the drive cannot both be true of one shaft."""


class LimitHit(TdhilError):
    """A limit of the rig (speed window, torque, time) was reached or is about to be."""


class StopNotConfirmed(TdhilError):
    """The stop sequence ran, but the shaft was not seen at rest."""


class CommandRejected(TdhilError):
    """A setpoint that must not reach the bus: not finite, or outside the limits."""
