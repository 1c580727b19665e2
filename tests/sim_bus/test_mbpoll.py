"""Debian's mbpoll (libmodbus) as the independent host: it reads and writes registers from the drive manuals.

The tests use TCP, and RTU on a pseudo terminal. They install nothing; without mbpoll they are skipped visibly, and
with TDHIL_REQUIRE_MBPOLL=1 they fail. mbpoll counts from 1, as most manuals do; ``-0`` makes it count from 0.
"""

import os
import re
import shutil
import subprocess
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from profiles.library import load_modbus_profile
from sim_bus.modbus.lines import RequestListener, RtuListener, TcpListener
from sim_bus.modbus.machine import Machine
from sim_bus.modbus.server import DriveServer
from tests.path.path_runs import wait_for
from tests.rigs import QUIET_RIG

pytestmark = pytest.mark.real_time
WHY = "no mbpoll on this machine: no independent host has read the simulated drive; apt-get install mbpoll"
LINES = ("tcp", "rtu")


@pytest.fixture(autouse=True)
def mbpoll_or_loud() -> None:
    if shutil.which("mbpoll") is None:
        if os.environ.get("TDHIL_REQUIRE_MBPOLL") == "1":
            pytest.fail(f"{WHY}, and TDHIL_REQUIRE_MBPOLL=1 forbids to skip", pytrace=False)
        warnings.warn(pytest.PytestWarning(f"SKIPPED: {WHY}"), stacklevel=1)
        pytest.skip(WHY)


class Poll:
    """mbpoll with one drive."""

    def __init__(self, *where: str) -> None:
        self._where = where

    def __call__(self, *arguments: str, values: tuple[int, ...] = ()) -> str:
        *options, target = self._where
        command = ["mbpoll", "-1", "-o", "10", *options, *arguments, "--", target, *map(str, values)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300)
        return done.stdout + done.stderr

    def read(self, register: int, count: int = 1, *options: str) -> list[int]:
        """Read 16-bit registers, or other types by ``options`` (-t 4:int, -B)."""
        kind = () if "-t" in options else ("-t", "4:hex")
        text = self("-r", str(register), "-c", str(count), *kind, *options)
        values = re.findall(r"^\[\d+\]:\s+(?:0x([0-9A-F]+)|(-?\d+))", text, re.MULTILINE)
        assert len(values) == count, text
        return [int(in_hex, 16) if in_hex else int(decimal) for in_hex, decimal in values]

    def write(self, register: int, *values: int, options: tuple[str, ...] = ("-t", "4")) -> str:
        return self("-r", str(register), *options, values=values)


@contextmanager
def served(name: str, line: str, unit: int = 1) -> Iterator[tuple[Poll, Machine]]:
    """Run the simulated drive in a thread, in real time."""
    listener: RequestListener
    where: tuple[str, ...]
    if line == "tcp":
        listener = TcpListener("127.0.0.1", 0)
        where = ("-m", "tcp", "-p", listener.reached_by.rpartition(":")[2], "-a", str(unit), "127.0.0.1")
    else:
        listener = RtuListener(None, baud=19200, parity="E", stop_bits=1)
        where = ("-m", "rtu", "-b", "19200", "-P", "even", "-a", str(unit), listener.reached_by.split()[1])
    stop = threading.Event()
    with Machine(QUIET_RIG, load_modbus_profile(name), stepped=False) as machine:
        thread = threading.Thread(target=DriveServer(machine, unit, listener, gateway=line == "tcp").run, args=(stop,))
        thread.start()
        try:
            yield Poll(*where), machine
        finally:
            stop.set()
            thread.join()
            listener.close()


@pytest.mark.parametrize("line", LINES)
def test_generic_map(line: str) -> None:
    with served("generic/modbus", line, unit=5) as (poll, machine):
        assert poll.read(33, 4) == [0x0001, 0x86A0, 2094, 2000]                  # 1000.00 N·m, 20.94 kW, 200.0 rpm
        assert poll.read(43, 1, "-t", "4:int", "-B") == [0x12345678]
        assert poll.read(45) == [0x10000 - 12345]
        marker = poll.read(0xFDE8, 13, "-0")
        text = b"".join(word.to_bytes(2, "big") for word in marker[:12])
        assert text.rstrip(b"\0") == b"tdhil simulated drive" and marker[12] == 0
        assert "Written 1 references" in poll.write(41, 250)                      # function 6: time-out in ms
        assert poll.read(41) == [250]
        assert "Written 2 references" in poll.write(37, 900, 0x10000 - 900)       # function 16: speed limits
        assert poll.read(37, 2) == [900, 0x10000 - 900]
        assert "Written 1 references" in poll.write(1, -2500, options=("-0", "-t", "4:int", "-B"))
        assert poll.read(48, 1, "-0", "-t", "4:int", "-B") == [-25_000]          # echo of -25.00 rpm in 0.001 rpm
        assert machine.parameters.value("time_out") == 0.25
        assert "Illegal data address" in poll("-r", "6")
        assert "Illegal data address" in poll.write(17, 1)
        assert "Illegal function" in poll("-t", "0", "-r", "1")
        assert "Illegal data value" in poll.write(5, 7)


@pytest.mark.heavy
@pytest.mark.parametrize("line", LINES)
def test_the_shaft_follows(line: str) -> None:
    with served("generic/modbus", line) as (poll, machine):
        poll.write(41, 3000)               # every write starts a program, which may be slow
        for word, status in ((0x06, 0x21), (0x07, 0x23), (0x0F, 0x27)):
            assert "Written 1 references" in poll.write(1, word)
            assert poll.read(17)[0] & 0x6F == status
        poll.write(1, 2000, options=("-0", "-t", "4:int", "-B"))
        wait_for("motion", lambda: poll.read(17, 1, "-0", "-t", "4:int", "-B")[0] > 0)       # speed, 0.01 rpm
        # silence: the watchdog stops the shaft
        wait_for("rest", lambda: machine.watchdog.lost and abs(machine.inverter.speed_rad_s) < 0.005)
        assert poll.read(17)[0] & 0x6F == 0x07


# Register numbers from the manuals: as printed, for mbpoll, the value of a
# drive after power-on, and a write of one of its settings.
DOCUMENTED = [
    ("siemens/g120", "40110 status word ZSW1", (110, 1), (), [0xEA40]),
    ("siemens/g120", "40324 reference speed p2000, rpm", (324, 1), (), [1500]),
    ("siemens/g130-s120", "40110 status word ZSW1", (110, 1), (), [0xEA40]),
    ("siemens/g130-s120", "40100 to 40103 control word and setpoints", (100, 4), (), [0, 0, 0, 0]),
    ("abb/acs880-classic", "400004 status word", (4, 1), (), [0x1240]),
    ("abb/acs880-classic", "429202 46.01 speed scaling, 0.01 rpm, low word first", (29202, 2), (), [0x49F0, 0x0002]),
    ("abb/acs880-enhanced", "400051 status word", (51, 1), (), [0x1240]),
    ("abb/acs880-enhanced", "404601 speed scaling, rpm", (4601, 1), (), [1500]),
    ("schneider/atv320", "6005 TTO, 0.1 s, counted from 0", (6005, 1), ("-0",), [100]),
    ("schneider/atv320", "12741 scanner input 1, ETA", (12741, 1), ("-0",), [0x0250]),
    ("schneider/atv340-930", "12741 scanner input 1, ETA", (12741, 1), ("-0",), [0x0250]),
    ("yaskawa/ga700", "0435h H5-09, 0.1 s, counted from 0", (0x0435, 1), ("-0",), [20]),
    ("yaskawa/ga700", "002Ch status, ready", (0x002C, 1), ("-0",), [0x0042]),
    ("delta/ms300", "2226h status, ready", (0x2226, 1), ("-0",), [0x0005]),
    ("danfoss/fc302", "50200 STW, ready", (50200, 1), (), [0x0603]),
    ("danfoss/fc302", "8030, 8-03 time-out, 0.1 s, high word first", (8030, 2), (), [0, 10]),
    ("lenze/i550", "40105 = 6041h, counted from 1", (105, 1), (), [0x0250]),
]
SETTINGS = [
    ("abb/acs880-enhanced", "405003 50.03, 0.1 s", 5003, (), 4),
    ("schneider/atv320", "6005 TTO, 0.1 s", 6005, ("-0",), 3),
    ("delta/ms300", "0903h Pr.09-03, 0.1 s", 0x0903, ("-0",), 6),
]


@pytest.mark.parametrize("name", sorted({row[0] for row in DOCUMENTED}))
def test_documented_registers(name: str) -> None:
    line = load_modbus_profile(name).line.transports[0]
    with served(name, line) as (poll, machine):
        while machine.time_s < 0.2:                                              # standstill is detected after 0.1 s
            threading.Event().wait(0.02)
        for _, _, (register, count), options, words in (row for row in DOCUMENTED if row[0] == name):
            assert poll.read(register, count, *options) == words
        for _, _, register, options, value in (row for row in SETTINGS if row[0] == name):
            text = poll.write(register, value, options=(*options, "-t", "4"))
            assert "Written 1 references" in text, text
            assert poll.read(register, 1, *options) == [value]


def test_a_drive_without_function_6_replies_with_an_exception() -> None:
    """MEMOBUS has 03, 08 and 10h only; mbpoll writes one register with 06 and two with 10h."""
    with served("yaskawa/ga700", "rtu") as (poll, _):
        assert "Illegal function" in poll.write(2, 0, options=("-0", "-t", "4"))
        assert "Written 2 references" in poll.write(1, 0, 7, options=("-0", "-t", "4"))
        assert poll.read(1, 2, "-0") == [0, 7]
