"""Particulars of EtherCAT: working counter, AL states, watchdog registers, PDOs, clocks, raw datagrams."""

import errno
import socket
import struct

import pytest

from drivers.cia402.cycle_period import interpolation
from drivers.clock import SteppedClock
from drivers.drive import Outcome, PowerState
from drivers.errors import CommunicationLost, DriveFault, PreflightRefused
from drivers.ethercat import raw, scan
from drivers.ethercat.quick_stop import EthercatTarget
from drivers.ethercat.scan import found_slave, stations_at
from drivers.ethercat.segment import EthercatSegment
from drivers.quick_stop import Ended, bare_stop
from profiles import MessageCode
from profiles.library import load_profile
from tests.drivers.drive_benches import LIMITS, Run
from tests.drivers.ethercat_bench import EthercatBench
from tests.drivers.fake_soem import FakeMaster, FakeSlave


@pytest.fixture
def bench():
    return EthercatBench()


@pytest.fixture
def turning(bench):
    run = Run(bench)
    run.turning(1.0, 0.4)
    return run


def error_of(run, cycles=400):
    """Return the first error of the following cycles."""
    for _ in range(cycles):
        try:
            run.cycle(speed=1.0)
        except (CommunicationLost, DriveFault) as error:
            return error
    raise AssertionError("no error")


def row(found, name):
    return next(check for check in found.checks if check.name == name)


# -- the cycle ---------------------------------------------------------------------------------------------------------


def test_a_lost_frame_is_a_cycle_without_feedback(turning):
    missed = turning.drive.counters.missed
    for _ in range(10):
        turning.bench.slave.lost = 1
        before = turning.samples[-1]
        lost = turning.cycle(speed=1.0)
        assert not lost.fresh
        assert lost.speed_rad_s == before.speed_rad_s
        assert all(turning.cycle(speed=1.0).fresh for _ in range(9))
    assert turning.drive.counters.missed == missed + 10


def test_a_wrong_working_counter_is_lost_feedback_and_ends_the_run(turning):
    turning.bench.master.counter = 1
    assert not turning.cycle(speed=1.0).fresh
    error = error_of(turning)
    assert isinstance(error, CommunicationLost)
    assert "right working counter" in error.what


def test_a_slave_that_vanishes_is_reported(turning):
    turning.bench.slave.dead = True
    error = error_of(turning)
    assert (error.entry, "working counter" in error.what) == (MessageCode.FEEDBACK_LOST, True)
    turning.drive.quick_stop()
    assert turning.drive.poll() is None                         # it raises nothing, so that a stop continues


@pytest.mark.parametrize(("state", "code", "entry", "said"), [
    (4, 0x001A, MessageCode.STATE_LEFT, "SAFE-OP, AL status code 001Ah (synchronization error)"),
    (4, 0x001B, MessageCode.WATCHDOG_ACTED, "AL status code 001Bh (sync manager watchdog)"),
    (2, 0x9999, MessageCode.STATE_LEFT, "PRE-OP, AL status code 9999h (see the manual of the drive)"),
])
def test_an_al_error_is_reported_with_its_code(turning, state, code, entry, said):
    turning.bench.slave.fall(state, code)
    error = error_of(turning)
    assert error.entry is entry
    assert said in error.what


@pytest.mark.parametrize(("state", "entry"), [(4, MessageCode.FOREIGN_MASTER), (1, MessageCode.DRIVE_RESTARTED)])
def test_an_al_state_without_an_error_is_another_masters(turning, state, entry):
    turning.bench.slave.number(0x0130, state)
    assert error_of(turning).entry is entry


def test_an_emergency_ends_the_run(turning):
    turning.bench.slave.emergency(0x4310)
    error = error_of(turning)
    assert isinstance(error, DriveFault)
    assert "4310" in error.what


def test_an_emergency_about_an_al_state_adds_nothing(turning):
    turning.bench.slave.emergency(0xA000)
    turning.go(0.3, speed=1.0)


def test_each_error_is_raised_once_and_the_stop_continues(turning):
    turning.bench.slave.emergency(0x4310)
    error_of(turning)
    turning.stop()


def test_outside_of_op_the_drive_is_stopped_and_disabled_by_sdo(turning):
    """It accepts no setpoints there, although the working counter is right."""
    turning.bench.slave.fall(4, 0x001A)
    error_of(turning)
    turning.stop()
    assert turning.bench.slave.state & 0xF == 4
    assert turning.bench.slave.application.controlword == 0


# -- the watchdog ------------------------------------------------------------------------------------------------------


def test_the_watchdog_is_armed_and_read_back(bench):
    run = Run(bench)
    found = run.ready()
    assert row(found, "watchdog").found == "500 ms"
    assert bench.slave.number(0x0420) == 5000                   # of 100 µs, by the divider of 2498


def test_a_watchdog_that_was_changed_is_written_back_and_ends_the_run(turning):
    turning.bench.slave.number(0x0420, 0)
    error = error_of(turning)
    assert "registers 0400h, 0420h were 2498, 5000, and are 2498, 0 now" in error.what
    assert turning.bench.slave.number(0x0420) == 5000


def test_a_watchdog_beyond_its_range_is_refused(bench):
    bench.slave.number(0x0400, 0)                               # 80 ns: at most 5.2 ms
    bench.drive.connect()
    found = bench.drive.preflight(LIMITS)
    assert "its longest time is 0.00524 s" in row(found, "watchdog").found
    assert found.watchdog_s == 0.0


def test_setpoints_that_do_not_trigger_the_watchdog_are_refused(bench):
    bench.slave.memory[0x0814] &= ~0x40
    bench.drive.connect()
    with pytest.raises(PreflightRefused, match="do not trigger the watchdog"):
        bench.drive.preflight(LIMITS)


def test_after_stop_feeding_no_setpoint_is_sent_but_feedback_comes(turning, monkeypatch):
    monkeypatch.setattr("drivers.ethercat.drive.time.sleep", lambda _: None)
    turning.bench.heard()
    turning.drive.stop_feeding()
    assert turning.go(0.1, speed=1.0).fresh
    turning.drive.poll()
    assert [identifier for identifier, _ in turning.bench.heard() if identifier in (2, 3)] == []
    assert turning.bench.slave.drive.data[0x5FFE, 2] == b"\0"    # the simulated drive continues in its own time
    turning.drive.quick_stop()
    turning.bench.slave.fall(4, 0x001B)
    assert error_of(turning).entry is MessageCode.WATCHDOG_ACTED
    turning.drive.disable()
    turning.go(0.1)
    assert abs(turning.bench.true_speed_rad_s) > 0.1
    assert turning.samples[-1].state is PowerState.QUICK_STOP    # without torque it would coast
    turning.bench.slave.advance(5.0)
    turning.until(lambda sample: sample.state is PowerState.OFF, 0.1)
    heard = turning.bench.heard()
    assert {identifier for identifier, _ in heard} == {0, 1}     # only process data feed the watchdog
    turning.go(0.1)
    assert turning.bench.heard() == []


def test_after_stop_feeding_the_torque_is_removed_at_any_speed(turning, monkeypatch):
    monkeypatch.setattr("drivers.ethercat.drive.time.sleep", lambda _: None)
    turning.drive.quick_stop()
    turning.drive.stop_feeding()
    turning.bench.heard()
    turning.drive.remove_torque()
    turning.until(lambda sample: sample.state is PowerState.OFF, 0.1)
    assert abs(turning.bench.true_speed_rad_s) > 0.1
    assert {identifier for identifier, _ in turning.bench.heard()} == {0, 1}


def test_a_poll_never_enables_again(turning):
    turning.drive.poll()
    assert turning.drive._bus._setpoints.word == 0x0002
    assert turning.bench.slave.application.controlword == 0x000F         # it sends nothing in stepped time


def test_a_quick_stop_that_is_not_executed_stays_in_the_process_data(turning):
    bus = turning.drive._bus
    assert bus.disable_setpoints() == 0
    bus.put(0x6040, 0, (0x0007).to_bytes(2, "little"))
    bus.receive(0.0, True)
    sent = [data for identifier, data in turning.bench.slave.heard if identifier == 2]
    assert sent[-1][:8] == struct.pack("<Hhi", 0x0007, 0, 0)


# -- before motion -----------------------------------------------------------------------------------------------------


def test_a_slave_whose_sii_and_objects_differ_is_refused(bench):
    bench.slave.id = 99
    with pytest.raises(PreflightRefused, match="the SII names vendor 4h and product 63h"):
        bench.drive.connect()


@pytest.mark.parametrize(("slaves", "options", "said"), [
    (0, {}, "no EtherCAT slave answers"),
    (1, {"position": 1}, "no slaves are at position 1; 1 answer"),
    (2, {"alias": 7}, "no slaves are with station alias 7"),
    (2, {"alias": 5}, "2 slaves are with station alias 5"),
])
def test_a_drive_that_is_not_there_is_refused(slaves, options, said):
    master = FakeMaster(*(FakeSlave(alias=5) for _ in range(slaves)))
    with pytest.raises(PreflightRefused, match=said):
        EthercatSegment(master, "fake0", **options)


def test_a_drive_is_found_by_its_alias():
    segment = EthercatSegment(FakeMaster(FakeSlave(alias=5), FakeSlave(alias=7)), "fake0", alias=7)
    assert segment.position == 1


def test_the_interface_is_closed_once(bench):
    closed = []
    bench.master.close = lambda: closed.append(True)
    bench.segment.close()
    bench.segment.close()
    assert closed == [True]


def test_a_refused_state_is_reported_with_its_code(bench, monkeypatch):
    write = bench.slave._fpwr

    def refuses(address, data, timeout_us=2000):
        if address == 0x0120 and data[0] == 8:
            bench.slave.number(0x0130, 0x14)
            bench.slave.number(0x0134, 0x0030)
        else:
            write(address, data)

    monkeypatch.setattr(bench.slave, "_fpwr", refuses)
    bench.drive.connect()
    with pytest.raises(PreflightRefused, match=r"to OP: it shows SAFE-OP, AL status code 0030h \(invalid DC SYNC"):
        bench.drive.preflight(LIMITS)


@pytest.mark.parametrize("latency", [0, 1, 4, 20])
def test_after_an_al_error_the_settings_are_restored_for_a_slave_that_needs_time(latency):
    """AL control takes one request at a time: the slave ignores a second write before its firmware has read it."""
    bench = EthercatBench()
    before = bench.settings()
    run = Run(bench)
    run.turning(1.0, 0.4)
    bench.slave.latency = latency
    bench.slave.fall(4, 0x001B)
    error_of(run)
    run.stop()
    assert run.drive.close() == ()
    assert (bench.slave.state, bench.slave.ignored) == (2, [])
    assert bench.settings() == before


@pytest.mark.parametrize("latency", [0, 4])
def test_an_error_that_follows_the_acknowledgement_is_a_refusal(bench, latency, monkeypatch):
    slave = bench.slave
    slave.latency = latency
    slave.fall(4, 0x001B)
    firmware = slave.firmware

    def refuses():
        if slave.wanted == 2 and not slave.waits:
            slave.wanted = None
            slave.fall(4, 0x0011)
        firmware()

    monkeypatch.setattr(slave, "firmware", refuses)
    with pytest.raises(DriveFault, match=r"to PRE-OP: it shows SAFE-OP, AL status code 0011h"):
        bench.segment.station.reach(2)


def test_an_error_that_is_not_cleared_ends_the_wait(bench, monkeypatch):
    monkeypatch.setattr("drivers.ethercat.station.STATE_S", 0.01)
    bench.slave.fall(4, 0x001B)
    bench.slave.firmware = lambda: None
    with pytest.raises(DriveFault, match=r"to PRE-OP: it shows SAFE-OP, AL status code 001Bh"):
        bench.segment.station.reach(2)


def with_fixed_pdos(bench, rx, tx):
    """Give the slave PDOs with a fixed content, and name them in the profile."""
    for base, pdos in ((0x1600, rx), (0x1A00, tx)):
        for number, entries in enumerate(pdos):
            bench.slave.objects(base + number, 4, entries)
    profile = load_profile("generic/cia402-ethercat")
    cyclic = profile.cyclic.model_copy(update={
        "fixed": True, "rx_pdos": tuple(0x1600 + k for k in range(len(rx))),
        "tx_pdos": tuple(0x1A00 + k for k in range(len(tx))),
    })
    bench.drive._bus._profile = profile.model_copy(update={"cyclic": cyclic})


def test_fixed_pdos_are_used_in_their_own_order(bench):
    with_fixed_pdos(bench, [[0x60FF0020], [0x60600008, 0x00000008, 0x60710010], [0x60400010]],
                    [[0x60610008, 0x606C0020], [0x60770010], [0x60410010]])
    run = Run(bench)
    run.ready()
    run.enable()
    last = run.go(3.0, speed=2.0)
    assert last.speed_rad_s == pytest.approx(2.0, abs=0.05)
    assert last.state is PowerState.ENABLED


def test_fixed_pdos_without_an_object_that_is_needed_are_refused(bench):
    with_fixed_pdos(bench, [[0x60400010, 0x60FF0020, 0x60600008]], [[0x60410010, 0x606C0020, 0x60610008]])
    bench.drive.connect()
    check = row(bench.drive.preflight(LIMITS), "PDO mapping")
    assert check.outcome is Outcome.REFUSED
    assert "do not carry 6071h, 6077h" in check.found


@pytest.mark.parametrize(("period_s", "wanted"), [
    (0.001, (1, -3)), (0.004, (4, -3)), (0.05, (50, -3)), (0.00125, (125, -5)), (0.0005, (5, -4)),
])
def test_the_period_of_the_setpoints(period_s, wanted):
    assert interpolation(period_s) == wanted


def test_another_rate_is_set_in_pre_op(bench):
    run = Run(bench)
    run.ready()
    run.drive.set_rate(125.0)
    assert (bench.settings(((0x60C2, 1),)), bench.slave.state) == ({"60C2h:1": 8}, 8)


# -- distributed clocks ------------------------------------------------------------------------------------------------


class DriftingClock(SteppedClock):
    """Control time with drift for a loop that is never late. It is not stepped."""

    stepped = False


def test_the_cycle_follows_the_clock_of_the_segment():
    clock = DriftingClock()
    bench = EthercatBench(clock=clock, clocks=True, rate_hz=250.0)
    bench.slave.dc_sync = lambda *asked: bench.slave.sync0.append(asked)
    type(bench.master).dc_time = property(lambda self: round(clock.now_s() * (1.0 + 200e-6) * 1e9) + 900_000)
    try:
        run = Run(bench)
        run.ready()
        assert bench.slave.sync0 == [(True, 4_000_000)]
        run.go(12.0)                                             # 2.4 ms of drift
        assert bench.master.dc_time % 4_000_000 == pytest.approx(2_000_000, abs=100_000)
        run.drive.close()
        assert bench.slave.sync0[-1] == (False, 0)
    finally:
        type(bench.master).dc_time = 0


# -- the bare stop, and the scan ---------------------------------------------------------------------------------------


def test_a_bare_stop_keeps_the_al_state(turning, monkeypatch):
    slave, clock = turning.bench.slave, SteppedClock()
    target = EthercatTarget(turning.bench.segment.station, load_profile("generic/cia402-ethercat"), clock,
                            lambda: None)

    def wait_until(time_s):
        slave.advance(max(0.0, time_s - clock.now_s()))
        return SteppedClock.wait_until(clock, time_s)

    monkeypatch.setattr(clock, "wait_until", wait_until)
    report = bare_stop(target, clock)
    assert report.ended is Ended.AT_REST
    assert abs(turning.bench.true_speed_rad_s) < 0.01
    assert slave.state == 8


def test_a_stop_that_is_reversed_takes_the_drive_out_of_op(turning):
    target = EthercatTarget(turning.bench.segment.station, load_profile("generic/cia402-ethercat"), SteppedClock(),
                            lambda: None)
    target.enforce(5)
    assert turning.bench.slave.state == 8
    target.enforce(6)
    assert turning.bench.slave.state == 4
    assert "was put into SAFE-OP" in target.remarks()[0]


def test_a_stop_that_is_reversed_acknowledges_an_error_first(turning):
    slave = turning.bench.slave
    slave.latency = 4
    slave.fall(8, 0x0012)
    target = EthercatTarget(turning.bench.segment.station, load_profile("generic/cia402-ethercat"), SteppedClock(),
                            lambda: None)
    target.enforce(6)
    assert (slave.state, target.remarks()) == (0x18, ())
    for attempt in range(7, 13):
        target.enforce(attempt)
    assert slave.state == 4
    assert "was put into SAFE-OP" in target.remarks()[0]


@pytest.mark.parametrize("name", ["maxon/epos4-ethercat", "elmo/gold-ethercat"])
def test_a_drive_that_keeps_torque_mode_is_taken_out_of_op_too(turning, name):
    """Another master enables the drive after each quick stop. Mode of operation 6060h is refused while enabled."""
    slave, clock, attempts = turning.bench.slave, SteppedClock(), []
    slave.drive.acts[0x6060, 0](10)
    write = slave.drive.write

    def refuses(key, data):
        if key == (0x6060, 0):
            raise KeyError(key)
        write(key, data)
        if key == (0x6040, 0) and slave.state == 8:
            write(key, b"\x0f\0")

    slave.drive.write = refuses

    class Target(EthercatTarget):
        def enforce(self, attempt):
            attempts.append(attempt)
            super().enforce(attempt)

    target = Target(turning.bench.segment.station, load_profile(name), clock, lambda: None)
    report = bare_stop(target, clock, 2.0)
    assert attempts[:6] == [1, 2, 3, 4, 5, 6]
    assert slave.state == 4
    assert report.last.state is PowerState.QUICK_STOP
    assert any("was put into SAFE-OP" in line for line in report.remarks)
    assert any("6060h" in line for line in report.remarks) is (name == "maxon/epos4-ethercat")


def test_a_scan_reads_the_identity_of_a_slave(bench):
    found = found_slave(0, bench.segment.station)
    assert (found.identity, found.title, found.simulated) == ((4, 4, 3, 4), "objects behind a mailbox", True)
    assert found_slave(0, bench.segment.station, driven=True).device_type is None      # its master has its mailbox
    bench.slave.number(0x0130, 1)
    assert found_slave(0, bench.segment.station).device_type is None


# -- raw datagrams -----------------------------------------------------------------------------------------------------


class Wire:
    """Socket on which one slave or no slave replies."""

    def __init__(self, status=8, answers=True):
        self.status, self.answers, self.came = status, answers, []

    def bind(self, address):
        self.bound = address

    def send(self, frame):
        assert frame[12:14] == b"\x88\xa4"
        assert len(frame) >= 60
        if self.answers:
            back = bytearray(frame)
            size = struct.unpack_from("<H", frame, 22)[0] & 0x7FF
            if frame[16] != 2:
                back[26 : 26 + size] = self.status.to_bytes(2, "little").ljust(size, b"\0")
            back[26 + size] = 1
            self.came += [bytes(60), bytes(back)]                # a frame of another master comes first

    def settimeout(self, seconds):
        pass

    def recv(self, size):
        if not self.came:
            raise TimeoutError
        return self.came.pop(0)

    def close(self):
        pass


@pytest.fixture
def wired(monkeypatch):
    def make(**options):
        wire = Wire(**options)
        monkeypatch.setattr(raw.socket, "socket", lambda *_: wire)
        monkeypatch.setattr(raw, "ANSWER_S", 0.001)
        return raw.RawSegment("eth9")

    return make


@pytest.mark.parametrize(("status", "driven"), [(8, True), (4, False), (0x14, False), (2, False), (1, False)])
def test_a_segment_that_another_master_drives_is_refused(wired, status, driven):
    segment = wired(status=status)
    assert len(segment.stations()) == 1
    if driven:
        with pytest.raises(PreflightRefused, match="another master drives this segment"):
            raw.refuse_driven(segment)
    else:
        raw.refuse_driven(segment)


def test_a_segment_without_slaves(wired):
    segment = wired(answers=False)
    assert segment.stations() == []
    with pytest.raises(CommunicationLost, match="no frame comes back"):
        raw.RawStation(segment, 0).al_status()


def test_a_scan_of_a_segment_without_slaves_is_an_error(wired):
    wired(answers=False)
    with pytest.raises(CommunicationLost, match="no EtherCAT slave answers"), stations_at("eth9"):
        pass


@pytest.mark.parametrize(("status", "driven"), [(8, True), (2, False)])
def test_a_scan_leaves_a_segment_that_another_master_drives(wired, bench, monkeypatch, status, driven):
    wired(status=status)
    monkeypatch.setattr(scan, "open_segment", lambda interface: bench.segment)
    with stations_at("eth9") as (stations, text):
        assert (bench.segment.stations != stations) is driven
        assert ("another master drives this segment" in text) is driven is bool(text)


@pytest.mark.parametrize(("error", "said"), [
    (PermissionError(errno.EPERM, "not permitted"), "setcap"), (OSError(errno.ENODEV, "No such device"), "ip"),
])
def test_an_interface_that_cannot_be_opened(monkeypatch, error, said):
    def refuses(*_):
        raise error

    monkeypatch.setattr(raw.socket, "socket", refuses)
    with pytest.raises(PreflightRefused) as caught:
        raw.RawSegment("eth9")
    assert said in caught.value.next_step


def test_a_system_without_raw_sockets(monkeypatch):
    monkeypatch.delattr(socket, "AF_PACKET")
    with pytest.raises(PreflightRefused, match="no raw sockets"):
        raw.RawSegment("eth9")
