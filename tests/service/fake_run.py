"""Process of a run without a drive: the same files, socket and lock, and the behaviour in the note of the request.

``done`` | ``hold`` (moves until it is stopped) | ``loose`` (the same, with an unconfirmed stop) | ``brake`` (the
same, and brakes until its folder has a file ``rest``) | ``ask`` (needs the code first; if its rig is watched, it
then moves until it is stopped or no longer watched) | ``patient`` (the same, but the time of the lease begins
when its page closes, so that a test has no time limit) | ``frozen`` (receives no stop) | ``identify`` (its
motion is over, and it computes until it is stopped) | ``die`` (killed while it moves)
"""

from __future__ import annotations

import os
import signal
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

from drivers import PreflightRefused
from tdhil.service.attendance import Board, Confirming, Lease
from tdhil.service.run_channel import STOP_FILE, ChannelListener
from tdhil.service.run_state import Check, Confirmation, State, Stop, now, way_to
from tdhil.service.store import Store, read_json, write_json

RESULT = {"verdict": "valid", "inertia_kg_m2": {"value": 104.0, "low_total": 100.0, "high_total": 108.0,
                                                 "repeatability_rel": 0.005}}


def main(folder: Path) -> None:
    store = Store(folder.parent.parent)
    request = store.request(folder.name)
    what = str(request.options.get("note", "done"))
    board = Board(store, replace(store.status(request.id), pid=os.getpid(), simulated=request.simulated))
    stop = SimpleNamespace(asked=False)
    watched = request.motion == "watched"
    confirming = Confirming("b" * 64, lambda: None, watched=watched)
    leases: list[Lease] = []
    confirming.code = "123456"

    def answer(asked):
        if asked.get("do") == "stop" and what == "frozen":
            time.sleep(3600.0)
        elif asked.get("do") == "stop":
            stop.asked = True
            at = now()
            if board.status.stop.at_rest is None:
                board.know(stop=Stop(asked=at, by=asked["by"], seen=at))
        elif asked.get("do") == "confirm":
            confirming.take(asked["code"], asked["binding"], asked["by"], asked.get("lease") or "")
        elif asked.get("do") == "lease":
            if not leases:
                raise PreflightRefused("this run is not watched")
            found = leases[0].renew(asked["key"], asked["by"], new_key=asked["new_key"] or "",
                                    gone=asked["gone"] or "")
            return {"watch": asdict(found)}
        elif asked.get("do") == "code":
            return {"code": confirming.code, "left_s": confirming.left_s}
        return {"status": board.status.plain()}

    def waiting():
        return time.monotonic() if leases and leases[0].watch.how == "hidden" else 0.0

    heard = signal.SIG_IGN if what == "frozen" else lambda number, frame: setattr(stop, "asked", True)
    signal.signal(signal.SIGTERM, heard)
    listener = ChannelListener(folder, answer)
    with listener:
        if (folder / STOP_FILE).exists():
            answer({"do": "stop", **(read_json(folder / STOP_FILE) or {})})
        board.to(State.PREFLIGHT)
        if what == "deaf":
            (folder / "control.sock").unlink()
        if what in ("ask", "patient"):
            text = f"this moves\n{request.options.get('operator', '')}"       # a checklist, where a test has one
            board.to(State.AWAITING, confirmation=Confirmation(confirming.binding, text, now()),
                     preflight=(Check("watchdog", "500 ms", "500 ms", "ok", "1016h:1"),),
                     expected_half_width=0.013,
                     expected_s={"setup": 10.0, "acquire": 120.0}, safe_action="quick stop", identity="A drive")
            while not stop.asked and confirming.confirmed_by is None:
                if confirming.void is not None:
                    end(board, State.REFUSED, 4)
                    return
                time.sleep(0.01)
        if watched and not stop.asked:
            leases.append(Lease(
                confirming.lease_key, confirming.confirmed_by or "", change=lambda one: board.know(watch=one),
                lost=lambda one: setattr(stop, "asked", True), needed=lambda: not stop.asked,
                clock=time.monotonic if what == "ask" else waiting))
            leases[0].start()
            what = "hold"
        if not stop.asked:
            board.to(State.MOVING, "setup", confirmation=None)
            (folder / "run.mcap").write_bytes(b"0123456789" * 10)
        if what == "die":
            time.sleep(0.3)
            os.kill(os.getpid(), signal.SIGKILL)
        while what in ("hold", "loose", "deaf", "frozen", "brake") and not stop.asked:
            time.sleep(0.01)
        if what == "brake":
            board.to(State.STOPPING)
            while not (folder / "rest").exists():
                time.sleep(0.01)
        if what == "identify":
            board.to(State.STOPPING)
            board.stop(confirmed=True, at_rest=now())
            board.to(State.IDENTIFYING)
            while not stop.asked:
                time.sleep(0.01)
            end(board, State.FAILED, 143)
        elif stop.asked and what != "loose":
            if (folder / "run.mcap").exists():         # it moved
                board.stop(confirmed=True, at_rest=now())
            end(board, State.STOPPED, 143)
        elif what in ("unseen", "loose"):
            end(board, State.STOP_NOT_CONFIRMED, 8)
        else:
            write_json(folder / "result.json", RESULT)
            end(board, State.DONE, 0)


def end(board: Board, state: State, code: int) -> None:
    board.change(lambda status: way_to(status, state, now(), exit_code=code, confirmation=None))
    board.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
