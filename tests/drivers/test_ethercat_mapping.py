"""Mapping of the process data while frames are lost, over the fake of pysoem."""

import itertools
import struct

import pytest

from drivers.errors import CommunicationLost, PreflightRefused
from drivers.ethercat import raw
from drivers.ethercat import segment as segments
from drivers.ethercat.segment import MAP_TRIES, START_TRIES, EthercatSegment
from profiles import MessageCode
from tests.drivers.drive_benches import Run
from tests.drivers.ethercat_bench import EthercatBench
from tests.drivers.fake_soem import FakeMaster, FakeSlave

OUTPUTS, INPUTS = 9, 11
"""Bytes of the process data of the fake, which has no position."""
MISREAD = [(0, INPUTS), (OUTPUTS, 7), (OUTPUTS, INPUTS - 2), (0, 0), (OUTPUTS, 0)]
"""Sizes that SOEM reads if one of its SDO requests has no answer."""


@pytest.fixture
def bench():
    return EthercatBench()


def forget_pdos(slave):
    """Assign the PDOs of the delivered drive, as some drives do in INIT."""
    slave.objects(0x1C12, 2, [0x1601])
    slave.objects(0x1C13, 2, [0x1A01])
    slave.objects(0x1600, 4, [])
    slave.objects(0x1A00, 4, [])


def preflight(bench):
    bench.drive.connect()
    return bench.drive.preflight(bench.limits)


@pytest.mark.parametrize("sizes", MISREAD)
def test_a_disturbed_mapping_is_repeated_from_the_start(bench, sizes):
    """All values are in their places afterwards, although the slave has lost its assignment."""
    bench.master.misread, bench.master.on_restart = [sizes], forget_pdos
    run = Run(bench)
    run.turning(1.0, 2.0)
    assert bench.master.starts == 2
    assert (bench.slave.length(0x1C12), bench.slave.length(0x1C13)) == (OUTPUTS, INPUTS)
    assert run.samples[-1].speed_rad_s == pytest.approx(bench.true_speed_rad_s, abs=0.05)
    steps = [abs(b.speed_rad_s - a.speed_rad_s) for a, b in itertools.pairwise(run.samples)]
    assert max(steps) < 0.1


def test_a_mapping_without_disturbance_starts_the_segment_once(bench):
    preflight(bench)
    assert bench.master.starts == 1


def test_a_mapping_that_differs_each_time_is_a_lost_connection(bench):
    bench.master.misread = MISREAD[:MAP_TRIES]
    with pytest.raises(CommunicationLost, match="frames were lost or late") as caught:
        preflight(bench)
    assert "SOEM read 0 and 11 bytes where 9 and 11 are assigned" in caught.value.what
    assert bench.master.starts == MAP_TRIES
    assert not any(identifier == 2 for identifier, _ in bench.heard())       # no setpoints were sent


def test_a_mapping_that_is_wrong_each_time_in_the_same_way_is_the_drives(bench):
    bench.master.misread = [(OUTPUTS, 7)] * MAP_TRIES
    with pytest.raises(PreflightRefused, match="9 and 7 bytes where 9 and 11 are assigned each time") as caught:
        preflight(bench)
    assert caught.value.entry is MessageCode.PDO_NOT_POSSIBLE


def stale_fmmu(slave):
    """Leave an FMMU of an earlier mapping active, which reads the inputs too."""
    struct.pack_into("<IHBBHBBB", slave.memory, 0x0600 + 16 * slave.fmmus, 0, INPUTS, 0, 7, 0x1300, 0, 1, 1)


def lost_fmmu(slave):
    """Lose the frame that writes the FMMU of the inputs."""
    slave.memory[0x0610:0x0620] = bytes(16)


def overlapping_fmmus(slave):
    """Map the inputs to the logical addresses of the outputs."""
    struct.pack_into("<I", slave.memory, 0x0610, 4)


def foreign_fmmu(slave):
    """Leave an FMMU active that maps other memory to the same logical addresses."""
    struct.pack_into("<IHBBHBBB", slave.memory, 0x0600 + 16 * slave.fmmus, OUTPUTS + 4, 2, 0, 7, 0x1000, 0, 1, 1)


def lost_sync_manager(slave):
    """Lose the frame that writes sync manager 3."""
    slave.number(0x081A, 0)


@pytest.mark.parametrize("wrong", [stale_fmmu, foreign_fmmu, lost_fmmu, overlapping_fmmus, lost_sync_manager])
def test_registers_that_do_not_map_the_assigned_bytes_are_found(bench, wrong):
    def once(slave):
        if bench.master.starts == 1:
            wrong(slave)

    bench.master.after_map = once
    preflight(bench)
    assert bench.master.starts == 2
    assert {(one.physical, one.length, one.kind) for one in bench.segment.station.fmmus()} == {
        (0x1200, OUTPUTS, 2), (0x1300, INPUTS, 1)}


def test_a_second_mapping_without_a_start_is_not_accepted(bench):
    """SOEM keeps the FMMUs of the first mapping, and the place of its inputs: the values would be those of others."""
    preflight(bench)
    assert "FMMUs" in bench.segment._wrong_map(OUTPUTS, INPUTS)


@pytest.mark.parametrize(("forget", "where", "said"), [
    (lambda slave: slave.drive.data.update({(0x6085, 0): bytes(4)}), "6085h", "when the bus was started anew"),
    (lambda slave: slave.number(0x0420, 1000), "fake0, position 0", "0400h and 0420h"),
])
def test_a_drive_that_lost_a_setting_is_refused(bench, forget, where, said):
    bench.master.misread, bench.master.on_restart = [MISREAD[0]], forget
    with pytest.raises(PreflightRefused, match=said) as caught:
        preflight(bench)
    assert caught.value.where == where


def test_a_drive_with_other_pdos_after_the_start_is_refused(bench, monkeypatch):
    """The speed takes the place of the torque."""
    bench.master.misread = [MISREAD[0]]
    bench.drive.connect()
    objects = bench.drive._bus.objects
    read = objects.read

    def swapped(index, subindex=0, **options):
        other = {2: 3, 3: 2}.get(subindex, subindex) if index == 0x1A00 and bench.master.starts > 1 else subindex
        return read(index, other, **options)

    monkeypatch.setattr(objects, "read", swapped)
    with pytest.raises(PreflightRefused, match="other process data after a second start"):
        bench.drive.preflight(bench.limits)


# -- the start ---------------------------------------------------------------------------------------------------------


def starts_with(**lost):
    """Return a master whose first start doesn't read these of the slave."""
    slave = FakeSlave()
    master, whole = FakeMaster(slave), {name: getattr(slave, name) for name in lost}
    start = master.config_init

    def config_init():
        found = start()
        for name, value in (lost if master.starts == 1 else whole).items():
            setattr(slave, name, value)
        return found

    master.config_init = config_init
    return master


@pytest.mark.parametrize("lost", [{"man": 0}, {"id": 0}, {"dead": True}])
def test_a_start_without_identity_or_answer_is_repeated(lost):
    master = starts_with(**lost)
    segment = EthercatSegment(master, "fake0")
    assert (master.starts, segment.slave.man, segment.slave.id) == (2, 1, 2)


def test_a_slave_without_a_mailbox_is_started_a_few_times_only():
    slave = FakeSlave()
    slave.number(0x0802, 0)
    master = FakeMaster(slave)
    EthercatSegment(master, "fake0")
    assert master.starts == START_TRIES


def test_a_slave_that_never_answers_is_a_lost_connection():
    slave = FakeSlave()
    slave.dead = True
    with pytest.raises(CommunicationLost, match="does not answer"):
        EthercatSegment(FakeMaster(slave), "fake0")


def test_another_number_of_slaves_after_a_start_is_refused(bench):
    bench.master.misread = [MISREAD[0]]
    bench.drive.connect()
    bench.master.present = (bench.slave, FakeSlave())
    with pytest.raises(PreflightRefused, match="2 slaves answer, 1 before"):
        bench.drive.preflight(bench.limits)


def test_a_segment_that_vanishes_while_mapping_is_reported_without_a_traceback(bench):
    bench.master.misread = [MISREAD[0]]
    bench.drive.connect()
    bench.master.present = ()
    with pytest.raises(PreflightRefused, match="no EtherCAT slave answers"):
        bench.drive.preflight(bench.limits)
    assert bench.drive.poll() is None
    assert bench.drive.close()


def test_pysoem_does_not_start_a_segment_whose_master_cannot_be_seen(monkeypatch):
    """Its start would set all slaves to INIT."""
    monkeypatch.setattr(segments, "RawSegment", lambda interface: raw.RawSegment.__new__(raw.RawSegment))
    monkeypatch.setattr(raw.RawSegment, "stations", lambda self: [])
    monkeypatch.setattr(raw.RawSegment, "close", lambda self: None)
    with pytest.raises(PreflightRefused, match="no EtherCAT slave answers"):
        segments.open_segment("fake0")
