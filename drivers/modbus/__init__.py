"""A drive on Modbus, over TCP or a serial line (RTU): links, the pure codec, and the `ModbusDrive`."""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from drivers.modbus.access import RegisterAccess as RegisterAccess
    from drivers.modbus.codec import from_words as from_words, settle as settle
    from drivers.modbus.drive import ModbusDrive as ModbusDrive
    from drivers.modbus.identity import read_marker as read_marker
    from drivers.modbus.link import EmbeddedLink as EmbeddedLink, Link as Link
    from drivers.modbus.parameters import (
        Parameters as Parameters, check_name_plate as check_name_plate, check_required as check_required,
        find_filters as find_filters, find_rated_torque as find_rated_torque, read_parameters as read_parameters,
    )
    from drivers.modbus.pdu import (
        BadReply as BadReply, NoReply as NoReply, READ_HOLDING as READ_HOLDING, READ_INPUT as READ_INPUT,
        read as read,
    )
    from drivers.modbus.quick_stop import ModbusTarget as ModbusTarget
    from drivers.modbus.rtu import RtuLink as RtuLink
    from drivers.modbus.scan import (
        ANSWER_S as ANSWER_S, device_identification as device_identification, probe as probe,
    )
    from drivers.modbus.state_machine import decode as decode, power_state as power_state, seen as seen
    from drivers.modbus.tcp import TcpLink as TcpLink
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "access": "RegisterAccess",
        "codec": "from_words settle",
        "drive": "ModbusDrive",
        "identity": "read_marker",
        "link": "EmbeddedLink Link",
        "parameters": "Parameters check_name_plate check_required find_filters find_rated_torque read_parameters",
        "pdu": "BadReply NoReply READ_HOLDING READ_INPUT read",
        "quick_stop": "ModbusTarget",
        "rtu": "RtuLink",
        "scan": "ANSWER_S device_identification probe",
        "state_machine": "decode power_state seen",
        "tcp": "TcpLink",
    })
