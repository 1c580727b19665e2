"""What run.mcap holds: the channels, their numbers and their messages.

====  ==============  =============  =====================================================================
  id  topic           message        when
====  ==============  =============  =====================================================================
   1  /sample         Sample         every cycle, SI at the motor shaft
   2  /command        Command        every cycle
   3  /can            Frames         the frames of a cycle, as they stood on the bus
   4  /stage          Stage          when a stage has ended
   5  /excitation     Motion         excitation, levels and ramps; the last one counts
   6  /event          Event          when something happened
   7  /configuration  Text           JSON: {"run": …, "recording": …}; the last one counts
   8  /result         Text           JSON; the last one counts
   9  /log            foxglove.Log   the same events again, for viewers; never read back
  10  /modbus         Frames         requests and replies (PDU), in place of /can; older logs have them there
====  ==============  =============  =====================================================================

A message's log time is the epoch handed in at the start plus its control time, in nanoseconds.
"""

from typing import Any, Final

from drivers.drive import Mode, PowerState
from tdhil.record.event import Event
from tdhil.record.foxglove import LOG_CLASS
from tdhil.record.schema import fields_of, message_classes
from tdhil.recording.recording import Excitation, Level, Ramp, Segment, Stage

PACKAGE: Final = "tdhil"

SAMPLE: Final = 1
COMMAND: Final = 2
CAN: Final = 3
STAGE: Final = 4
EXCITATION: Final = 5
EVENT: Final = 6
CONFIGURATION: Final = 7
RESULT: Final = 8
LOG: Final = 9
MODBUS: Final = 10

CHANNELS: Final = {
    SAMPLE: ("/sample", "Sample"),
    COMMAND: ("/command", "Command"),
    CAN: ("/can", "Frames"),
    STAGE: ("/stage", "Stage"),
    EXCITATION: ("/excitation", "Motion"),
    EVENT: ("/event", "Event"),
    CONFIGURATION: ("/configuration", "Text"),
    RESULT: ("/result", "Text"),
    LOG: ("/log", "Log"),
    MODBUS: ("/modbus", "Frames"),
}

MODES: Final = {None: 0, Mode.SPEED: 1, Mode.TORQUE: 2}
MODE_OF: Final = {number: mode for mode, number in MODES.items()}
STATES: Final = {
    PowerState.NOT_READY: 0,
    PowerState.OFF: 1,
    PowerState.READY: 2,
    PowerState.ENABLED: 3,
    PowerState.QUICK_STOP: 4,
    PowerState.FAULT: 5,
}
STATE_OF: Final = {number: state for state, number in STATES.items()}

ENUMS: Final = {
    "Mode": ("OTHER", "SPEED", "TORQUE"),
    "State": tuple(state.name for state in STATES),
}
MESSAGES: Final = {
    "Sample": {
        "time_s": "double",
        "speed_rad_s": "double",
        "torque_nm": "double",
        "age_s": "double",
        "half_width_s": "double",
        "fresh": "bool",
        "limit_active": "bool",
        "standstill": "bool",
        "state": "State",
        "mode": "Mode",
        "status": "fixed32",
        "torque_demand_nm": "double?",
    },
    "Command": {"time_s": "double", "speed_rad_s": "double", "torque_nm": "double", "mode": "Mode"},
    "Frame": {"time_s": "double", "outgoing": "bool", "identifier": "fixed32", "data": "bytes"},
    "Frames": {"time_s": "double", "frames": "Frame*"},
    "Stage": fields_of(Stage),
    "Segment": fields_of(Segment),
    "Excitation": fields_of(Excitation),
    "Level": fields_of(Level),
    "Ramp": fields_of(Ramp),
    "Motion": {"excitation": "Excitation?", "levels": "Level*", "ramps": "Ramp*"},
    "Event": fields_of(Event),
    "Text": {"json": "string"},
}
CLASSES: Final[dict[str, Any]] = message_classes(PACKAGE, ENUMS, MESSAGES) | {"Log": LOG_CLASS}


def schema_name(message: str) -> str:
    """A message's full name, such as ``tdhil.Sample``."""
    name: str = CLASSES[message].DESCRIPTOR.full_name
    return name
