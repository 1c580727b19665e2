"""`tdhil simulate canopen …`: the simulated rig as a process of its own; the same as `python -m sim_bus`."""

from __future__ import annotations

import argparse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to pretend to be, and the simulator's own options."""
    from sim_bus.__main__ import add_arguments as add_simulator_arguments
    from sim_bus.__main__ import run

    parser.add_argument("kind", choices=("canopen",), help="the bus on which the drive is simulated")
    add_simulator_arguments(parser)
    parser.set_defaults(run=run)
