"""Settings that `close` can't restore are named: those that it names are those that differ in the drive."""

import re
from pkgutil import resolve_name

import can
import pytest

from drivers.canopen.bus import CanLink
from drivers.canopen.sdo import SdoObjects
from drivers.clock import SteppedClock
from drivers.modbus.pdu import LinkLost
from tests.drivers.conftest import MAKERS
from tests.drivers.drive_benches import Run
from tests.drivers.test_drive_contract import mapped

GONE = "unplugged"


def lose_canopen(bench, after):
    send, sent = bench.bus.send, [0]

    def limited(message):
        sent[0] += 1
        if sent[0] > after:
            raise can.CanOperationError(GONE)
        send(message)

    bench.bus.send = limited


def lose_ethercat(bench, after):
    slave, sent = bench.slave, [0]
    write = slave._fpwr

    def limited(address, data, timeout_us=2000):
        sent[0] += 1
        slave.dead |= sent[0] > after
        return write(address, data, timeout_us)

    slave._fpwr = limited


def lose_modbus(bench, after):
    link, sent = bench.drive._link, [0]
    transact = link.transact

    def limited(unit, pdu, timeout_s):
        sent[0] += 1
        if sent[0] > after:
            raise LinkLost(GONE, where="line")
        return transact(unit, pdu, timeout_s)

    link.transact = limited


LOSE = {"CanopenBench": lose_canopen, "EthercatBench": lose_ethercat, "ModbusBench": lose_modbus}


@pytest.fixture(params=["canopen", "ethercat", "modbus"])
def run(request, open_bench):
    """Run on a bench of each bus."""
    return Run(open_bench(resolve_name(f"tests.drivers.{MAKERS[request.param]}")))


def places(bench):
    """Return the values in the drive by object or register, without the setpoints."""
    kind, found = type(bench), {}
    mode = (4,) if kind.__name__ == "ModbusBench" else ((0x6060, 0),)
    for key, value in (bench.settings((*kind.SETTINGS, *mode)) | mapped(bench.settings(kind.MAPPING))).items():
        found.setdefault(key.partition(":")[0], []).append(value)
    return found


def named(left):
    """Return the objects and registers that the lines name."""
    text = re.sub(r"register (\d+)\b(?!h)", lambda found: f"{int(found[1]):04X}h", "\n".join(left))
    return set(re.findall(r"\b[0-9A-F]{4}h", text))


def differing(before, after):
    return {place for place in before if before[place] != after[place]}


@pytest.mark.parametrize("after", [0, 1, 8, 30])
def test_a_link_that_fails_at_close_leaves_no_unnamed_setting(run, after):
    before = places(run.bench)
    run.turning(1.0, for_s=0.4)
    run.stop()
    LOSE[type(run.bench).__name__](run.bench, after)
    left = run.drive.close()
    differ = differing(before, places(run.bench))
    assert differ <= named(left)
    if after < 8:
        assert differ
        assert len(left) == 1          # one line for all of them
        # The last request may have arrived before its answer was lost.
        assert len((named(left) & set(before)) - differ) <= 1


def test_a_stop_that_is_not_confirmed_leaves_no_unnamed_setting(run):
    before = places(run.bench)
    run.turning(1.0, for_s=0.4)
    left = run.drive.close()
    differ = differing(before, places(run.bench))
    assert differ
    assert named(left) & set(before) == differ
    assert sum("PDO mapping" in line for line in left) == bool(type(run.bench).MAPPING)      # one group


def test_the_names_of_changes_without_a_name(wire, peer):
    """The objects of a mapping are shown together. What is no object is the watchdog's register."""
    objects = SdoObjects(CanLink(wire, SteppedClock()), 1)
    objects.on_restore(lambda: objects.write(0x1600, 0, 0, 8))
    objects.write(0x1600, 0, 0, 8)
    objects.change(0x6072, 0, 500, 16)
    objects.on_restore(lambda: objects.write(0x1A00, 0, 0, 8))
    objects.write(0x1A00, 0, 0, 8)
    assert objects.changed == ("6072h", "the PDO mapping (1600h, 1A00h)")
    objects.on_restore(lambda: None)
    assert objects.changed[1] == "the watchdog of the process data (register 0420h)"
    assert objects.restore() == ()
    assert objects.changed == ()
