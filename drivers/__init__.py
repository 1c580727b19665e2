"""Drives and their buses. This room knows nothing of tests, logs or estimation."""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from drivers.angle import Unwrapped as Unwrapped
    from drivers.clock import (
        Clock as Clock, LOWER_THE_RATE as LOWER_THE_RATE, MonotonicClock as MonotonicClock,
        SWITCH_S as SWITCH_S, SteppedClock as SteppedClock, quantile as quantile,
    )
    from drivers.drive import (
        Check as Check, Command as Command, Counters as Counters, Drive as Drive, DriveLimits as DriveLimits,
        FrameTap as FrameTap, Identity as Identity, KeptAlive as KeptAlive, Mode as Mode, Outcome as Outcome,
        Paced as Paced, Polled as Polled, PositionReading as PositionReading, Positioned as Positioned,
        PowerState as PowerState, Preflight as Preflight, RawFrame as RawFrame, Rehearsed as Rehearsed,
        RemovesTorque as RemovesTorque, ReportingFilters as ReportingFilters, ReportsOthers as ReportsOthers,
        Sample as Sample, StopsFeeding as StopsFeeding, Timed as Timed,
    )
    from drivers.errors import (
        CommandRejected as CommandRejected, CommunicationLost as CommunicationLost, DataFileError as DataFileError,
        DriveFault as DriveFault, LimitHit as LimitHit, ModeNotConfirmed as ModeNotConfirmed,
        ObjectRefused as ObjectRefused, PreflightRefused as PreflightRefused, Problem as Problem,
        ReportsContradict as ReportsContradict, SensorFault as SensorFault, StopNotConfirmed as StopNotConfirmed,
        TdhilError as TdhilError,
    )
    from drivers.preflight import (
        ACCEPTED_BY as ACCEPTED_BY, ANY_CLIENT as ANY_CLIENT, NOTHING_STOPS_IT as NOTHING_STOPS_IT,
        NO_WATCHDOG_FLAG as NO_WATCHDOG_FLAG, SHARED_FLAG as SHARED_FLAG, PreflightTable as PreflightTable,
    )
    from drivers.quick_stop import (
        LONGEST_STOP_S as LONGEST_STOP_S, BareStopReport as BareStopReport, Ended as Ended, Target as Target,
        bare_stop as bare_stop,
    )
    from drivers.standstill import (
        STANDSTILL_ANGLE_RAD_S as STANDSTILL_ANGLE_RAD_S, STANDSTILL_RAD_S as STANDSTILL_RAD_S,
    )
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "angle": "Unwrapped",
        "clock": "Clock LOWER_THE_RATE MonotonicClock SWITCH_S SteppedClock quantile",
        "drive": "Check Command Counters Drive DriveLimits FrameTap Identity KeptAlive Mode Outcome Paced Polled "
                 "PositionReading Positioned PowerState Preflight RawFrame Rehearsed RemovesTorque ReportingFilters "
                 "ReportsOthers Sample StopsFeeding Timed",
        "errors": "CommandRejected CommunicationLost DataFileError DriveFault LimitHit ModeNotConfirmed ObjectRefused "
                  "PreflightRefused Problem ReportsContradict SensorFault StopNotConfirmed TdhilError",
        "preflight": "ACCEPTED_BY ANY_CLIENT NOTHING_STOPS_IT NO_WATCHDOG_FLAG SHARED_FLAG PreflightTable",
        "quick_stop": "LONGEST_STOP_S BareStopReport Ended Target bare_stop",
        "standstill": "STANDSTILL_ANGLE_RAD_S STANDSTILL_RAD_S",
    })
