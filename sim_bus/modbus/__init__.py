"""Modbus interface of the simulated drive: a profile over the same inverter and shaft as on CANopen.

`control_words`: effect of the words, from the manuals · `codec`, `registers`: place of each number · `machine`: the
drive without its bus · `embedded`: in the host's own time · `server`: on TCP or a serial line, in real time.
"""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from sim_bus.modbus.command import add_arguments as add_arguments, run as run
    from sim_bus.modbus.embedded import EmbeddedModbusDrive as EmbeddedModbusDrive
    from sim_bus.modbus.faults import listed as listed, listing as listing, parse_all as parse_all
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "command": "add_arguments run",
        "embedded": "EmbeddedModbusDrive",
        "faults": "listed listing parse_all",
    })
