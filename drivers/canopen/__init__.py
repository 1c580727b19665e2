"""CiA 402 drives on CANopen: SDO, PDO, NMT, heartbeat and node guarding."""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from drivers.canopen.bus import CanLink as CanLink
    from drivers.canopen.drive import CanopenDrive as CanopenDrive
    from drivers.canopen.quick_stop import CanopenTarget as CanopenTarget
    from drivers.canopen.scan import Heard as Heard, ask_all as ask_all
    from drivers.canopen.sdo import SdoObjects as SdoObjects
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "bus": "CanLink",
        "drive": "CanopenDrive",
        "quick_stop": "CanopenTarget",
        "scan": "Heard ask_all",
        "sdo": "SdoObjects",
    })
