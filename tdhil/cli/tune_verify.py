"""`tdhil tune verify`: small steps of the set speed on a drive, beside the prediction of `tune speed`."""

from __future__ import annotations

import argparse
from pathlib import Path

from tdhil.cli.report_file import add_report_option

GAINS = ("tuned", "present")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of tune verify."""
    from tdhil.cli.identify import add_peer_arguments

    parser.add_argument("tuning", type=Path, metavar="tune.json", help="document of tdhil tune speed --json")
    what = parser.add_argument_group("verification")
    what.add_argument("--use", choices=GAINS, default="tuned",
                      help="gains of that file that are set in the drive now (default tuned)")
    what.add_argument("--dry-run", action="store_true",
                      help="plan the steps within the rig's limits, or report what prevents them; nothing moves")
    add_report_option(what, "verify")
    add_peer_arguments(parser)
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Read the tuning, then run like every run."""
    from tdhil.cli.identify import run_with
    from tdhil.session import load_step_case

    if "list" in (namespace.fault or ()):
        return run_with(namespace)
    return run_with(namespace, load_step_case(namespace.tuning, namespace.use))
