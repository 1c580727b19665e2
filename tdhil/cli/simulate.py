"""`tdhil simulate canopen …`, `tdhil simulate modbus …`: a simulated rig in its own process."""

from __future__ import annotations

import argparse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add a command for each kind of simulator, with the simulator's own options."""
    from sim_bus import add_kinds

    add_kinds(parser)
