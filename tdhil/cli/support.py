"""`tdhil support run.mcap`: one archive for a support case, without data that identify its sender."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
import zipfile
from collections.abc import Iterable
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

from tdhil.buses import all_buses
from tdhil.cli.arguments import require_log
from tdhil.errors import ExitCode, LogError, MessageCode, UsageError, existing_file
from tdhil.evidence import Scrub
from tdhil.new_file import whole_or_none
from tdhil.version import __version__

LIBRARIES = (
    "numpy", "scipy", "pyserial", "mcap", "protobuf", "pydantic", "rich", "PyYAML", "matplotlib", "jinja2",
)
"""Libraries whose version is included, beside those of the buses."""
VARIABLES = (
    "LANG", "LC_ALL", "LC_CTYPE", "TERM", "PYTHONIOENCODING", "PYTHONUTF8", "OPENBLAS_CORETYPE",
    "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS",
)
"""Environment variables that are included, beside those of the buses; all others are private."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of support."""
    parser.add_argument("log", type=Path, metavar="run.mcap", help="the log of the run")
    parser.add_argument("--rig", type=Path, metavar="rig.yaml", help="its rig.yaml, with comments")
    parser.add_argument("-o", "--output", type=Path, metavar="support.zip",
                        help="default: beside the log; no file is overwritten")
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Write the archive. Exit 0: complete; 3: the log is partly or not readable. Raises UsageError."""
    log: Path = namespace.log
    target: Path = namespace.output or log.with_name(f"{log.stem}.support.zip")
    require_log(log)
    if namespace.rig is not None and not namespace.rig.is_file():
        raise UsageError("this file does not exist", where=f"--rig {namespace.rig}", entry=MessageCode.FILE_NOT_FOUND)
    scrub = Scrub.of_this_computer()
    whole = True
    try:
        with (whole_or_none(target), target.open("xb") as file,
              zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive):
            for name, text in about(log):
                archive.writestr(name, scrub.text(text))
            if namespace.rig is not None:
                archive.writestr("rig.yaml", scrub.text(namespace.rig.read_text("utf-8", errors="replace")))
            whole = _add_log(archive, log, scrub)
            names = archive.namelist()
    except FileExistsError:
        raise existing_file(target) from None
    except OSError as error:
        raise UsageError(f"can't be written ({error.strerror or error})", where=str(target),
                         entry=MessageCode.FILE_NOT_WRITABLE) from error
    print(f"{target}: {', '.join(names)}")  # noqa: T201
    print("Names of users, of this computer and of folders, and possible secrets, were removed. "  # noqa: T201
          "Check it before you send it.", file=sys.stderr)
    return int(ExitCode.OK if whole else ExitCode.PARTIAL)


def about(log: Path) -> Iterable[tuple[str, str]]:
    """Yield (name in the archive, text) of everything except the log and rig.yaml, before scrubbing."""
    from tdhil.cli.doctor import host_findings

    yield "versions.json", _json(versions())
    yield "doctor.txt", "".join(f"{one.text}\n" for one in host_findings(log))


def versions() -> dict[str, Any]:
    """Return the versions, and the few environment variables that change tdhil's behaviour."""
    found: dict[str, str | None] = {}
    buses = all_buses()
    variables = (*VARIABLES, *(name for bus in buses for name in bus.variables))
    for name in (*LIBRARIES, *(name for bus in buses for name in bus.libraries)):
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return {
        "tdhil": __version__,
        "python": platform.python_version(),
        "implementation": platform.python_implementation(),
        "system": platform.system(),
        "release": platform.release(),
        "machine": platform.machine(),
        "processors": os.cpu_count(),
        "libraries": found,
        "environment": {name: os.environ[name] for name in variables if name in os.environ},
    }


def _add_log(archive: zipfile.ZipFile, log: Path, scrub: Scrub) -> bool:
    """Add the log with scrubbed texts, and its content as readable files."""
    from tdhil.cli.recover import report
    from tdhil.recording import examine, write_copy

    try:
        found = examine(log)
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(folder) / "run.mcap"
            write_copy(log, copy, found, edit=scrub.message)
            archive.write(copy, "run.mcap")
    except LogError as error:
        archive.writestr("log.txt", scrub.text(f"{log.name} is not in this archive: {error}\n"))
        return False
    run = found.run
    summary = report(found, Path(log.name), None)
    archive.writestr("log.json", _json(scrub.value({**summary, "size_bytes": log.stat().st_size})))
    events = "".join(f"{one.time_s:.3f}  {one.kind}  {one.text}\n{one.traceback}" for one in run.events)
    archive.writestr("events.txt", scrub.text(events))
    configuration = dict(run.configuration)
    for name in ("profile", "bench"):
        if (part := configuration.pop(name, None)) is not None:
            archive.writestr(f"{name}.json", _json(scrub.value(part)))
    archive.writestr("configuration.json", _json(scrub.value(configuration)))
    return found.whole


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, indent=2) + "\n"
