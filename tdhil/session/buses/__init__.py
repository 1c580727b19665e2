"""What is particular to CANopen and to Modbus in reaching a drive: where it is, and how it is opened."""

from typing import TYPE_CHECKING

from profiles import lazy_face

if TYPE_CHECKING:
    from tdhil.session.buses.can_bus import (
        BusConfig as BusConfig, bus_config as bus_config, link_report as link_report, open_bus as open_bus,
    )
    from tdhil.session.buses.canopen import (
        open_can as open_can, rated_torque_nm as rated_torque_nm,
    )
    from tdhil.session.buses.modbus import (
        SettingsRefused as SettingsRefused, open_line as open_line,
        open_wire as open_wire,
    )
    from tdhil.session.buses.modbus_line import (
        ModbusConfig as ModbusConfig, asked_for as asked_for, modbus_config as modbus_config,
    )
else:
    __getattr__, __dir__ = lazy_face(
        __name__,
        {
            "can_bus": ("BusConfig", "bus_config", "link_report", "open_bus"),
            "canopen": ("open_can", "rated_torque_nm"),
            "modbus": ("SettingsRefused", "open_line", "open_wire"),
            "modbus_line": ("ModbusConfig", "asked_for", "modbus_config"),
        },
    )
