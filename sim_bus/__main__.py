"""``python -m sim_bus canopen …``: a simulated drive in a process of its own."""

import sys

from sim_bus.command import add_arguments, main, run

__all__ = ["add_arguments", "main", "run"]

if __name__ == "__main__":
    sys.exit(main())
