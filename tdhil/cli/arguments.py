"""Command line options that say which drive is meant and where it is: the same for every command that talks to one.

None as a default means: rig.yaml, else the profile, else the built-in default (`tdhil.config.options`).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from profiles import quantities
from profiles.quantities import SHARE, Unit
from tdhil.config import BUSES

# ---------------------------------------------------------------------------------------------------------------------
# Quantities as people type them on the command line: 1%, 0.01, 5min, 40rpm. `profiles.quantities` has the units.


def amount(unit: Unit) -> Callable[[str], float]:
    """For argparse: a number in ``unit``, or with any unit of the same kind, in ``unit``."""

    def read(text: str) -> float:
        try:
            return quantities.read(text, unit)
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"{text[:60]!r}: {error}") from None

    return read


share = amount(SHARE)
"""``1%`` or ``0.01``."""


# ---------------------------------------------------------------------------------------------------------------------

def add_drive_arguments(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """Which drive; the group, for what a command has to add to it."""
    drive = parser.add_argument_group("drive")
    drive.add_argument("--drive", choices=tuple(BUSES),
                       help="how the drive is spoken to (default: as the profile is, else canopen)")
    drive.add_argument("--profile", metavar="NAME",
                       help="vendor/model, or a .yaml file (default generic/cia402, generic/modbus)")
    drive.add_argument("--rig", type=Path, metavar="rig.yaml", help="the bench; needed to move anything real")
    drive.add_argument("--node", type=int, metavar="N", help="CANopen node number (default: the profile's)")
    return drive


def add_line_arguments(parser: argparse.ArgumentParser) -> None:
    """Where it is: a Modbus line, or a CAN bus with python-can's own options."""
    from can.cli import add_bus_arguments

    from profiles.quantities import BIT_RATE

    modbus = parser.add_argument_group("Modbus (what is left out is as the profile says)")
    modbus.add_argument("--host", metavar="NAME", help="Modbus TCP: name or address of the drive")
    modbus.add_argument("--port", type=int, metavar="N", help="TCP port (default 502)")
    modbus.add_argument("--serial", metavar="DEVICE", help="Modbus RTU: serial device, such as /dev/ttyUSB0")
    modbus.add_argument("--baud", type=int, metavar="N", help="bit/s of the serial line")
    modbus.add_argument("--parity", choices=("N", "E", "O"), help="none, even or odd")
    modbus.add_argument("--stop-bits", type=int, choices=(1, 2), help="of the serial line")
    modbus.add_argument("--unit", type=int, metavar="N", help="unit (slave) number of the drive")
    add_bus_arguments(parser, group_title="CAN bus (python-can's own options)")
    bit_rate = amount(BIT_RATE)
    for action in parser._actions:  # python-can's take no 500k
        if action.dest in ("bitrate", "data_bitrate"):
            action.type = lambda text: int(bit_rate(text))
