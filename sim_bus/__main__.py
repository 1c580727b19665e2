"""``python -m sim_bus canopen …``, ``python -m sim_bus modbus …``: a simulated drive in a process of its own."""

import sys

from sim_bus.command import main

if __name__ == "__main__":
    sys.exit(main())
