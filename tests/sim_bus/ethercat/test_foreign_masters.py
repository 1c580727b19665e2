"""Foreign masters check the slave in its own process: SOEM (PyPI's pysoem) and KickCAT over a veth pair.

Skipped with the reason where a raw socket, a veth pair or the master is missing; TDHIL_REQUIRE_VETH=1 forbids that.
"""

import os
import shutil
import subprocess
import sys
import time
import uuid
import warnings
from collections.abc import Iterator
from contextlib import suppress
from datetime import timedelta
from importlib import import_module
from importlib.util import find_spec

import pytest

from tests.sim_bus.ethercat.host import inputs, outputs

pytestmark = pytest.mark.real_time
WHY = "no foreign EtherCAT master has judged the simulated drive: "
STARTING_S, SDO_S = 60.0, timedelta(seconds=5)


def skip(reason: str) -> None:
    if os.environ.get("TDHIL_REQUIRE_VETH") == "1":
        pytest.fail(f"{WHY}{reason}, and TDHIL_REQUIRE_VETH=1 forbids to skip", pytrace=False)
    warnings.warn(pytest.PytestWarning(f"SKIPPED: {WHY}{reason}"), stacklevel=1)
    pytest.skip(WHY + reason)


def ip(*words: str) -> str:
    """Run ip; return the error, or '' without one."""
    done = subprocess.run(["ip", *words], capture_output=True, text=True, timeout=60)
    return done.stderr.strip() if done.returncode else ""


@pytest.fixture
def interface() -> Iterator[str]:
    """Yield the host's end of a pair with a simulated drive at the other end."""
    if not sys.platform.startswith("linux") or shutil.which("ip") is None:
        skip("it needs Linux and the command ip")
    host, drive = (f"tde{uuid.uuid4().hex[:8]}{end}" for end in "hd")
    if wrong := ip("link", "add", host, "type", "veth", "peer", "name", drive):
        skip(f"no veth pair ({wrong})")
    try:
        for end in (host, drive):
            assert ip("link", "set", end, "up") == ""
        simulated = subprocess.Popen(
            [sys.executable, "-m", "sim_bus", "ethercat", "-i", drive, "--stepped", "--alias", "9"],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        try:
            assert simulated.stdout is not None and simulated.stderr is not None
            first = simulated.stdout.readline()
            if not first:
                skip(simulated.stderr.read().strip())
            assert first == f"ready: {drive} position 0: a simulator for tests, not a product slave\n"
            yield host
        finally:
            simulated.terminate()
            _, errors = simulated.communicate(timeout=STARTING_S)
            assert simulated.returncode == 0, errors
    finally:
        ip("link", "del", host)


def until(reached) -> None:
    end_s = time.monotonic() + STARTING_S
    while not reached():
        assert time.monotonic() < end_s


def test_soem(interface):
    if find_spec("pysoem") is None:
        skip("pysoem is not installed")
    pysoem = import_module("pysoem")
    master = pysoem.Master()
    master.sdo_read_timeout = master.sdo_write_timeout = 5_000_000
    master.open(interface)

    def sdo(transfer, *of):
        """Repeat a transfer on a busy computer, since SOEM abandons a frame after 2 ms, and then the transfer."""
        while True:
            try:
                return transfer(*of)
            except pysoem.WkcError:
                pass

    def found():
        return master.config_init() == 1 and master.slaves[0].name == "Generic CiA 402 drive"

    def mapped():
        with suppress(pysoem.ConfigMapError):
            master.config_map()
        return (len(slave.output), len(slave.input)) == (10, 14)

    try:
        until(found)
        slave = master.slaves[0]
        assert (slave.id, slave.rev) == (402, 0x10000)
        assert slave.eeprom_read(4)[:2] == b"\x09\x00"                        # the alias
        assert sdo(slave.sdo_read, 0x5FFE, 1) == b"tdhil simulated drive"
        text = bytes(65 + n % 26 for n in range(500))
        sdo(slave.sdo_write, 0x5FFE, 5, text)
        assert sdo(slave.sdo_read, 0x5FFE, 5, 512) == text
        sdo(slave.sdo_write, 0x5FFE, 3, (4000).to_bytes(4, "little"))
        with pytest.raises(pysoem.SdoError) as refused:
            sdo(slave.sdo_read, 0x2222, 0)
        assert refused.value.abort_code == 0x06020000
        mapping = [0x60400010, 0x60600008, 0x00000008, 0x60710010, 0x60FF0020]
        sdo(slave.sdo_write, 0x1C12, 0, b"\0")
        sdo(slave.sdo_write, 0x1600, 0, b"\0")
        for number, entry in enumerate(mapping, 1):
            sdo(slave.sdo_write, 0x1600, number, entry.to_bytes(4, "little"))
        sdo(slave.sdo_write, 0x1600, 0, bytes((len(mapping),)))
        sdo(slave.sdo_write, 0x1C12, 1, (0x1600).to_bytes(2, "little"))
        sdo(slave.sdo_write, 0x1C12, 0, b"\1")
        until(mapped)
        assert master.config_dc()
        slave.set_watchdog("processdata", 200.0)
        assert master.state_check(pysoem.SAFEOP_STATE, 5_000_000) == pysoem.SAFEOP_STATE

        def cycle(word=0, mode=0, speed=0):
            slave.output = outputs(word, mode, speed=speed)
            master.send_processdata()
            return master.receive_processdata(1_000_000)

        cycle()
        master.state = pysoem.OP_STATE
        master.write_state()
        until(lambda: cycle() == 3 and master.state_check(pysoem.OP_STATE, 50_000) == pysoem.OP_STATE)
        for word in (0x06, 0x07, 0x0F):
            assert cycle(word, 9) == master.expected_wkc == 3
        for step in range(300):
            assert cycle(0x0F, 9, step) == 3
        word, mode, torque, speed, _position = inputs(slave.input)
        assert (word & 0x6F, mode) == (0x27, 9)
        assert 50 < speed < 300 and torque > 0
        master.state = pysoem.INIT_STATE
        master.write_state()
        assert master.state_check(pysoem.INIT_STATE, 5_000_000) == pysoem.INIT_STATE
    finally:
        master.close()


@pytest.mark.heavy
def test_kickcat(interface):
    if find_spec("kickcat") is None:
        skip("kickcat is not installed")
    kickcat = import_module("kickcat")
    status = kickcat.mailbox.request.MessageStatus

    def patient(act, *of):
        """Repeat a call on a busy computer, since KickCAT abandons a frame after its time-out."""
        end_s = time.monotonic() + STARTING_S
        while True:
            try:
                return act(*of)
            except RuntimeError:
                if time.monotonic() > end_s:
                    raise

    def start():
        link = kickcat.create_link(interface, "")
        link.set_timeout(timedelta(milliseconds=20))      # it waits for that long on each frame of its start
        bus = kickcat.Bus(link)
        bus.init(timedelta(seconds=1))
        return bus

    bus = patient(start)
    (slave,) = bus.slaves()

    def read(index, sub, size=4):
        return patient(bus.read_sdo, slave, index, sub, kickcat.Access.PARTIAL, size, SDO_S)

    def write(index, sub, data):
        message = slave.mailbox.write_sdo(index, sub, False, data, SDO_S)
        until(lambda: patient(bus.process_mailboxes) is not None or message.status() != status.RUNNING)
        assert message.status() == status.SUCCESS

    def reach(state):
        bus.request_state(state)
        bus.wait_for_state(state, SDO_S, bus.process_data_no_check)

    assert read(0x1008, 0, 64) == b"Generic CiA 402 drive"
    write(0x5FFE, 3, (4000).to_bytes(4, "little"))
    assert read(0x5FFE, 3) == b"\xa0\x0f\x00\x00"
    patient(bus.create_mapping)
    assert (slave.output_size, slave.input_size) == (10, 14)
    patient(reach, kickcat.State.SAFE_OP)
    slave.set_output_bytes(outputs(0, 0))
    patient(reach, kickcat.State.OPERATIONAL)
    for word in (0x06, 0x07, 0x0F):
        slave.set_output_bytes(outputs(word, 10))
        patient(bus.process_data)
    for _ in range(100):
        slave.set_output_bytes(outputs(0x0F, 10, torque=60))
        patient(bus.process_data)
    word, mode, torque, _speed, _position = inputs(slave.input_data)
    assert (word & 0x6F, mode) == (0x27, 10)
    assert torque > 20
