"""CiA 402 drives on EtherCAT: CoE, process data, AL states and the watchdog of the slave controller."""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from drivers.ethercat.drive import EthercatDrive as EthercatDrive
    from drivers.ethercat.quick_stop import EthercatTarget as EthercatTarget, open_target as open_target
    from drivers.ethercat.scan import (
        FoundSlave as FoundSlave, found_slave as found_slave, objects_of as objects_of, stations_at as stations_at,
    )
    from drivers.ethercat.segment import EthercatSegment as EthercatSegment, open_segment as open_segment
    from drivers.ethercat.station import Station as Station, has_clocks as has_clocks, station_of as station_of
    from drivers.ethercat.supervision import watchdog_s as watchdog_s
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "drive": "EthercatDrive",
        "quick_stop": "EthercatTarget open_target",
        "scan": "FoundSlave found_slave objects_of stations_at",
        "segment": "EthercatSegment open_segment",
        "station": "Station has_clocks station_of",
        "supervision": "watchdog_s",
    })
