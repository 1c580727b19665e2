"""CiA 402 drives on any bus: states, modes, units, preflight, quick stop, supervision; knows no bus."""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from drivers.cia402.bus import (
        Cia402Bus as Cia402Bus, CycleInputs as CycleInputs, CycleSetpoints as CycleSetpoints,
        FeedbackSetting as FeedbackSetting, Traffic as Traffic,
    )
    from drivers.cia402.drive import Cia402Drive as Cia402Drive, DRIVE_SILENT_S as DRIVE_SILENT_S
    from drivers.cia402.limits import check_parameters as check_parameters
    from drivers.cia402.objects import Objects as Objects, name as name
    from drivers.cia402.polling import ANSWER_S as ANSWER_S, answer_time_s as answer_time_s
    from drivers.cia402.preflight import find_units as find_units
    from drivers.cia402.process_data import (
        CONTROLWORD as CONTROLWORD, CyclicObjects as CyclicObjects, LAYOUTS as LAYOUTS, MODE as MODE,
        MODE_DISPLAY as MODE_DISPLAY, STATUSWORD as STATUSWORD, TARGET_TORQUE as TARGET_TORQUE,
        TORQUE_DEMAND as TORQUE_DEMAND, bits_of as bits_of, cyclic_objects as cyclic_objects,
    )
    from drivers.cia402.quick_stop import Cia402Target as Cia402Target
    from drivers.cia402.state_machine import State as State, decode as decode
    from drivers.cia402.supervision import (
        DriveWatch as DriveWatch, Group as Group, HOST_SILENT as HOST_SILENT, emcy_text as emcy_text,
    )
    from drivers.cia402.watchdog import arm as arm
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "bus": "Cia402Bus CycleInputs CycleSetpoints FeedbackSetting Traffic",
        "drive": "Cia402Drive DRIVE_SILENT_S",
        "limits": "check_parameters",
        "objects": "Objects name",
        "polling": "ANSWER_S answer_time_s",
        "preflight": "find_units",
        "process_data": "CONTROLWORD CyclicObjects LAYOUTS MODE MODE_DISPLAY STATUSWORD TARGET_TORQUE TORQUE_DEMAND "
                        "bits_of cyclic_objects",
        "quick_stop": "Cia402Target",
        "state_machine": "State decode",
        "supervision": "DriveWatch Group HOST_SILENT emcy_text",
        "watchdog": "arm",
    })
