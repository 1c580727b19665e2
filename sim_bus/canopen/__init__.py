"""CANopen interface of the simulated drive: a CiA 402 node with objects, PDOs, services, and scripted faults."""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from sim_bus.canopen.command import add_arguments as add_arguments, run as run
    from sim_bus.canopen.faults import listed as listed, listing as listing, parse_all as parse_all
    from sim_bus.canopen.inline import InlineSimulator as InlineSimulator
    from sim_bus.canopen.simulator import EmbeddedSimulator as EmbeddedSimulator, Simulator as Simulator
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "command": "add_arguments run",
        "faults": "listed listing parse_all",
        "inline": "InlineSimulator",
        "simulator": "EmbeddedSimulator Simulator",
    })
