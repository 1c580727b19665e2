"""Kills processes of a pool or a cluster at random."""

import os
import random
import signal
from pathlib import Path
from typing import Any

from tdhil.fleet import FleetRow


class Killer:
    """Killer of random processes of a pool or a cluster while rows arrive."""

    def __init__(self, kills: int, victims: Any) -> None:
        self.kills, self._left, self._victims, self._rng = 0, kills, victims, random.Random(11)
        self._chance = 0.0

    def start(self, total: int, done: int) -> None:
        self._chance = 1.3 * self._left / max(1, total)

    def done(self, row: FleetRow) -> None:
        if self._left and self._rng.random() < self._chance:
            pids = self._victims()
            if pids:
                try:
                    os.kill(self._rng.choice(pids), signal.SIGKILL)
                except ProcessLookupError:
                    return
                self._left -= 1
                self.kills += 1


def children(pid: int) -> list[int]:
    found = []
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            found += [int(one) for one in path.read_text().split()]
        except OSError:
            continue
    return found


def processes(of: int, word: bytes) -> list[int]:
    found = []
    for pid in children(of):
        try:
            if word in Path(f"/proc/{pid}/cmdline").read_bytes():
                found.append(pid)
        except OSError:
            continue
    return found


def pool_processes(of: int) -> list[int]:
    return processes(of, b"tdhil.process_pool")


def cluster_processes(cluster: Any, workers_too: bool) -> list[int]:
    """Return the processes of Dask's workers, and the workers except for starting ones.

    A worker that is killed while it starts is given up by its nanny.

    """
    workers = [nanny.pid for nanny in cluster.workers.values() if nanny.status.name == "running" and nanny.pid]
    return (workers if workers_too else []) + [pid for worker in workers for pid in pool_processes(worker)]
