"""Tests of the safe path of `tdhil serve`, with the service as processes and simulated rigs; exit code 1 if one fails.

    python benchmarks/service_proofs.py kill [--full]      # the web is killed at random moments of runs
    python benchmarks/service_proofs.py stop [--full]      # a stop over HTTP beside all that could be in its way
    python benchmarks/service_proofs.py cycles [--full]    # the control loop with server and viewers, and without
    python benchmarks/service_proofs.py lost [--full]      # the run's process is killed
    python benchmarks/service_proofs.py idle [--full]      # a stop over HTTP beside 5,000 idle connections

- kill: SIGKILL of the web, and a new one, again and again (5 times; --full: 50) while stepped runs of one seed go. A
  new web knows the run, and what it is, within 3 s of its start; the log has the samples of a run that nobody
  disturbed, to the bit; there is one result, one run in the list, and after the index was deleted the same list.
- stop: runs in real time at 100 Hz with 20 viewers, replays without a pause, a locked index and, every other one, a
  full disk; from POST to the first sample of a drive in quick stop at most 100 ms and one cycle in 99 of 100 (4 stops;
  --full: 50). Each run ends at rest, and says how it came to that.
  The full disk is a tmpfs of a name space of its own (unshare), so that nobody else has it.
- cycles: one run at 100 Hz; by turns the web is there with 20 viewers, and is killed (2 turns of 20 s; --full: 6 of
  60 s). Cycles missed (no new feedback, or begun late by half a period): at most 0.1 % more with them; the web takes
  at most 5 % of a core.
- lost: SIGKILL of the run's process, while it turns a drive in another process whose watchdog has 5 s (2 times; --full:
  10). `tdhil stop` is on its way within 5 s, the drive brakes, and the run says what became of it.
- idle: a process keeps 5,000 connections to the service's port of loopback, and opens each again that is closed. They
  come from some 40 addresses (127.0.1.x) with few connections each and from 3 with very many. One half sends nothing,
  the other half begins a header. Meanwhile some 20 stops a second are asked for, each by a new connection: from an
  address without other connections, and from one with very many (8 s; --full: 60 s). From the call to the answer it
  takes at most 200 ms in 99 of 100, and each answer says that the run was asked to stop. Once with the limit of open
  files that holds here, once with 1,024. Beside it stands what the same number of stops takes without connections, half
  of them before and half after, and the ratio: on a computer with other load, that alone may take longer.

`cycles`, `idle` and `stop` want a machine with nothing else to do, and say the load that they had.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import json
import os
import signal
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import fields
from datetime import datetime
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

from drivers import CommunicationLost  # noqa: E402
from drivers.clock import quantile  # noqa: E402
from tdhil.recording import Recording, read_run  # noqa: E402
from tdhil.service.run_channel import ask, lives  # noqa: E402
from tdhil.service.run_state import ENDED  # noqa: E402
from tdhil.service.store import Store  # noqa: E402
from tests.service.conftest import wait_for  # noqa: E402
from tests.service.test_lost_run import attended_rig, simulated_drive, speed_rad_s  # noqa: E402
from tests.service.test_serve import Server, served  # noqa: E402

RIG = "simulated-canopen"
FOUND_S, STOP_S, LOST_S, IDLE_STOP_S = 3.0, 0.1, 5.0, 0.2
STOPS_A_SECOND = 20
MORE_MISSED, WEB_SHARE = 1e-3, 0.05
RATE_HZ, VIEWERS = 100.0, 20
TMPFS_MB = 400                     # a log isn't begun where less than 200 MB are free


def load() -> str:
    """Return the load of this machine, for the reader of the figures."""
    return f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"


def state_of(server: Server, run: str) -> str:
    found: str = server.client.run(run)["state"]
    return found


def stage_of(server: Server, run: str) -> str | None:
    found: str | None = server.client.run(run)["stage"]
    return found


def ended_early(server: Server, run: str) -> bool:
    """Report a run that has ended; it should not."""
    if (found := server.client.run(run))["state"] in ENDED:
        raise SystemExit(f"run {run} is {found['state']}: {found['error']}")
    return False


# -- kill -------------------------------------------------------------------------------------------------------------


def same(one: Recording, other: Recording) -> bool:
    """To the bit, in all that is an array."""
    names = [name.name for name in fields(Recording) if isinstance(getattr(one, name.name), np.ndarray)]
    return all(getattr(one, name).tobytes() == getattr(other, name).tobytes() for name in names)


def kill(folder: Path, times: int, seed: int) -> bool:
    """Prints a line a run."""
    random, data, options = Random(seed), folder / "data", {"seed": 7, "rate_hz": 50}
    with served(data) as server:
        first = server.client.start(RIG, **options)["id"]
        server.client.wait(first)
    undisturbed = read_run(data / "runs" / first / "run.mcap")
    runs, found_s, good, server = [first], [], True, Server(data)
    try:
        while len(found_s) < times:
            run = server.client.start(RIG, **options)["id"]
            runs.append(run)
            before = len(found_s)
            while state_of(server, run) not in ENDED:
                time.sleep(random.uniform(0.0, 2.0))
                if len(found_s) >= times:
                    continue
                server.process.kill()
                server.process.wait()
                server.log.close()
                begun_s = time.monotonic()
                server = Server(data)
                known = server.client.run(run)
                found_s.append(time.monotonic() - begun_s)
                if known["state"] not in ENDED and run not in server.client._object("GET", "/healthz")["live"]:
                    print(f"run {run}: {known['state']}, and the new web doesn't hold it")
                    good = False
            wait_for("the end of its process", lambda run=run: not lives(data / "runs" / run))
            log, view = read_run(data / "runs" / run / "run.mcap"), server.client.run(run)
            one = json.loads((data / "runs" / run / "result.json").read_bytes()) == log.result == view["result"]
            whole = log.complete and not log.problems and same(log.recording, undisturbed.recording)
            good &= one and whole and view["state"] == "done"
            print(f"run {run}: {len(found_s) - before} kills, {view['state']}, {len(log.recording.time_s)} samples "
                  f"{'the same' if whole else 'NOT THE SAME'}, {'one result' if one else 'NOT ONE RESULT'}",
                  flush=True)
        wait_for("the index", lambda: len(server.client.runs(state="done")) == len(runs))
        listed = server.client.runs()
        server.process.kill()
        server.process.wait()
        (data / "index.sqlite").unlink()
        server.log.close()
        server = Server(data)
        again = server.client.runs() == listed and sorted(one["id"] for one in listed) == sorted(runs)
        chain = server.client.audit()["broken"] is None
    finally:
        server.process.kill()
        server.process.wait()
    print(f"{len(found_s)} kills: found again within {max(found_s):.2f} s (median {np.median(found_s):.2f}); index"
          f" deleted: {'the same list' if again else 'ANOTHER LIST'}; audit {'holds' if chain else 'BROKEN'}; {load()}")
    return good and again and chain and max(found_s) <= FOUND_S


# -- viewers ----------------------------------------------------------------------------------------------------------


def view(url: str, run: str, count: int) -> None:
    """That many pages' sockets, in a process of its own, until it is ended."""
    import asyncio

    from websockets.asyncio.client import connect

    async def one() -> None:
        while True:
            with contextlib.suppress(Exception):
                async with connect(f"{url.replace('http', 'ws', 1)}/api/v1/live/{run}", max_size=None) as socket:
                    async for _ in socket:
                        pass
            await asyncio.sleep(0.2)

    async def all_of_them() -> None:
        await asyncio.gather(*(one() for _ in range(count)))

    asyncio.run(all_of_them())


@contextlib.contextmanager
def viewers(server: Server, run: str, count: int = VIEWERS) -> Iterator[None]:
    child = subprocess.Popen([sys.executable, __file__, "view", server.url, run, str(count)])
    try:
        wait_for("the viewers", lambda: f"tdhil_live_viewers {count}.0" in metrics(server))
        yield
    finally:
        child.kill()
        child.wait()


def metrics(server: Server) -> str:
    with server.client._open("GET", "/metrics") as answer:
        found: str = answer.read().decode()
    return found


# -- stop -------------------------------------------------------------------------------------------------------------


def mounted(arguments: list[str]) -> int:
    """This program again, where it may mount a disk of its own to fill."""
    return subprocess.call(["unshare", "--map-root-user", "--mount", sys.executable, __file__, *arguments, "--mounted"])


def nearly_fill(folder: Path) -> None:
    """One MB is left, which a run's log takes some seconds for."""
    free = os.statvfs(folder)
    with contextlib.suppress(OSError), (folder / "filler").open("ab") as file:
        os.posix_fallocate(file.fileno(), 0, max(1, free.f_bavail * free.f_frsize - 2**20))


def fill(folder: Path) -> None:
    """Nothing more can be written there."""
    with (folder / "rest").open("ab", buffering=0) as file:
        try:
            while True:
                file.write(b"0" * 4096)
        except OSError as error:
            assert error.errno == errno.ENOSPC


def stop(folder: Path, times: int, disk: bool) -> bool:
    """``disk``: there is one that may be filled."""
    if disk:
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={TMPFS_MB}m", "tmpfs", str(folder)], check=True)
    data, took_s, good, early = folder / "data", [], True, 0
    with served(data) as server:
        old = server.client.start(RIG, seed=7, rate_hz=50)["id"]
        server.client.wait(old)
        while (number := len(took_s)) < times:
            run = server.client.start(RIG, real_time=True, rate_hz=RATE_HZ, real_time_priority=True)["id"]
            going = threading.Event()
            replays = threading.Thread(target=replay_on, args=(server, old, going), daemon=True)
            with viewers(server, run), contextlib.closing(sqlite3.connect(data / "index.sqlite")) as base:
                wait_for("motion", lambda run=run: stage_of(server, run) == "speed" or state_of(server, run) in ENDED)
                if state_of(server, run) in ENDED:         # this computer has no time for it: another one
                    early += 1
                    print(f"run {run}: {server.client.run(run)['error']['what']}", flush=True)
                    if early > times:
                        return False
                    continue
                replays.start()
                base.execute("begin exclusive")
                full = disk and number % 2 == 1
                if full:
                    nearly_fill(folder)
                time.sleep(1.0)
                if full:      # which ends the run as well, if only a little later
                    fill(folder)
                asked_s = time.time()
                answer = server.client.stop(run)
                answered_s = time.time()
                status = wait_for("the drive's answer", lambda run=run: seen(data / "runs" / run))
                if status["stop"]["seen"] is None:         # the full disk came first
                    early += 1
                    going.set()
                    print(f"run {run}: it had braked for its log before it was asked", flush=True)
                    if early > times:
                        return False
                    for name in ("filler", "rest"):
                        (folder / name).unlink(missing_ok=True)
                    continue
                took_s.append(datetime.fromisoformat(status["stop"]["seen"]).timestamp() - asked_s)
                print(f"stop {number + 1}: answered after {1e3 * (answered_s - asked_s):.0f} ms ({answer['state']}),"
                      f" seen by the drive {1e3 * took_s[-1]:.0f} ms after the request of {status['stop']['by']}",
                      flush=True)
                wait_for("its end", lambda run=run: state_of(server, run) in ENDED and not lives(data / "runs" / run))
                for name in ("filler", "rest"):
                    (folder / name).unlink(missing_ok=True)
            going.set()
            replays.join(60.0)
            end = server.client.run(run)
            good &= end["stop"]["confirmed"] is True and end["state"] in ("stopped", "failed")
            print(f"        then it is {end['state']}: {end['error']['what']}", flush=True)
    p99_s = quantile(sorted(took_s), 0.99)
    print(f"{times} stops with {VIEWERS} viewers, replays, a locked index"
          f"{' and, every other one, a full disk' if disk else ''}: p99 {1e3 * p99_s:.0f} ms, median"
          f" {1e3 * np.median(took_s):.0f} ms to quick stop; {load()}")
    if not disk:
        print("No disk could be filled here (unshare, mount): that was NOT tried")
    return good and p99_s <= STOP_S + 1.0 / RATE_HZ


def seen(folder: Path) -> dict[str, Any] | None:
    """The run's status from its own mouth, once the drive brakes; a full disk may have an old one."""
    try:
        found: dict[str, Any] = ask(folder, {"do": "status"})["status"]
    except CommunicationLost:              # it has ended
        found = Store(folder.parent.parent).status(folder.name).plain()
    return found if found["stop"]["seen"] or found["state"] in ENDED else None


def replay_on(server: Server, run: str, ended: threading.Event) -> None:
    while not ended.is_set():
        with contextlib.suppress(Exception):
            server.client.replay(run)
        ended.wait(0.1)


# -- cycles -----------------------------------------------------------------------------------------------------------


def missed(time_s: np.ndarray, fresh: np.ndarray) -> tuple[int, int]:
    """(cycles, those without new feedback or begun late by more than half a period)."""
    late = np.diff(time_s) > 1.5 / RATE_HZ
    return len(late), int(np.count_nonzero(late | ~fresh[1:]))


def cpu_s(pid: int) -> float:
    """All that a process has had of a processor."""
    found = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(found[11]) + int(found[12])) / os.sysconf("SC_CLK_TCK")


def cycles(folder: Path, turns: int, seconds: float) -> bool:
    """One run; its log says what it missed while the web was there and while it wasn't."""
    data, spans, shares, server = folder / "data", [], [], Server(folder / "data")
    try:
        run = server.client.start(RIG, real_time=True, rate_hz=RATE_HZ, excitation="sine", frequency_hz=0.2,
                                  periods=200, real_time_priority=True)["id"]
        wait_for("motion", lambda: ended_early(server, run) or stage_of(server, run) == "speed")
        for _ in range(turns):
            with viewers(server, run):
                time.sleep(2.0)                # a new viewer gets all of it so far
                begun, used_s = time.time(), cpu_s(server.process.pid)
                time.sleep(seconds)
                spans.append((True, begun, time.time()))
                shares.append((cpu_s(server.process.pid) - used_s) / seconds)
                print(f"the web takes {100 * shares[-1]:.1f} % of a core with {VIEWERS} viewers", flush=True)
            server.process.kill()
            server.process.wait()
            server.log.close()
            time.sleep(1.0)
            begun = time.time()
            time.sleep(seconds)
            spans.append((False, begun, time.time()))
            server = Server(data)
            time.sleep(1.0)
            if state_of(server, run) in ENDED:
                print(f"the run ended: {server.client.run(run)['error']}")
                return False
        server.client.stop(run)
        server.client.wait(run)
    finally:
        server.process.kill()
        server.process.wait()
    log = read_run(data / "runs" / run / "run.mcap")
    wall_s, found = log.epoch_ns / 1e9 + log.recording.time_s, {True: [0, 0], False: [0, 0]}
    for there, begun, ended in spans:
        inside = (wall_s >= begun) & (wall_s < ended)
        of, bad = missed(log.recording.time_s[inside], log.recording.fresh[inside])
        found[there][0] += of
        found[there][1] += bad
        print(f"{'with' if there else 'without'} server and viewers: {bad} of {of} cycles missed", flush=True)
    with_them, without = (found[there][1] / found[there][0] for there in (True, False))
    print(f"missed with {100 * with_them:.3f} %, without {100 * without:.3f} %; the web takes"
          f" {100 * np.mean(shares):.1f} % of a core;"
          f" {log.configuration.get('real_time_priority')}; {load()}")
    return with_them - without <= MORE_MISSED and float(np.mean(shares)) <= WEB_SHARE


# -- lost -------------------------------------------------------------------------------------------------------------


def braking(trace: Path, since: int) -> bool:
    """Return whether a later row of the simulator's trace has a stop request for the drive."""
    rows = trace.read_text()[since:].splitlines()
    return any("quick stop" in row for row in rows)


def lost(folder: Path, times: int, seed: int) -> bool:
    """On a machine that has the time, it is `tdhil stop` that makes it brake, and not the watchdog."""
    random, good, took, ended = Random(seed), True, [], []
    rigs = folder / "rigs"
    rigs.mkdir()
    for number in range(times):
        trace = folder / f"shaft-{number}.csv"
        with simulated_drive(trace) as drive, contextlib.ExitStack() as stack:
            (rigs / "real.yaml").write_text(attended_rig(drive.port))
            server = stack.enter_context(served(folder / "data", "--rigs", str(rigs)))
            run = server.client.start("real")["id"]
            wait_for("motion", lambda server=server, run=run, trace=trace: ended_early(server, run)
                     or speed_rad_s(trace) > 1.0)
            time.sleep(random.uniform(0.0, 2.0))
            at, pid = trace.stat().st_size, json.loads((folder / "data/runs" / run / "state.json").read_bytes())["pid"]
            os.kill(pid, signal.SIGKILL)
            killed_s = time.monotonic()
            wait_for("tdhil stop", lambda server=server, run=run: f"{run}: its process is gone" in server.said())
            took.append(time.monotonic() - killed_s)
            wait_for("braking", lambda trace=trace, at=at: braking(trace, at))
            braked_s = time.monotonic() - killed_s
            status = server.client.wait(run)
            ended.append(time.monotonic() - killed_s)
            told = status["state"] == "interrupted" and status["stop"]["confirmed"] and run in server.said()
            good &= bool(told) and abs(speed_rad_s(trace)) < 0.1
            print(f"run {run}: tdhil stop on its way {took[-1]:.2f} s after the kill, braking after {braked_s:.2f} s,"
                  f" {status['state']} after {ended[-1]:.2f} s: {status['error']['what']}", flush=True)
    print(f"{times} kills of the run's process: a stop on its way within {max(took):.2f} s, reported within"
          f" {max(ended):.2f} s; {load()}")
    return good and max(took) <= LOST_S


# -- idle -------------------------------------------------------------------------------------------------------------


def addresses(count: int) -> list[str]:
    """A source address for each connection: three quarters share three addresses, the rest has 40."""
    many, few = [f"127.0.1.{1 + n}" for n in range(3)], [f"127.0.1.{101 + n}" for n in range(40)]
    return [many[n % len(many)] if n % 4 else few[n // 4 % len(few)] for n in range(count)]


def keep_idle(port: int, count: int) -> None:
    """Hold this number of connections in a process until it is ended; print their number each second."""
    import resource
    import selectors
    import socket

    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    os.nice(10)                            # it is to take the service's descriptors, and not its processor
    chosen, look = selectors.DefaultSelector(), time.monotonic() + 1.0
    sources, opened = addresses(count), 0

    def begin(number: int) -> None:
        nonlocal opened
        peer = socket.socket()
        peer.setblocking(False)
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")      # leaves no port behind
        peer.bind((sources[number], 0))
        peer.connect_ex(("127.0.0.1", port))
        opened += 1
        chosen.register(peer, selectors.EVENT_WRITE, (number, False))

    for number in range(count):
        begin(number)
    while True:
        for key, _ in chosen.select(0.2):
            number, there = key.data
            peer = key.fileobj
            assert isinstance(peer, socket.socket)
            try:
                if there:
                    peer.recv(1)           # closed by the other end, or reset
                    raise ConnectionError
                if number % 2:
                    peer.send(b"POST /api/v1/runs/x/stop HTTP/1.1\r\nHost: 127.0.0.1\r\n")
                chosen.modify(peer, selectors.EVENT_READ, (number, True))
            except OSError:
                chosen.unregister(peer)
                peer.close()
                begin(number)
        if time.monotonic() >= look:
            look += 1.0
            there_now = sum(key.data[1] for key in chosen.get_map().values())
            print(f"{there_now} {opened}", flush=True)


def timed_stop(url: str, run: str, source: str) -> tuple[float, Any]:
    """A new connection, a whole request, and its answer: the time that it took, and the run's stop."""
    import http.client
    from urllib.parse import urlsplit

    at = urlsplit(url)
    begun_s = time.monotonic()
    with contextlib.closing(http.client.HTTPConnection(at.hostname or "", at.port, 30.0, (source, 0))) as client:
        client.request("POST", f"/api/v1/runs/{run}/stop", "{}", {"Content-Type": "application/json"})
        answer = json.loads(client.getresponse().read())
    return time.monotonic() - begun_s, answer.get("stop")


def timed_stops(server: Server, run: str, count: int, sources: tuple[str, ...]) -> tuple[list[float], bool]:
    """Return what so many stops took, s, some `STOPS_A_SECOND`; and whether each asked the run."""
    took_s, good = [], True
    for number in range(count):
        took, stop = timed_stop(server.url, run, sources[number % len(sources)])
        took_s.append(took)
        good &= bool(stop and stop["asked"])
        time.sleep(1.0 / STOPS_A_SECOND)
    return took_s, good


def in_ms(took_s: list[float]) -> str:
    return (f"p99 {1e3 * quantile(sorted(took_s), 0.99):.0f} ms, median {1e3 * float(np.median(took_s)):.0f} ms,"
            f" longest {1e3 * max(took_s):.0f} ms")


def idle(folder: Path, seconds: float, descriptors: int | None, count: int = 5000) -> bool:
    """``descriptors``: the limit of open files that the service has; None: as it is here."""
    took_s: list[float] = []
    good, most, opened = True, 0, 0
    half = max(1, round(0.5 * seconds * STOPS_A_SECOND))
    with served(folder / f"data-{descriptors}", descriptors=descriptors) as server:
        run = server.client.start(RIG, real_time=True, rate_hz=10.0)["id"]
        wait_for("motion", lambda: stage_of(server, run) == "speed" or ended_early(server, run))
        port = server.url.rpartition(":")[2]
        alone_s, _ = timed_stops(server, run, half, ("127.0.0.9",))
        with subprocess.Popen([sys.executable, __file__, "keep", port, str(count)], stdout=subprocess.PIPE,
                              text=True) as child:
            assert child.stdout is not None
            try:
                child.stdout.readline()
                end_s = time.monotonic() + seconds
                while time.monotonic() < end_s or len(took_s) < half:
                    more_s, all_asked = timed_stops(server, run, STOPS_A_SECOND, ("127.0.1.1", "127.0.0.9"))
                    took_s += more_s
                    good &= all_asked
                    there, opened = (int(one) for one in child.stdout.readline().split())
                    most = max(most, there)
            finally:
                child.kill()
        alone_s += timed_stops(server, run, half, ("127.0.0.9",))[0]
        wait_for("its end", lambda: state_of(server, run) in ENDED)
        end, said = server.client.run(run), server.said()
    good &= end["stop"]["confirmed"] is True and "Traceback" not in said
    p99_s, alone_p99_s = (quantile(sorted(one), 0.99) for one in (took_s, alone_s))
    print(f"{'no own' if descriptors is None else descriptors} limit of open files: {len(took_s)} stops beside {count}"
          f" idle connections ({most} open at once, {opened} opened in all): {in_ms(took_s)}; the run is"
          f" {end['state']}; {len(said)} bytes of log; {len(alone_s)} stops without connections: {in_ms(alone_s)};"
          f" ratio of p99 {p99_s / alone_p99_s:.2f}, of medians {np.median(took_s) / np.median(alone_s):.2f};"
          f" {load()}", flush=True)
    return good and p99_s <= IDLE_STOP_S and len(said) <= 200 * (2.0 * seconds + 60.0)


def main(arguments: list[str]) -> int:
    """0 where all holds."""
    if arguments[:1] == ["view"]:
        view(arguments[1], arguments[2], int(arguments[3]))
        return 0
    if arguments[:1] == ["keep"]:
        keep_idle(int(arguments[1]), int(arguments[2]))
        return 0
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("kill", "stop", "cycles", "lost", "idle"))
    parser.add_argument("--full", action="store_true", help="as many as the promise is for")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--mounted", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.what == "stop" and not options.mounted and subprocess.call(
        ["unshare", "--map-root-user", "--mount", "true"], stderr=subprocess.DEVNULL) == 0:
        return mounted(arguments)
    short: dict[str, Callable[[Path], bool]] = {
        "kill": lambda folder: kill(folder, 50 if options.full else 5, options.seed),
        "stop": lambda folder: stop(folder, 50 if options.full else 4, options.mounted),
        "cycles": lambda folder: cycles(folder, *((6, 60.0) if options.full else (2, 20.0))),
        "lost": lambda folder: lost(folder, 10 if options.full else 2, options.seed),
        "idle": lambda folder: min([idle(folder, 60.0 if options.full else 8.0, one) for one in (None, 1024)]),
    }
    with tempfile.TemporaryDirectory() as folder:
        try:
            good = short[options.what](Path(folder))
        finally:
            if options.mounted:
                subprocess.run(["umount", "--lazy", folder], check=False)
    print("holds" if good else "DOES NOT HOLD")
    return int(not good)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
