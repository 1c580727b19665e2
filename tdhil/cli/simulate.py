"""`tdhil simulate canopen …`, `tdhil simulate modbus …`: a simulated rig as a process of its own."""

from __future__ import annotations

import argparse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to pretend to be, each kind with the simulator's own options."""
    from sim_bus import add_kinds

    add_kinds(parser)
