"""CiA 402 drives on any bus: states, modes, units, preflight, quick stop, supervision; knows no bus."""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from drivers.cia402.bus import (
        Cia402Bus as Cia402Bus, CycleInputs as CycleInputs, CycleSetpoints as CycleSetpoints,
        FeedbackSetting as FeedbackSetting, Traffic as Traffic,
    )
    from drivers.cia402.cycle_period import (
        INTERPOLATION as INTERPOLATION, note_period as note_period, set_interpolation as set_interpolation,
    )
    from drivers.cia402.description import Description as Description, describe as describe
    from drivers.cia402.drive import Cia402Drive as Cia402Drive, DRIVE_SILENT_S as DRIVE_SILENT_S
    from drivers.cia402.limits import check_parameters as check_parameters
    from drivers.cia402.mapping import (
        CyclicLayout as CyclicLayout, Mapped as Mapped, angle_object as angle_object, mapped_object as mapped_object,
        mapping_entry as mapping_entry, read_entries as read_entries, with_angle as with_angle,
        write_entries as write_entries,
    )
    from drivers.cia402.objects import Objects as Objects, name as name
    from drivers.cia402.polling import ANSWER_S as ANSWER_S, answer_time_s as answer_time_s
    from drivers.cia402.preflight import find_units as find_units
    from drivers.cia402.process_data import (
        CONTROLWORD as CONTROLWORD, CyclicObjects as CyclicObjects, MODE as MODE, MODE_DISPLAY as MODE_DISPLAY,
        STATUSWORD as STATUSWORD, TARGET_TORQUE as TARGET_TORQUE, TORQUE_DEMAND as TORQUE_DEMAND, bits_of as bits_of,
        cyclic_objects as cyclic_objects,
    )
    from drivers.cia402.quick_stop import Cia402Target as Cia402Target
    from drivers.cia402.sdo_client import SdoClient as SdoClient
    from drivers.cia402.sdo_message import (
        download as download, is_answer as is_answer, upload as upload, uploaded as uploaded,
    )
    from drivers.cia402.state_machine import (
        FAULT_BIT as FAULT_BIT, QUICK_STOP as QUICK_STOP, State as State, decode as decode,
    )
    from drivers.cia402.supervision import DriveWatch as DriveWatch, Group as Group
    from drivers.cia402.watchdog import arm as arm
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "bus": "Cia402Bus CycleInputs CycleSetpoints FeedbackSetting Traffic",
        "cycle_period": "INTERPOLATION note_period set_interpolation",
        "description": "Description describe",
        "drive": "Cia402Drive DRIVE_SILENT_S",
        "limits": "check_parameters",
        "mapping": "CyclicLayout Mapped angle_object mapped_object mapping_entry read_entries with_angle "
                   "write_entries",
        "objects": "Objects name",
        "polling": "ANSWER_S answer_time_s",
        "preflight": "find_units",
        "process_data": "CONTROLWORD CyclicObjects MODE MODE_DISPLAY STATUSWORD TARGET_TORQUE TORQUE_DEMAND bits_of "
                        "cyclic_objects",
        "quick_stop": "Cia402Target",
        "sdo_client": "SdoClient",
        "sdo_message": "download is_answer upload uploaded",
        "state_machine": "FAULT_BIT QUICK_STOP State decode",
        "supervision": "DriveWatch Group",
        "watchdog": "arm",
    })
