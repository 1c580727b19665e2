"""`tdhil stop` on the drive of one run: ``python -m tdhil.service.drive_stop CONNECTION [IDENTITY]``.

CONNECTION is the run's connection.json. So the stop goes to the drive of the run, even if the rig's file has changed.
IDENTITY is vendor, product, revision and serial number of the run's drive, with commas between. It is a process of its
own, because the web opens no bus. It prints one JSON object; the exit code is 0 at standstill of that drive, else 8.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from drivers import BareStopReport, Ended, MonotonicClock, bare_stop
from tdhil.errors import ExitCode, TdhilError
from tdhil.service.store import read_json


def stop(path: Path, identity: tuple[int, ...]) -> dict[str, Any]:
    """Stop the drive first, then read its identity. Raises nothing: a failure is in the key ``error``."""
    from tdhil.session import connection_of_kept

    clock = MonotonicClock()
    report: BareStopReport | None = None
    found, error = "", ""
    same = True
    try:
        options, connection = connection_of_kept(read_json(path) or {})
        with connection.bus.open_target(options, connection, clock) as target:
            report = bare_stop(target, clock)
            if any(identity) and (read := getattr(target, "identity", None)) is not None:
                now = read()
                there = (now.vendor, now.product, now.revision, now.serial)
                same, found = there == identity, ", ".join(map(str, there))
    except Exception as failed:        # an adapter's driver may raise anything
        error = str(failed) if isinstance(failed, TdhilError) else f"{type(failed).__name__}: {failed}"
    at_rest = report is not None and report.ended is Ended.AT_REST
    ended = "not reached" if report is None else report.ended.value
    return {"at_rest": at_rest, "same_drive": same, "identity": found, "ended": ended, "error": error}


def main(arguments: list[str]) -> int:
    """Stop the drive that the arguments name. Return the exit code."""
    identity = tuple(int(one) for one in arguments[1].split(",")) if len(arguments) > 1 else ()
    found = stop(Path(arguments[0]), identity)
    print(json.dumps(found, ensure_ascii=False))  # noqa: T201
    return int(ExitCode.OK if found["at_rest"] and found["same_drive"] else ExitCode.STOP_NOT_CONFIRMED)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
