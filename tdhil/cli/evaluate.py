"""`tdhil evaluate`: a virtual drill string on a real drive, with a controller from `tune`."""

from __future__ import annotations

import argparse
from pathlib import Path

from tdhil.cli.report_file import add_report_option

CONTROLLERS = ("soft", "stiff", "compensated", "broadband")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of evaluate."""
    from tdhil.cli.identify import add_peer_arguments

    what = parser.add_argument_group("evaluation")
    what.add_argument("--virtual-string", type=Path, required=True, metavar="string.yaml",
                      help="drill string, bottom and bit (docs/reference/string.md), simulated in this host")
    what.add_argument("--controller", type=Path, required=True, metavar="tune.json",
                      help="result of tdhil tune --json for that string; its speed controller runs in this host")
    what.add_argument("--use", choices=CONTROLLERS, default="soft", help="controller in that file (default soft)")
    what.add_argument("--own-loop", action="store_true",
                      help="use the drive's own speed loop, with these gains set in the drive; the string's torque "
                           "enters as its torque offset")
    what.add_argument("--result", type=Path, metavar="result.json",
                      help="result of tdhil identify on the present rig, if it is not the machine that was tuned for")
    what.add_argument("--dry-run", action="store_true",
                      help="plan the speed program within the rig's limits, or report what prevents it; nothing moves")
    add_report_option(what, "evaluation")
    add_peer_arguments(parser)
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Read the three files, then run as every run."""
    from tdhil.cli.identify import run_with
    from tdhil.cli.tune_inputs import calibration_factor, in_drive_torque, read_result
    from tdhil.session import evaluation_case, load_tuning
    from tdhil.soft_torque import load_string

    if "list" not in (namespace.fault or ()):
        tuning = load_tuning(namespace.controller)
        identified = tuning["identified"] if isinstance(tuning["identified"], dict) else {}
        rig = identified if namespace.result is None else read_result(namespace.result)
        case = evaluation_case(
            load_string(namespace.virtual_string), tuning, namespace.use, in_drive_torque(rig),
            str(namespace.controller), own_loop=namespace.own_loop, torque_factor=calibration_factor(rig),
        )
        return run_with(namespace, case)
    return run_with(namespace)
