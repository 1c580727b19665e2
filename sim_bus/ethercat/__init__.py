"""EtherCAT interface of the simulated drive: slave controller, CoE, process data. A test tool, not a product slave."""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from sim_bus.ethercat.command import add_arguments as add_arguments, run as run
    from sim_bus.ethercat.faults import listed as listed, listing as listing, parse_all as parse_all
    from sim_bus.ethercat.simulator import Simulator as Simulator, raw_socket as raw_socket
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "command": "add_arguments run", "faults": "listed listing parse_all", "simulator": "Simulator raw_socket",
    })
