"""Scripted faults: observations of the host during each, and the end of each."""

import pytest

from sim_bus.command import main
from sim_bus.ethercat import listed, listing, parse_all
from sim_bus.fault_script import FaultRefused
from tests.sim_bus.ethercat.host import (
    FPRD,
    OP,
    SAFEOP,
    STATION,
    Host,
    SdoAbort,
    enabled,
    inputs,
    outputs,
    running,
)


def cycles(host, count, **wanted):
    return [host.cycle(outputs(0x0F, 9, **wanted)) for _ in range(count)]


def test_the_list_names_every_fault_and_each_can_be_made():
    names = {one.name for one in listed()}
    assert {"frame-loss", "wrong-working-counter", "al-error", "sm-watchdog", "sii-garbage", "mailbox-timeout",
            "clock-jump", "sto", "stuck-state"} <= names
    assert all(one.name in listing(80) for one in listed())
    parse_all([one.name for one in listed()])
    for wrong in ("frame-loss=2", "al-error=xyz", "sdo-abort=12", "nothing", "sii-garbage=1"):
        with pytest.raises(FaultRefused):
            parse_all([wrong])


def test_the_command_lists_faults_and_refuses_what_it_cannot_use(capsys):
    assert main(["ethercat", "--fault", "list"]) == 0
    assert "wrong-working-counter" in capsys.readouterr().out
    for arguments, why in (([], "no interface"), (["-i", "nosuchlink0"], "nosuchlink0"),
                           (["-i", "lo", "--fault", "nothing"], "no fault is called")):
        assert main(["ethercat", *arguments]) == 2
        assert why in capsys.readouterr().err


def test_lost_frames_take_their_cycle_and_end():
    host = enabled(running("frame-loss@0.1s=30%/2s"), 9)
    before = host.slave.time_us
    counters = [counter for _, counter in cycles(host, 800)]
    assert host.slave.time_us == before + 800 * 4000
    lost = [n for n, counter in enumerate(counters) if counter == 0]
    assert 0.4 < len(lost) / 500 < 0.6                     # on the way to the drive, or back
    assert all(counter == 3 for counter in counters[550:])


def test_a_dead_line_lets_the_watchdog_act():
    host = enabled(running("bus-dead@0.1s/1s"), 9)
    cycles(host, 250, speed=100)
    assert host.slave.state == SAFEOP and host.slave.application.state.name.startswith("FAULT")
    assert cycles(host, 60)[-1][1] == 3
    assert (host.read(0x0130), host.read(0x0134)) == (SAFEOP | 0x10, 0x001B)


def test_a_wrong_working_counter_leaves_the_data():
    host = enabled(running("wrong-working-counter@0.1s=50%/1s"), 9)
    counters = [counter for _, counter in cycles(host, 400)]
    assert 80 < counters.count(0) < 170 and set(counters) == {0, 3}
    assert set(counters[300:]) == {3} and host.read(0x0130) == OP


@pytest.mark.parametrize(("fault", "code"), [("al-error@0.1s=002Ch", 0x2C), ("sm-watchdog@0.1s", 0x1B)])
def test_the_slave_leaves_operational_with_a_code(fault, code):
    host = enabled(running(fault), 9)
    cycles(host, 40)
    assert (host.read(0x0130), host.read(0x0134)) == (SAFEOP | 0x10, code)
    assert host.slave.application.state.name.startswith("FAULT")


def test_garbage_in_the_eeprom_begins_and_ends():
    host = Host("sii-garbage@0.1s/0.1s").preop()
    host.download(0x5FFE, 3, 4000, 4)
    true = host.sii(10)
    host.safeop()
    host.op()
    cycles(host, 30)
    assert host.sii(10) == 0xFFFFFFFF
    cycles(host, 30)
    assert host.sii(10) == true


def test_a_mailbox_that_does_not_reply():
    host = running("mailbox-timeout@0.1s/0.2s")
    cycles(host, 40)
    assert host.mailbox(b"\x00\x20\x40\x41\x60\x00" + bytes(4)) == b""
    cycles(host, 60)
    assert host.upload(0x1001) == b"\0"


def test_transfers_of_one_object():
    host = running("sdo-abort=6072h", "sdo-timeout=6080h", "write-not-kept=6083h", "reads-back-otherwise=6085h",
                   "wrong-identity")
    with pytest.raises(SdoAbort) as refused:
        host.upload(0x6072)
    assert refused.value.code == 0x08000020
    with pytest.raises(AssertionError, match="no answer"):
        host.upload(0x6080)
    before = host.number(0x6083)
    host.download(0x6083, 0, before + 5, 4)
    assert host.number(0x6083) == before
    host.download(0x6085, 0, 700, 4)
    assert host.number(0x6085) == 700 ^ 4
    assert host.number(0x1018, 1) == 4


def test_the_clock_jumps():
    host = running("clock-jump@0.1s=0.5")
    before = host.read(0x0910, 8)
    cycles(host, 40)
    assert host.read(0x0910, 8) - before == 40 * 4_000_000 + 500_000_000


def test_the_watchdog_keeps_its_time():
    host = running("watchdog-not-armed")
    assert host.write(0x0420, 300) == 1 and host.write(0x0400, 1) == 1
    assert (host.read(0x0400), host.read(0x0420)) == (2498, 1000)


def test_frozen_feedback_and_faults_of_the_drive():
    host = enabled(running("frozen-feedback@0.5s/0.5s"), 9)
    told = [data for data, _ in cycles(host, 400, speed=200)]
    assert len(set(told[130:230])) == 1 and len(set(told[260:])) > 50
    host = enabled(running("sto@0.2s"), 9)
    cycles(host, 100, speed=100)
    assert inputs(host.cycle(outputs(0x0F, 9))[0])[0] & 0x4F == 0x40
    host = Host("fault-at-start=3210h").preop()
    assert host.number(0x6041) & 0x4F == 0x08 and host.number(0x603F) == 0x3210
    host = running("node-reset@0.1s")
    cycles(host, 40)
    assert host.read(0x0130) == 1


def test_a_fault_waits_for_its_stage():
    host = running("clock-jump@hold=1")
    cycles(host, 10)
    assert host.simulator.faults_waiting == ("clock-jump@hold=1",)
    host.download(0x5FFE, 4, 4, 1)
    assert host.simulator.faults_waiting == ()
    assert host.ask(FPRD, (STATION, 0x0910), bytes(8))[1] == 1
