"""Storage of rows: a journal of finished rows, and the table, whose ending selects Parquet, CSV or SQLite."""

from __future__ import annotations

import csv
import importlib
import json
import os
import shlex
import sqlite3
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, closing, suppress
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any, Final

from tdhil.csv_text import cell_of, text_of
from tdhil.errors import LogBroken, LogUnopened, MessageCode, UsageError, existing_file
from tdhil.fleet.rows import COLUMNS, FleetRow, row_from_json

_TABLE: Final = "fleet"
_DUCKDB: Final = {str: "VARCHAR", float: "DOUBLE", int: "BIGINT", bool: "BOOLEAN"}
_SQLITE: Final = {str: "TEXT", float: "REAL", int: "INTEGER", bool: "INTEGER"}


# ---------------------------------------------------------------------------------------------------------------------
# The journal: one line for each row, written at once, so that an end at any moment loses only the tasks under way


class Journal(AbstractContextManager["Journal"]):
    """Lines of JSON in a folder beside the table. One host writes it at a time. An incomplete line is ignored.

    Raises UsageError if another host has it, LogUnopened and LogBroken for errors of the disk.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / "journal.jsonl"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file: IO[bytes] = self._path.open("a+b")
        except OSError as error:
            raise LogUnopened(f"can't be opened: {error.strerror or error}", where=str(self._path),
                              next_step="Choose another --out") from error
        self._hold()
        self.rows: dict[str, FleetRow] = {}                        # by key
        self.hashes: dict[tuple[str, int, int], str] = {}          # by path, size in bytes, time of change in ns
        self._read()

    def add(self, row: FleetRow, key: str | None, stamp: tuple[int, int] | None) -> None:
        """Add a finished row. ``key``: key of the result; ``stamp``: size and time of change of its file."""
        line = json.dumps({"key": key, "stamp": stamp, "row": asdict(row)}) + "\n"
        try:
            self._file.write(line.encode())
            self._file.flush()
        except OSError as error:
            raise LogBroken(f"can't be written: {error.strerror or error}", where=str(self._path),
                            next_step="Free some space, and start again: finished results are kept") from error
        self._learn(row, key, stamp)

    def close(self) -> None:
        """Close the journal."""
        with suppress(OSError):
            self._file.close()

    def _learn(self, row: FleetRow, key: str | None, stamp: Any) -> None:
        if key is not None:
            self.rows[key] = row
        if row.sha256 is not None and isinstance(stamp, list | tuple) and len(stamp) == 2:
            self.hashes[row.log, int(stamp[0]), int(stamp[1])] = row.sha256

    def _read(self) -> None:
        self._file.seek(0)
        end = 0
        for line in self._file:
            if not line.endswith(b"\n"):
                break
            end += len(line)
            with suppress(ValueError, KeyError, TypeError, AttributeError):
                found = json.loads(line)
                self._learn(row_from_json(found["row"]), found["key"], found["stamp"])
        self._file.seek(0, os.SEEK_END)
        if self._file.tell() > end:
            self._file.truncate(end)                               # an incomplete line after a kill
            self._file.seek(0, os.SEEK_END)

    def _hold(self) -> None:
        try:
            import fcntl
        except ImportError:
            return
        try:
            fcntl.flock(self._file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._file.close()
            raise UsageError("another fleet is at work on it", where=str(self._path),
                             next_step="Wait for it, or choose another --out",
                             entry=MessageCode.FLEET_TABLE_WRONG) from None

    def __exit__(self, *_: object) -> None:
        self.close()


# ---------------------------------------------------------------------------------------------------------------------
# The table


def check_table_path(path: Path, folder: Path) -> None:
    """Check the path. Raises UsageError for an unknown ending, a missing library, or a file that isn't a fleet's."""
    _writer(path)
    if path.suffix == ".parquet":
        load_duckdb()
    if path.exists() and not folder.is_dir():
        raise existing_file(f"--out {path}", "is a file that no fleet wrote")


def write_table(rows: Sequence[FleetRow], path: Path) -> None:
    """Write all rows at once. ``path`` is replaced only when the table is complete. Raises LogBroken, UsageError."""
    write = _writer(path)
    part = path.with_name(f".{path.name}.part")
    part.unlink(missing_ok=True)
    try:
        write([{name: _plain(value) for name, value in asdict(row).items()} for row in rows], part)
        part.replace(path)
    except (OSError, sqlite3.Error) as error:
        raise LogBroken(f"the table can't be written: {error}", where=str(path),
                        next_step="Free some space, and start again: finished results are kept") from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def read_table(path: Path) -> list[FleetRow]:
    """Return the rows of a table that `write_table` wrote. Raises UsageError."""
    readers: dict[str, Callable[[Path], Iterable[Mapping[str, Any]]]] = {
        ".parquet": _read_parquet, ".csv": _read_csv, ".sqlite": _read_sqlite,
    }
    if path.suffix not in readers or not path.is_file():
        wrong = "is not a table (.parquet, .csv or .sqlite)" if path.is_file() else "this table does not exist"
        raise UsageError(wrong, where=str(path), next_step="Make one: tdhil fleet LOG LOG --out fleet.csv",
                         entry=MessageCode.FLEET_TABLE_WRONG)
    try:
        return [row_from_json({name: value for name, value in row.items() if name in COLUMNS})
                for row in readers[path.suffix](path)]
    except UsageError:
        raise
    except Exception as error:
        raise UsageError(f"is no table of a fleet: {error}", where=str(path),
                         next_step="Name one that `tdhil fleet` wrote", entry=MessageCode.FLEET_TABLE_WRONG) from error


def _writer(path: Path) -> Callable[[list[dict[str, Any]], Path], None]:
    writers = {".parquet": _write_parquet, ".csv": _write_csv, ".sqlite": _write_sqlite}
    if path.suffix not in writers:
        raise UsageError("ends neither in .parquet nor in .csv nor in .sqlite", where=f"--out {path}",
                         next_step="Such as --out fleet.csv", entry=MessageCode.VALUE_NOT_ALLOWED)
    return writers[path.suffix]


def _plain(value: Any) -> Any:
    """Replace characters of a file's name that are not UTF-8."""
    return value.encode("utf-8", "replace").decode() if isinstance(value, str) else value


def load_duckdb(where: str = "--out", otherwise: str = "end it in .csv or .sqlite") -> Any:
    """Return DuckDB, which reads and writes Parquet. Raises UsageError if it isn't installed; ``otherwise``: the
    alternative.
    """
    try:
        return importlib.import_module("duckdb")
    except ImportError as error:
        python = shlex.quote(sys.executable or "python")
        raise UsageError("Parquet needs duckdb, not installed here", where=where,
                         next_step=f"Install: {python} -m pip install 'duckdb>=1.1,<2'; or {otherwise}",
                         entry=MessageCode.PACKAGE_MISSING) from error


def _write_parquet(rows: list[dict[str, Any]], path: Path) -> None:
    columns = {name: _DUCKDB[kind] for name, kind in COLUMNS.items()}
    with tempfile.TemporaryDirectory(prefix="tdhil-fleet-") as folder, closing(load_duckdb().connect()) as base:
        lines = Path(folder) / "rows.jsonl"
        lines.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
        typed = ", ".join(f"{name}: '{kind}'" for name, kind in columns.items())
        source = f"read_json('{_quoted(lines)}', format='newline_delimited', columns={{{typed}}})"
        if not rows:
            source = "(SELECT " + ", ".join(f"NULL::{kind} AS {name}" for name, kind in columns.items()) + " LIMIT 0)"
        base.execute(f"COPY (SELECT * FROM {source}) TO '{_quoted(path)}' (FORMAT parquet)")


def _read_parquet(path: Path) -> list[dict[str, Any]]:
    with closing(load_duckdb().connect()) as base:
        found = base.execute(f"SELECT * FROM read_parquet('{_quoted(path)}')")
        names = [one[0] for one in found.description]
        return [dict(zip(names, row, strict=True)) for row in found.fetchall()]


def _quoted(path: Path) -> str:
    return str(path).replace("'", "''")


def _write_csv(rows: list[dict[str, Any]], path: Path) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for row in rows:
            writer.writerow([_cell(row[name]) for name in COLUMNS])


def _cell(value: Any) -> str:
    """Return a value as text. Floats are written so that they read back the same to the last bit."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return cell_of(value)
    return "" if value is None else repr(float(value)) if isinstance(value, float) else str(value)


def _read_csv(path: Path) -> list[dict[str, Any]]:
    with path.open(encoding="utf-8", newline="") as file:
        return [{name: _value(COLUMNS[name], text) for name, text in row.items() if name in COLUMNS}
                for row in csv.DictReader(file)]


def _value(kind: type, text: str) -> Any:
    if text == "":
        return None
    if kind is str:
        return text_of(text)
    return text == "true" if kind is bool else kind(text)


def _write_sqlite(rows: list[dict[str, Any]], path: Path) -> None:
    with closing(sqlite3.connect(path)) as base, base:
        typed = ", ".join(f"{name} {_SQLITE[kind]}" for name, kind in COLUMNS.items())
        base.execute(f"CREATE TABLE {_TABLE} ({typed})")
        base.executemany(f"INSERT INTO {_TABLE} VALUES ({', '.join('?' * len(COLUMNS))})",
                         [tuple(row[name] for name in COLUMNS) for row in rows])


def _read_sqlite(path: Path) -> list[dict[str, Any]]:
    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as base:
        base.row_factory = sqlite3.Row
        found = [dict(row) for row in base.execute(f"SELECT * FROM {_TABLE}")]
    flags = [name for name, kind in COLUMNS.items() if kind is bool]
    return [row | {name: None if row.get(name) is None else bool(row[name]) for name in flags} for row in found]
