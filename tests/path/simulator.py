"""`python -m sim_bus` with changes for tests: ``simulator.py patient,real canopen …``

patient   wait for a host that is silent for less than a minute of wall time, because the runs must be reproducible on
          a loaded computer. The end of a connection still acts at once.
real      without the simulator's marker object or registers, so that the host cannot distinguish it from a real drive.
"""

import functools
import sys

from profiles.simulator_marker import MARKER_INDEX, MARKER_REGISTER, MARKER_STAGE_REGISTER
from sim_bus import command
from sim_bus.canopen import node, simulator
from sim_bus.modbus import registers


def be_patient() -> None:
    simulator.Simulator = functools.partial(simulator.Simulator, silence_s=60.0)  # type: ignore[assignment,misc]


def be_real() -> None:
    plain = node.Cia402Node.__init__

    def without_marker(self, *arguments, **options):
        plain(self, *arguments, **options)
        del self.store.object_dictionary[MARKER_INDEX]

    node.Cia402Node.__init__ = without_marker
    plain_map = registers.Map.__init__

    def without_registers(self, *arguments, **options):
        plain_map(self, *arguments, **options)
        marker = range(MARKER_REGISTER, MARKER_STAGE_REGISTER)
        self.slots = {key: slot for key, slot in self.slots.items() if key[1] not in marker}

    registers.Map.__init__ = without_registers      # type: ignore[method-assign]


if __name__ == "__main__":
    for change in sys.argv[1].split(","):
        {"patient": be_patient, "real": be_real}[change]()
    sys.exit(command.main(sys.argv[2:]))
