"""`tdhil stop`: a best-effort quick stop from outside of any run. It is no emergency stop, and says so."""

from __future__ import annotations

import argparse
import json
import sys
from typing import TYPE_CHECKING

from tdhil.errors import ExitCode, UsageError, exit_code

if TYPE_CHECKING:
    from drivers import BareStopReport

NO_EMERGENCY_STOP = (
    "tdhil stop is NO emergency stop: it needs this computer, the cable and the drive. "
    "Keep the hard-wired one within reach."
)

NOT_CONFIRMED = "STOP NOT CONFIRMED: use the hard-wired emergency stop now."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The bus or line, as for identify."""
    from tdhil.cli.arguments import add_drive_arguments, add_line_arguments, add_option
    from tdhil.config import OPTION

    add_drive_arguments(parser)
    add_option(parser, OPTION["json"])
    add_line_arguments(parser)
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """0 at rest, 8 wherever that wasn't seen: still turning, no answer, no way to the drive.

    Ctrl-C ends the watching only: what was asked for stays asked for.
    """
    from drivers import MonotonicClock, bare_stop
    from tdhil.config import load_rig, resolve
    from tdhil.session import connection_of

    rig = load_rig(namespace.rig) if namespace.rig else None
    options, connection = connection_of(vars(namespace), rig, resolve(vars(namespace), rig))
    if not connection.configured:
        raise UsageError(
            connection.nothing_there,
            where="stop",
            next_step="Say where the drive is, such as -i socketcan -c can0 --node 1, or --host 192.0.2.10",
        )
    print(NO_EMERGENCY_STOP, file=sys.stderr)  # noqa: T201
    clock = MonotonicClock()
    try:
        with connection.kind.open_target(options, connection, clock) as target:
            report = bare_stop(target, clock)
    except Exception as error:         # no way to the drive, or none any more; an adapter's driver raises what it likes
        if exit_code(error) is ExitCode.USAGE:
            raise
        return _not_reached(error, as_json=namespace.json is True)
    except KeyboardInterrupt:
        print(NOT_CONFIRMED, file=sys.stderr)  # noqa: T201
        raise
    code = _exit_code(report)
    if namespace.json is True:
        print(json.dumps(_document(report, code), ensure_ascii=False, indent=2))  # noqa: T201
    else:
        for line in said(report):
            print(line)  # noqa: T201
    return int(code)


def _not_reached(error: Exception, *, as_json: bool) -> int:
    """Whoever asks for a stop must not read a mere connection error."""
    code = ExitCode.STOP_NOT_CONFIRMED
    if as_json:
        document = {"ended": "not reached", "error": str(error), "remarks": [], "said": NOT_CONFIRMED,
                    "emergency_stop": False, "exit_code": int(code)}
        print(json.dumps(document, ensure_ascii=False, indent=2))  # noqa: T201
    print(f"tdhil: {error}", file=sys.stderr)  # noqa: T201
    print(NOT_CONFIRMED, file=sys.stderr if as_json else sys.stdout)
    return int(code)


def _exit_code(report: BareStopReport) -> ExitCode:
    from drivers import Ended

    return {
        Ended.AT_REST: ExitCode.OK,
        Ended.TURNING: ExitCode.STOP_NOT_CONFIRMED,
        Ended.NO_ANSWER: ExitCode.STOP_NOT_CONFIRMED,
    }[report.ended]


def said(report: BareStopReport) -> list[str]:
    """What was seen, a line each; the last one is the verdict."""
    from drivers import Ended

    lines = []
    if report.first is not None and report.last is not None:
        for when, seen in (("at first", report.first), (f"after {report.took_s:.1f} s", report.last)):
            lines.append(f"{when}: {seen.text}, {seen.speed:.3g} {seen.unit}")
    lines += [f"! {remark}" for remark in report.remarks]
    verdict = {
        Ended.AT_REST: f"The shaft is at rest. {_holds(report)}",
        Ended.TURNING: f"The shaft was NOT seen at rest. {NOT_CONFIRMED}",
        Ended.NO_ANSWER: f"NO ANSWER: whether the shaft turns is not known. {NOT_CONFIRMED}",
    }[report.ended]
    return [*lines, verdict]


def _holds(report: BareStopReport) -> str:
    from drivers import PowerState

    if report.last is not None and report.last.state in (PowerState.OFF, PowerState.READY, PowerState.FAULT):
        return "The drive's torque is off: nothing but a brake holds it."
    return "The drive was not disabled: it may be holding it."


def _document(report: BareStopReport, code: ExitCode) -> dict[str, object]:
    first, last = (
        None if seen is None else {"state": seen.text, "speed": seen.speed, "unit": seen.unit}
        for seen in (report.first, report.last)
    )
    return {
        "ended": report.ended.value,
        "first": first,
        "last": last,
        "took_s": report.took_s,
        "asked": report.asked,
        "remarks": list(report.remarks),
        "said": "" if code is ExitCode.OK else NOT_CONFIRMED,
        "emergency_stop": False,
        "exit_code": int(code),
    }
