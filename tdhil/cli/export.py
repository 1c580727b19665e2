"""`tdhil export`: the CAN frames of a log for CAN tools, or its samples as a table."""

from __future__ import annotations

import argparse
import shutil
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final

from tdhil.cli.arguments import require_log
from tdhil.errors import ExitCode, LogError, MessageCode, NothingRecoverable, UsageError, existing_file
from tdhil.new_file import whole_or_none

if TYPE_CHECKING:
    from drivers import RawFrame

SUFFIXES: Final = {"candump": ".log", "asc": ".asc", "csv": ".csv", "parquet": ".parquet"}
_CAN_ONLY: Final = ("candump", "asc")
_LARGEST_STANDARD: Final = 0x7FF


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of export."""
    parser.add_argument("log", type=Path, metavar="run.mcap", help="log of a run, complete or cut short")
    parser.add_argument("--to", required=True, choices=tuple(SUFFIXES), help="candump and asc: the raw CAN frames, as "
                        "can-utils and CANalyzer read them; csv and parquet: every sample with its command, SI units")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="default: the log's name with another ending")
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Export. Exit 0: everything; 3: the log is not complete, and its readable part was written; 10: nothing is
    readable.
    """
    from tdhil.recording import read_run, write_samples
    from tdhil.report import SIMULATED, stderr_console

    path: Path = namespace.log
    target: Path = namespace.output or path.with_suffix(SUFFIXES[namespace.to])
    require_log(path)
    if target.exists():
        raise existing_file(target)
    if namespace.to == "parquet":
        _duckdb()
    try:
        found = read_run(path)
        with whole_or_none(target):
            if namespace.to in _CAN_ONLY:
                written = _write_frames(namespace.to, path, target, found.epoch_ns)
            else:
                write = write_samples if namespace.to == "csv" else _write_parquet
                written = write(path, target, int(found.recording.simulated))
    except LogError as error:
        raise NothingRecoverable(error.what, where=error.where, next_step=error.next_step) from error
    except OSError as error:
        raise UsageError(f"can't be written ({error.strerror or error})", where=str(target),
                         entry=MessageCode.FILE_NOT_WRITABLE) from error
    console = stderr_console()
    for problem in found.problems:
        console.print(f"tdhil: {path}: {problem}", style="yellow", markup=False, soft_wrap=True)
    what = "CAN frames" if namespace.to in _CAN_ONLY else "samples"
    simulated = f"{SIMULATED}: " if found.recording.simulated else ""
    console.print(f"{simulated}{target}: {written} {what}", markup=False, soft_wrap=True)
    return int(ExitCode.OK if found.complete else ExitCode.PARTIAL)


def _write_frames(to: str, path: Path, target: Path, epoch_ns: int) -> int:
    """Write frames with python-can's own writers. Raises UsageError if the log has no CAN frames."""
    import can

    from tdhil.buses import bus_named
    from tdhil.config import BUSES
    from tdhil.recording import CAN, CHANNELS, read_frames, read_run

    bus = read_run(path).configuration.get("drive")
    # older logs have Modbus bytes on the topic of CAN frames
    frames = read_frames(path) if bus not in BUSES or bus_named(bus).frame_topic == CHANNELS[CAN][0] else iter(())
    first = next(frames, None)
    if first is None:
        raise UsageError("contains no CAN frames, for example because the run was on Modbus", where=str(path),
                         next_step="Export its samples with --to csv", entry=MessageCode.WRONG_KIND_OF_FILE)
    count = 0
    writer: Any = can.ASCWriter(target) if to == "asc" else can.CanutilsLogWriter(target, channel="can0")
    with writer:
        frame: RawFrame | None = first
        while frame is not None:
            writer.on_message_received(can.Message(
                timestamp=epoch_ns / 1e9 + frame.time_s, arbitration_id=frame.identifier, data=frame.data,
                is_extended_id=frame.identifier > _LARGEST_STANDARD, is_rx=not frame.outgoing, check=False,
            ))
            count += 1
            frame = next(frames, None)
    return count


def _write_parquet(path: Path, target: Path, simulated: int) -> int:
    """Write the same table, typed; DuckDB keeps all bits of its numbers."""
    from tdhil.recording import SAMPLE_COLUMNS, write_samples

    texts, counts = {"mode", "state"}, {"status", "fresh", "limit_active", "standstill", "simulated"}
    typed = ", ".join(
        f"{name}: '{'VARCHAR' if name in texts else 'BIGINT' if name in counts else 'DOUBLE'}'"
        for name in SAMPLE_COLUMNS
    )
    with TemporaryDirectory(prefix="tdhil-export-") as folder, closing(_duckdb().connect()) as base:
        table = Path(folder) / "samples.csv"
        count = write_samples(path, table, simulated)
        whole, quoted = Path(folder) / "samples.parquet", folder.replace("'", "''")
        base.execute(f"COPY (SELECT * FROM read_csv('{quoted}/samples.csv', header=true, columns={{{typed}}})) "
                     f"TO '{quoted}/samples.parquet' (FORMAT parquet)")
        with whole.open("rb") as source, target.open("xb") as file:
            shutil.copyfileobj(source, file)
    return count


def _duckdb() -> Any:
    from tdhil.fleet import load_duckdb

    return load_duckdb("--to parquet", "use --to csv")
