"""EtherCAT face of the simulated drive: slave controller, CoE, process data. A test tool, not a product slave."""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from sim_bus.ethercat.slave import Cia402Slave as Cia402Slave
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {"slave": "Cia402Slave"})
