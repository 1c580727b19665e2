"""`tdhil identify --calibrate`: a run without a body, a prompt to mount the body, a run with it, and the
calibration.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path

from profiles.quantities import INERTIA
from tdhil.cli.arguments import amount, hide_rare, require_inertia
from tdhil.config import OPTION, load_rig, resolve
from tdhil.errors import ExitCode, UsageError, existing_file

_EXAMPLE = "tdhil identify --calibrate --added 55"
Run = Callable[[argparse.Namespace, list[Path]], int]
"""One run with its own confirmation: it appends the path of its log, and returns the exit code."""


def add_calibrate_arguments(section: argparse._ActionsContainer) -> None:
    """Add the options of a calibration by two runs."""
    hide_rare(
        section.add_argument("--calibrate", action="store_true",
                             help="calibrate the torque: a run without the body, then a run with the body of --added"),
        section.add_argument("--added", type=amount(INERTIA), metavar="J",
                             help="with --calibrate: inertia of the body at the motor shaft, kg·m²"),
        section.add_argument("--added-sd", type=amount(INERTIA), metavar="SD",
                             help="its standard uncertainty, kg·m² (default 0.2 %% of it, assumed)"))


def check_calibrate(namespace: argparse.Namespace) -> None:
    """Raise UsageError for options that do not go together."""
    for flag, value in (("--added", namespace.added), ("--added-sd", namespace.added_sd)):
        if value is not None and not namespace.calibrate:
            raise UsageError("is for a calibration", where=flag, next_step=f"Such as: {_EXAMPLE}")
        require_inertia(flag, value, zero=flag == "--added-sd")
    if not namespace.calibrate:
        return
    if namespace.added is None:
        raise UsageError("needs the inertia of the body", where="--calibrate", next_step=f"Such as: {_EXAMPLE}")
    for flag, given in (("--dry-run", namespace.dry_run), (OPTION["json"].flag, namespace.json),
                        ("--report", namespace.report is not None), (OPTION["trace"].flag, namespace.trace is not None),
                        (OPTION["fault"].flag, bool(namespace.fault)), (OPTION["expect"].flag, bool(namespace.expect))):
        if given:
            raise UsageError("does not go with --calibrate", where=flag, next_step="Run both runs one by one, then:"
                             " tdhil calibrate torque without.mcap with.mcap --added J")


def run_calibration(namespace: argparse.Namespace, run: Run) -> int:
    """Do both runs and the calibration. Return the exit code of the first failed step, or 0.

    While the operator mounts the body, the drive is disabled and its bus is closed. Raises UsageError before any
    motion, and PreflightRefused if the body was not confirmed.
    """
    from tdhil.cli.calibrate import calibrate_two
    from tdhil.report import stderr_console
    from tdhil.session import check_log_path, confirm_mounted, connection_of, plan_peer, require_terminal

    rig = load_rig(namespace.rig) if namespace.rig else None
    options, connection = connection_of(vars(namespace), rig, resolve(vars(namespace), rig))
    peer = plan_peer(options, connection)
    first = Path(options.log)
    second = first.with_name(f"{first.stem}-with-body{first.suffix}")
    saved = first.with_name(f"{first.stem}-calibration.json")
    check_log_path(second, OPTION["log"].flag)
    if saved.exists():
        raise existing_file(saved)
    if options.json or options.trace is not None:
        raise UsageError("does not go with --calibrate", where=options.source("json" if options.json else "trace"))
    if not peer.embedded:
        require_terminal("that the body is mounted")
    console = stderr_console()
    logs: list[Path] = []

    def step(number: int, text: str) -> None:
        console.print(f"calibration, step {number} of 4: {text}", style="bold", markup=False, soft_wrap=True)

    step(1, "run without the body")
    if code := run(namespace, logs):
        return code
    body = f"body of {namespace.added:g} kg·m²"
    again = argparse.Namespace(**vars(namespace))
    again.log = str(second)
    if peer.embedded:
        step(2, f"{body} mounted on the simulated shaft")
        mounted = peer.plant.plant.added_inertia_kg_m2
        again.simulated_added_inertia_kg_m2 = mounted + namespace.added
        if options.seed is not None:
            again.seed = options.seed + 1
    else:
        step(2, f"mount the {body}")
        confirm_mounted(console, f"tdhil calibrate torque {logs[0]} with.mcap --added {namespace.added:g}")
    step(3, "run with the body")
    if code := run(again, logs):
        return code
    step(4, "calibration")
    code = calibrate_two(logs[0], logs[1], namespace.added, namespace.added_sd, saved)
    if code == ExitCode.OK:
        named = saved if rig is None else Path(os.path.relpath(saved, rig.folder))     # as rig.yaml names files
        console.print(f"to use it, write in rig.yaml: drive_data: {{torque_calibration: {named.as_posix()}}}",
                      markup=False, soft_wrap=True)
    return code
