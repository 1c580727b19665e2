"""`tdhil tune`: gains from a result's J, for the speed loop or against stick-slip; and steps that verify them."""

from __future__ import annotations

import argparse

from tdhil.cli import tune_soft_torque, tune_speed, tune_verify
from tdhil.cli.parser import CommandParser

SOFT_TORQUE = "soft-torque"
"""Purpose of `tdhil tune result.json` without a further word."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the purposes, with their options."""
    purposes = parser.add_subparsers(dest="purpose", metavar="speed|verify|soft-torque", required=True)
    speed = purposes.add_parser(
        "speed", allow_abbrev=False, help="P, I and a notch for the drive's own speed loop",
        description="Compute P, I and a notch for the drive's own speed loop: the largest gains that keep phase margin"
        " and gain margin over the intervals of J, friction and lags. Nothing is written into a drive.")
    tune_speed.add_arguments(speed)
    verify = purposes.add_parser(
        "verify", allow_abbrev=False, help="compare small steps on the drive with the prediction of tune speed",
        description="Step the set speed of the drive up and down, and compare overshoot, rise time, settling time, P"
        " and I with the prediction of tdhil tune speed. The shaft turns: limits, guard, confirmation and stop are"
        " those of tdhil identify.")
    tune_verify.add_arguments(verify)
    string = purposes.add_parser(
        SOFT_TORQUE, allow_abbrev=False, help="a speed controller that damps the drill string",
        description="Compute a speed controller that damps the drill string. tdhil tune RESULT does the same.")
    tune_soft_torque.add_arguments(string)
    if isinstance(parser, CommandParser):
        parser.usual_action, parser.also_called = SOFT_TORQUE, {"loop": "speed", "speed-loop": "speed"}
