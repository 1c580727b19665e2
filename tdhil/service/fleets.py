"""Identification of many logs again, requested on a page. One process at a time, at the lowest priority.

``python -m tdhil.service.fleets FOLDER`` is that process: `tdhil.fleet` with the request.json in the folder. It writes
its progress to stdout as lines of JSON. A line on its stdin lets it continue, or holds it while a shaft turns. The end
of stdin ends it, so that no computation remains if the web fails. Finished rows are kept: the same request again
computes the rest.

::

    fleets/<id>/   request.json state.json fleet.csv fleet.csv.work/
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from tdhil.errors import MessageCode, UsageError
from tdhil.numerics import prepare
from tdhil.service.run_state import Conflict, NotThere, Told, now, request_wrong
from tdhil.service.store import LOG, Store, read_json, write_json

if TYPE_CHECKING:
    from tdhil.fleet import FleetRow

RUNS: Final = ""
"""Name of the folder of the service's own runs. No other folder has this name."""
TABLE: Final = "fleet.csv"
LOOK_S: Final = 0.3
"""Interval of the check whether a shaft turns, s."""


@dataclass(frozen=True)
class FleetView:
    """State of a fleet request. ``held``: it waits until no shaft turns; ``left_s``: estimated remaining time, s.

    ``summary`` is the document of `tdhil fleet --json`. ``archived``: the service's archived runs are included;
    ``rehearsals``: those of faults are included.
    """

    id: str
    folder: str
    below: str
    settings: dict[str, Any]
    asked: str
    asked_by: str
    state: Literal["running", "done", "interrupted", "failed"]
    held: bool = False
    total: int = 0
    done: int = 0
    failed: int = 0
    left_s: float | None = None
    summary: dict[str, Any] | None = None
    error: Told | None = None
    archived: bool = False
    rehearsals: bool = False


@dataclass
class _Going:
    """A fleet request that is being computed."""

    view: FleetView
    process: subprocess.Popen[bytes]
    rows: list[dict[str, Any]] = field(default_factory=list)
    began_s: float = 0.0
    held_s: float = 0.0
    before: int = 0
    ended: threading.Event = field(default_factory=threading.Event)


class Fleets:
    """All fleet requests, for use by any thread. ``folders``: permitted folders of logs, by name in a request."""

    def __init__(self, store: Store, folders: Mapping[str, Path], turning: Callable[[], bool]) -> None:
        self.folders = {RUNS: store.folder, **folders}
        self._runs = store.runs
        self._places = store.folder / "fleets"
        self._turning = turning
        self._lock = threading.Lock()
        self._going: _Going | None = None

    def all(self) -> list[FleetView]:
        """Return all fleet requests, the newest first."""
        with suppress(OSError):
            found = [view for one in self._places.iterdir() if (view := self._view(one.name)) is not None]
            return sorted(found, key=lambda view: view.asked, reverse=True)
        return []

    def get(self, fleet: str) -> FleetView:
        """Return one fleet request. Raises NotThere."""
        found = self._view(fleet) if fleet.isalnum() else None
        if found is None:
            raise NotThere("this fleet does not exist", where=f"fleet {fleet[:40]}", next_step="See the list of fleets")
        return found

    def ask(self, folder: str, below: str, settings: Mapping[str, Any], who: str, **included: bool) -> FleetView:
        """Start a request, or continue an earlier one. ``included``: as in `FleetView`. Raises UsageError, and Conflict
        while another request runs.
        """
        self._check(folder, below)
        more: dict[str, Any] = {name: True for name, given in included.items() if given}
        plain: dict[str, Any] = {"folder": folder, "below": below, "settings": dict(settings), **more}
        fleet = hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:12]
        place = self._places / fleet
        with self._lock:
            if (going := self._going) is not None:
                if going.view.id == fleet:
                    return going.view
                raise Conflict("other logs are being identified", holder=f"fleet {going.view.id}",
                               where=f"fleet {going.view.id}", next_step="Wait until that has ended, or stop it")
            place.mkdir(parents=True, exist_ok=True)
            asked = now()
            root = str(self.folders[folder].resolve())
            write_json(place / "request.json", {**plain, "root": root, "asked": asked, "asked_by": who})
            (place / "state.json").unlink(missing_ok=True)
            process = subprocess.Popen(
                [sys.executable, "-m", "tdhil.service.fleets", str(place)], stdin=subprocess.PIPE,
                stdout=subprocess.PIPE, start_new_session=True,
            )
            view = FleetView(fleet, folder, below, dict(settings), asked, who, "running", **more)
            self._going = going = _Going(view, process, began_s=time.monotonic())
        for work in (self._listen, self._gate):
            threading.Thread(target=work, args=(going,), daemon=True).start()
        return view

    def stop(self, fleet: str) -> FleetView:
        """Request the end of a fleet request. Finished rows are kept. Raises NotThere."""
        view = self.get(fleet)
        going = self._going
        if going is not None and going.view.id == fleet:
            self._end(going)
        return view

    def rows(self, fleet: str, start: int, limit: int) -> list[dict[str, Any]]:
        """Return rows of the table (`tdhil.fleet.FleetRow`). During the computation: only the rows since its start.

        Raises NotThere and UsageError.
        """
        from tdhil.fleet import read_table

        self.get(fleet)
        going = self._going
        if going is not None and going.view.id == fleet:
            return going.rows[start : start + limit]
        table = self._places / fleet / TABLE
        return [asdict(row) for row in read_table(table)[start : start + limit]] if table.exists() else []

    def table(self, fleet: str) -> Path:
        """Return the table's file. Raises NotThere."""
        self.get(fleet)
        path = self._places / fleet / TABLE
        if not path.is_file():
            raise NotThere("the table does not exist yet", where=f"fleet {fleet}",
                           next_step="Wait until the fleet has ended")
        return path

    def close(self) -> None:
        """End the present request, and wait up to 5 s for its table."""
        if (going := self._going) is not None:
            self._end(going)
            going.ended.wait(5.0)

    # ----------------------------------------------------------------------------------------------------------------

    def _check(self, folder: str, below: str) -> None:
        if folder not in self.folders:
            there = ", ".join(filter(None, self.folders)) or "none"
            raise request_wrong("is not a folder of this service", folder[:60],
                                f"Folders: {there}. Add one with tdhil serve --logs DIR")
        root = self.folders[folder].resolve()
        if folder == RUNS:
            root = self._runs
            if below:
                raise request_wrong("the service's runs can only be used all together", "below", "Remove it")
            if next(root.glob(f"*/{LOG}"), None) is None:
                raise UsageError("no run has a log yet", where=root.name, next_step="Start a run",
                                 entry=MessageCode.NOT_READY)
            return
        try:
            inside = (root / below).resolve()
            found = inside.is_relative_to(root) and inside.is_dir()
        except (OSError, ValueError):
            found = False
        if not found:
            raise request_wrong("is not a folder inside it", f"below {below[:60]}", "Name a folder inside it")

    def _view(self, fleet: str) -> FleetView | None:
        going = self._going
        if going is not None and going.view.id == fleet:
            left_s = None
            since = going.view.done - going.before
            if since and not going.view.held:
                each_s = (time.monotonic() - going.began_s - going.held_s) / since
                left_s = each_s * (going.view.total - going.view.done)
            return replace(going.view, left_s=left_s)
        request = read_json(self._places / fleet / "request.json")
        state = read_json(self._places / fleet / "state.json") or {"state": "interrupted"}
        try:
            asked = {name: value for name, value in (request or {}).items() if name != "root"}
            if state.get("error") is not None:
                state["error"] = Told(**state["error"])
            return FleetView(fleet, **asked, **state)
        except TypeError:
            return None

    def _gate(self, going: _Going) -> None:
        """Hold the process while a shaft turns. It still finishes its present logs: about 1 s each, at nice 19."""
        sent = None
        assert going.process.stdin is not None
        while True:
            held = self._turning()
            if held != sent:
                with suppress(OSError, ValueError):
                    going.process.stdin.write(b"hold\n" if held else b"go\n")
                    going.process.stdin.flush()
                sent = held
                with self._lock:
                    going.view = replace(going.view, held=held)
            if going.ended.wait(LOOK_S):
                return
            going.held_s += LOOK_S if held else 0.0

    def _listen(self, going: _Going) -> None:
        assert going.process.stdout is not None
        state: dict[str, Any] = {"state": "interrupted"}
        for line in going.process.stdout:
            with suppress(ValueError, KeyError, TypeError):
                found = json.loads(line)
                if "row" in found:
                    if going.view.rehearsals or found["row"]["rehearsed_faults"] is None:
                        going.rows.append(found["row"])
                    failed = going.view.failed + (found["row"]["error_kind"] is not None)
                    with self._lock:
                        going.view = replace(going.view, done=going.view.done + 1, failed=failed)
                elif "state" in found:
                    state = found
                else:
                    going.before, going.began_s, going.held_s = found["done"], time.monotonic(), 0.0
                    with self._lock:
                        going.view = replace(going.view, total=found["total"], done=found["done"])
        going.process.wait()
        self._end(going)
        going.process.stdout.close()
        view = going.view
        known = {"total": view.total, "done": view.done, "failed": view.failed}
        with suppress(OSError):
            write_json(self._places / view.id / "state.json", known | state)
        with self._lock:
            self._going = None
        going.ended.set()

    @staticmethod
    def _end(going: _Going) -> None:
        assert going.process.stdin is not None
        with suppress(OSError, ValueError):
            going.process.stdin.close()


# ---------------------------------------------------------------------------------------------------------------------
# Code of the separate process


class _Teller:
    """Writer of the progress to stdout. It waits while the process is held."""

    def __init__(self) -> None:
        self._out = os.fdopen(os.dup(1), "w")
        os.dup2(2, 1)                      # output of libraries goes to stderr
        self._go = threading.Event()
        threading.Thread(target=self._hear, daemon=True).start()

    def say(self, **plain: Any) -> None:
        with suppress(BrokenPipeError):    # the web has ended; the end of stdin ends this process
            self._out.write(json.dumps(plain) + "\n")
            self._out.flush()

    def start(self, total: int, done: int) -> None:
        self.say(total=total, done=done)
        self._go.wait()

    def done(self, row: FleetRow) -> None:
        self.say(row=asdict(row))
        self._go.wait()                    # the pool's processes get no new work meanwhile

    def _hear(self) -> None:
        for line in sys.stdin:
            (self._go.clear if line == "hold\n" else self._go.set)()
        os.kill(os.getpid(), signal.SIGINT)


def _own_logs(store: Store, *, archived: bool) -> tuple[str, ...]:
    """Return the logs of the service's runs, from the folder of the service; archived ones only with ``archived``.

    Uploaded recordings are left out: the table of a fleet has no mark for them.
    """
    runs = sorted(one for one in store.ids() if archived or not store.annotations(one).archived)
    runs = [one for one in runs if not (read_json(store.place(one) / "request.json") or {}).get("uploaded")]
    return tuple(str(path) for one in runs if (path := store.runs / one / LOG).is_file())


def main(folder: Path) -> int:
    """Compute the request of this folder and write its outcome to stdout. Return 0."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, 19)
    teller = _Teller()
    try:
        from tdhil.fleet import FleetRequest, FleetSettings, run_fleet
        from tdhil.process_pool import usable_cores

        request = read_json(folder / "request.json") or {}
        os.chdir(request["root"])
        roots: tuple[str, ...] = (request["below"] or ".",)
        if request["folder"] == RUNS:
            roots = _own_logs(Store(Path()), archived=bool(request.get("archived")))
        summary = run_fleet(
            FleetRequest(roots, folder / TABLE, FleetSettings(**request["settings"]), jobs=usable_cores(),
                         rehearsals=bool(request.get("rehearsals"))), teller)
        found = summary.document() | {"out": TABLE}
        whole = not summary.interrupted and not summary.left
        teller.say(state="done" if whole else "interrupted", total=len(summary.rows) + summary.left,
                   done=len(summary.rows), failed=sum(row.failed for row in summary.rows), summary=found)
    except KeyboardInterrupt:
        teller.say(state="interrupted")
    except Exception as error:
        teller.say(state="failed", error=asdict(Told.of(error)))
    return 0


if __name__ == "__main__":
    prepare()
    sys.exit(main(Path(sys.argv[1])))
