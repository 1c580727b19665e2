"""candump beside a test, and a reader of its log (`candump -L`) without code of tdhil.

A line is `(1700000000.123456) vcan0 605#4041600000000000`, time stamp, interface, identifier and data in hex; `705#R1`
is a remote frame of one byte, eight digits make an identifier one of 29 bits.
"""

from __future__ import annotations

import re
import struct
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

LINE = re.compile(r"\((\d+\.\d+)\) (\S+) ([0-9A-F]{3}|[0-9A-F]{8})#(R?)([0-9A-F]*)(?: [RT])?")
RECEIVE_BYTES = 4 << 20
"""Size of candump's buffer, so that a late reader on one CPU loses no frame."""
WAIT_S = 30.0


class Seen(NamedTuple):
    """Frame on the bus; ``stamp_s`` is the wall-clock time stamp of the kernel."""

    stamp_s: float
    identifier: int
    data: bytes
    remote: bool
    line: str


def parse(text: str, interface: str) -> list[Seen]:
    """Return all frames with 11-bit identifiers in the order of the bus, without an incomplete last line."""
    found = []
    for line in text[: text.rfind("\n") + 1].splitlines():
        match = LINE.fullmatch(line)
        assert match, line
        stamp, name, identifier, remote, data = match.groups()
        assert name == interface
        assert len(identifier) == 3, line
        content = b"" if remote else bytes.fromhex(data)
        found.append(Seen(float(stamp), int(identifier, 16), content, bool(remote), line))
    return found


class Candump:
    """Running candump."""

    def __init__(self, log: Path, interface: str) -> None:
        self.log, self.interface = log, interface

    @property
    def frames(self) -> list[Seen]:
        """Return the frames so far, without the requests of stepped time (6FEh), whose number depends on the load."""
        return [frame for frame in parse(self.log.read_text(), self.interface) if frame.identifier != QUESTION]


def listeners(interface: str) -> int:
    """Return the kernel's count of sockets that receive every frame of the interface."""
    rows = Path("/proc/net/can/rcvlist_all").read_text().splitlines()
    return sum(row.split()[:1] == [interface] for row in rows)


@contextmanager
def watching(program: str, log: Path, interface: str) -> Iterator[Candump]:
    """Run candump from before the first frame until the end of the block. Its log is complete afterwards."""
    before, end_s = listeners(interface), time.monotonic() + WAIT_S
    with log.open("w") as file, subprocess.Popen(
        [program, "-L", "-r", str(RECEIVE_BYTES), interface], stdout=file, stderr=subprocess.DEVNULL
    ) as child:
        try:
            while listeners(interface) <= before:
                assert child.poll() is None, "candump ended at once"
                assert time.monotonic() < end_s, "candump never bound its socket"
                time.sleep(0.01)
            yield Candump(log, interface)
            time.sleep(0.2)              # frames still queued in the kernel
        finally:
            child.terminate()
            child.wait(WAIT_S)


# -- identifiers of the predefined connection set (CiA 301), node 1 as the drive and 127 as the host -------------

NMT, SYNC, RPDO1, RPDO2, SDO_ASK, HOST_BEAT = 0x000, 0x080, 0x201, 0x301, 0x601, 0x77F
EMCY, TPDO1, TPDO2, SDO_ANSWER, DRIVE_BEAT = 0x081, 0x181, 0x281, 0x581, 0x701
QUESTION = 0x6FE
HOSTS = {NMT, SYNC, RPDO1, RPDO2, SDO_ASK, HOST_BEAT}
DRIVES = {EMCY, TPDO1, TPDO2, SDO_ANSWER, DRIVE_BEAT}
ENABLE_OPERATION = 0x0F


def setpoint(data: bytes) -> tuple[int, int, int]:
    """Return RPDO1: 6040h controlword, 6071h target torque (per mille), 60FFh target velocity (0.1 rpm)."""
    return struct.unpack("<Hhi", data)


def enables(frame: Seen) -> bool:
    """Return whether a setpoint enables the drive: its controlword is "enable operation" (CiA 402)."""
    return frame.identifier == RPDO1 and setpoint(frame.data)[0] & 0x0F == ENABLE_OPERATION
