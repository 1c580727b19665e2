"""Console at the rig: shows the code of a waiting run to the operator at the rig.

The code is read from the run's socket, which belongs to one user of this computer. HTTP never delivers it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Final

from drivers import CommunicationLost
from profiles import visible
from tdhil.errors import UsageError
from tdhil.recording import REHEARSAL
from tdhil.service.run_channel import SOCKET, RunRefused, ask, lives
from tdhil.service.run_state import State, Status
from tdhil.service.store import Store

EVERY_S: Final = 0.25
NEWEST: Final = 50
"""Number of newest runs that are checked: a rig has one run at a time."""


class Console:
    """Console that shows each code once. ``say`` prints a text."""

    def __init__(self, store: Store, say: Callable[[str], None]) -> None:
        self._store, self._say = store, say
        self._shown: dict[str, str] = {}

    def show(self, run: str, status: Status) -> None:
        """Show the code of a waiting run, if it differs from the last one shown."""
        with suppress(RunRefused, CommunicationLost):
            found = ask(self._store.place(run), {"do": "code"})
            code = found.get("code")
            if code and self._shown.get(run) != code:
                self._shown[run] = code
                text = status.confirmation.text if status.confirmation is not None else ""
                request = self._store.request(run)
                by = visible(request.asked_by)
                marks = ", SIMULATED" * bool(status.simulated) + f", {REHEARSAL}" * request.rehearsal
                self._say(f"{text}\nRig {status.rig}{marks}. Requested by {by}, run {run}. To let it move, type this"
                          f" code into the page within {found['left_s']:.0f} s:   {code[:3]} {code[3:]}\n")

    def forget(self, run: str) -> bool:
        """Forget a run. Return whether its code was shown."""
        return self._shown.pop(run, None) is not None

    def look(self) -> None:
        """Show the codes of waiting runs, and report the outcome of earlier ones."""
        for run in islice(self._store.ids(), NEWEST):
            with suppress(Exception):          # the run is being created or deleted
                self._look_at(run)

    def _look_at(self, run: str) -> None:
        folder = self._store.place(run)
        if run not in self._shown and not lives(folder):
            return
        status = self._store.status(run)
        if status.state is State.AWAITING and lives(folder):
            if run not in self._shown and not os.access(folder / SOCKET, os.W_OK):
                self._shown[run] = ""
                self._say(f"run {run} waits for its code, which only the user of tdhil serve may see")
            elif run not in self._shown:
                self.show(run, status)
        elif self.forget(run):
            why = "" if status.error is None else f": {status.error.message}"
            self._say(visible(f"run {run}: {status.state}{why}"))


def attend(data: Path, say: Callable[[str], None], going: Callable[[], bool] = lambda: True) -> None:
    """Show the codes of the service with this folder in another terminal.

    Raises UsageError if the folder belongs to no service, or can't be read.
    """
    store = Store(data.resolve())
    if not store.runs.is_dir() or not os.access(store.runs, os.R_OK | os.X_OK):
        raise UsageError("this folder has no service runs that this user may read", where=f"--data {data}",
                         next_step="Name the folder of tdhil serve, and run as its user (sudo -u USER tdhil attend)")
    say(f"The codes of {store.folder} are shown here. Ctrl-C ends this display. Runs continue.")
    console = Console(store, say)
    while going():
        console.look()
        time.sleep(EVERY_S)
