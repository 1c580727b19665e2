"""Slave controller: commands and working counters, registers, SII, states and their codes, watchdog, clock."""

import struct

import pytest

from tests.sim_bus.ethercat import host as by_hand
from tests.sim_bus.ethercat.host import (
    APRD,
    APRW,
    ARMW,
    BRD,
    BRW,
    BWR,
    FPRD,
    FPRW,
    FPWR,
    FRMW,
    INIT,
    LRD,
    LRW,
    LWR,
    OP,
    PREOP,
    SAFEOP,
    STATION,
    Host,
    datagram,
    enabled,
    frame,
    outputs,
    running,
)


@pytest.mark.parametrize(("command", "position", "counter", "after"), [
    (APRD, 0, 1, 1), (APRD, 3, 0, 4), (APRD, 0xFFFF, 0, 0), (APRW, 0, 3, 1), (BRD, 0, 1, 1), (BWR, 5, 1, 6),
    (BRW, 0, 3, 1), (FPRD, STATION, 1, STATION), (FPRD, 0x1002, 0, 0x1002), (FPRW, STATION, 3, STATION),
    (ARMW, 0, 1, 1), (ARMW, 2, 1, 3), (FRMW, STATION, 1, STATION), (FRMW, 9, 1, 9), (0, 0, 0, 0), (15, 0, 0, 0),
])
def test_each_command_counts_and_increments_the_position(command, position, counter, after):
    host = Host().preop()
    answer = host.simulator.answer(frame(datagram(command, (position, 0x0910), bytes(8))), 1.0)
    assert (struct.unpack_from("<H", answer, 18)[0], struct.unpack_from("<H", answer, 34)[0]) == (after, counter)


def test_a_frame_keeps_its_length_and_is_marked_by_the_slave():
    host = Host()
    sent = frame(datagram(BRD, (0, 0), bytes(2), more=True), datagram(APRD, (0, 4), bytes(1)))
    answer = host.simulator.answer(sent, 1.0)
    assert len(answer) == len(sent)
    assert answer[6] == sent[6] | 2
    assert answer[26] == 0x11 and answer[28:30] == b"\1\0" and answer[40] == 8
    foreign = sent[:12] + b"\x08\x00" + sent[14:]
    assert host.simulator.answer(foreign, 1.0) == foreign
    assert host.simulator.answer(b"short", 1.0) == b"short"


def test_a_broadcast_read_adds_its_bits_to_those_of_others():
    assert Host().ask(BRD, (0, 0x0130), b"\x08\x00") == (b"\x09\x00", 1)


def test_a_refused_write_keeps_the_value_and_the_counter():
    host = Host().preop()
    assert host.write(0x0000, 0xFFFF) == 0
    assert host.write(0x0130, 8) == 0
    assert host.read(0x0130) == PREOP
    host.write(0x0805, 0xFF, 1)
    assert host.read(0x0805, 1) == 0          # a master cannot set the mailbox to full
    assert host.ask(FPRD, (STATION, 0x1FFF), bytes(4))[1] == 0


def test_the_eeprom_has_a_checksum_identity_and_categories():
    host = Host(alias=77).preop()
    head = b"".join(host.sii(2 * n).to_bytes(4, "little") for n in range(4))
    crc = 0xFF
    for bit in (byte >> 7 - n & 1 for byte in head[:14] for n in range(8)):
        crc = (crc << 1 ^ (0x07 if (crc >> 7) ^ bit else 0)) & 0xFF
    assert head[14] == crc
    assert head[8:10] == (77).to_bytes(2, "little") and host.read(0x0012) == 77
    assert [host.sii(word) for word in (8, 10, 12, 14)] == [host.number(0x1018, sub) for sub in (1, 2, 3, 4)]
    assert host.sii(0x18) == 0x1000 | 128 << 16 and host.sii(0x1A) == 0x1080 | 128 << 16
    word, found = 0x40, {}
    while (entry := host.sii(word)) & 0xFFFF != 0xFFFF:
        kind, words = entry & 0xFFFF, entry >> 16
        found[kind] = b"".join(host.sii(word + 2 + n).to_bytes(4, "little")[:2] for n in range(words))
        word += 2 + words
    assert sorted(found) == [10, 30, 40, 41, 50, 51]
    assert found[10][2:].startswith(b"Generic CiA 402 drive")
    assert struct.unpack_from("<HHBBBB", found[41], 16) == (0x1200, 10, 0x64, 0, 1, 3)
    assert found[51][:4] == b"\x00\x16\x05\x02" and found[51][8:11] == b"\x40\x60\x00"
    host.ask(FPWR, (STATION, 0x0502), struct.pack("<HI", 0x0201, 4))
    assert host.read(0x0502) & 0x2000        # a write is not acknowledged


def test_states_are_entered_one_by_one_and_a_refusal_has_a_code():
    host = Host()
    host.ask(by_hand.APWR, (0, 0x0010), struct.pack("<H", STATION))
    assert host.state(PREOP) == (INIT | 0x10, 0x0016)                 # no mailbox
    assert host.state(INIT) == (INIT | 0x10, 0x0016)                  # not acknowledged
    assert host.state(INIT | 0x10) == (INIT, 0)
    assert host.state(SAFEOP) == (INIT | 0x10, 0x0011)
    assert host.state(0x10 | 3) == (INIT | 0x10, 0x0013)
    assert host.state(0x10 | 7) == (INIT | 0x10, 0x0012)
    host.state(INIT | 0x10)
    host.preop()
    assert host.state(SAFEOP) == (PREOP | 0x10, 0x001D)               # no SyncManager for the outputs
    host.state(PREOP | 0x10)
    with pytest.raises(AssertionError):
        host.safeop(outputs=12)
    assert host.read(0x0134) == 0x001D
    host.state(PREOP | 0x10)
    with pytest.raises(AssertionError):
        host.safeop(inputs=13)
    assert host.read(0x0134) == 0x001E
    host.state(PREOP | 0x10)
    host.safeop()
    assert host.state(OP) == (SAFEOP, 0)                              # waits for the first outputs
    host.cycle(bytes(10))
    assert host.read(0x0130) == OP
    assert host.state(INIT) == (INIT, 0)
    assert host.state(OP) == (INIT | 0x10, 0x0011)


def test_process_data_count_for_each_direction():
    host = Host().preop().safeop()
    assert host.ask(LRD, 0, bytes(14))[1] == 1
    assert host.ask(LWR, 0, bytes(10))[1] == 1
    assert host.ask(LRW, 0, bytes(14))[1] == 3
    assert host.ask(LRW, 0x1000, bytes(14))[1] == 0
    data, counter = host.ask(LRW, 10, bytes(10))       # only inputs are there
    assert counter == 1 and data[4:] == bytes(6)


def test_stepped_time_advances_by_the_period_in_each_cycle():
    host = running(period_us=4000)
    before = host.slave.time_us
    for _ in range(5):
        host.cycle(bytes(10))
    host.ask(LRD, 0, bytes(14))
    host.number(0x6041)
    assert host.slave.time_us == before + 20_000
    host.now_s += 10.0
    host.cycle(bytes(10))
    assert host.slave.time_us == before + 24_000


@pytest.mark.heavy
def test_the_watchdog_of_the_process_data_drops_the_slave_and_stops_the_shaft():
    host = enabled(running(stepped=False), 3)
    assert (host.read(0x0400), host.read(0x0420), host.read(0x0440)) == (2498, 1000, 1)
    host.write(0x0420, 200)                             # 20 ms
    for _ in range(300):
        host.now_s += 0.01
        host.cycle(outputs(0x0F, 3, speed=300))
    assert host.read(0x0130) == OP and host.slave.inverter.speed_rad_s > 0.5
    host.now_s += 0.016
    host.simulator.idle(host.now_s)
    assert host.read(0x0130) == OP
    host.now_s += 0.01
    assert (host.read(0x0130), host.read(0x0134), host.read(0x0440)) == (SAFEOP | 0x10, 0x001B, 0)
    assert host.read(0x0442, 1) == 1
    for _ in range(400):
        host.now_s += 0.02
        host.simulator.idle(host.now_s)
    assert abs(host.slave.inverter.speed_rad_s) < 0.02
    assert host.number(0x603F) == 0x8130 - 0x10000
    host.state(SAFEOP | 0x10)
    assert host.op().read(0x0440) == 1


def test_a_watchdog_of_no_time_is_off():
    host = running(stepped=False)
    host.write(0x0420, 0)
    host.now_s += 5.0
    assert host.read(0x0130) == OP


def test_a_silent_host_ends_stepped_time():
    host = enabled(running(), 3)
    for _ in range(500):
        host.cycle(outputs(0x0F, 3, speed=300))
    assert host.slave.inverter.speed_rad_s > 0.5
    for _ in range(3000):
        host.now_s += 0.005
        host.simulator.idle(host.now_s)
    assert abs(host.slave.inverter.speed_rad_s) < 0.02
    assert host.read(0x0134) == 0x001B


def test_the_clock_follows_the_host_and_takes_an_offset():
    host = Host(stepped=False).preop()
    first = host.read(0x0910, 8)
    host.now_s += 0.0123
    assert host.read(0x0910, 8) - first == pytest.approx(12_300_000, abs=2)
    host.write(0x0920, 1_000_000_000, 8)
    assert host.read(0x0910, 8) - first == pytest.approx(1_012_300_000, abs=2)
    assert host.ask(BWR, (0, 0x0900), bytes(4))[1] == 1
    assert host.read(0x0918, 8) & 0xFFFFFFFF == host.read(0x0900, 4)
    stepped = running(period_us=4000)
    before = stepped.read(0x0910, 8)
    stepped.cycle(bytes(10))
    assert stepped.read(0x0910, 8) - before == 4_000_000


def test_random_frames_do_no_harm():
    import random

    host, draw = running(), random.Random(3)
    for _ in range(300):
        body = bytes(draw.randrange(256) for _ in range(draw.randrange(80)))
        host.simulator.answer(frame(body), 1.0)
        at = draw.choice((0x0120, 0x0500, 0x0600, 0x0800, 0x1000))
        host.ask(by_hand.FPWR, (STATION, at), bytes(draw.randrange(256) for _ in range(128)))
    for register in (0x0600, 0x0680):
        host.ask(BWR, (0, register), bytes(128))
    host.ask(BWR, (0, 0x0800), bytes(64))
    host.ask(BWR, (0, 0x0120), struct.pack("<H", 0x11))
    assert Host.preop(host)
