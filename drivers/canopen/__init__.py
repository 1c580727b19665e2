"""CiA 402 drives on CANopen: state machine, objects, I/O."""

from typing import TYPE_CHECKING

from profiles import lazy_face

if TYPE_CHECKING:
    from drivers.canopen.bus import CanLink as CanLink
    from drivers.canopen.drive import Cia402Drive as Cia402Drive
    from drivers.canopen.limits import check_parameters as check_parameters
    from drivers.canopen.preflight import find_units as find_units
    from drivers.canopen.quick_stop import Cia402Target as Cia402Target
    from drivers.canopen.sdo import Objects as Objects, name as name
    from drivers.canopen.state_machine import State as State, decode as decode
else:
    __getattr__, __dir__ = lazy_face(__name__)
