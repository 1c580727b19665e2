"""SDO over the mailbox, PDO mapping, and effect of the process data on the shaft."""

import struct

import pytest

from profiles import load_ethercat_profile
from tests.sim_bus.ethercat.host import (
    FPRD,
    FPWR,
    OP,
    PREOP,
    SAFEOP,
    STATION,
    Host,
    SdoAbort,
    enabled,
    inputs,
    outputs,
    running,
)


def test_sdo_expedited_normal_and_segmented():
    host = Host().preop()
    assert host.upload(0x6041) == b"\x50\x02"
    assert host.upload(0x5FFE, 1) == b"tdhil simulated drive"
    host.download(0x6085, 0, 700, 4)
    assert host.number(0x6085) == 700
    assert [host.number(0x1C00, sub) for sub in range(5)] == [4, 1, 2, 3, 4]
    host.download(0x60C2, 1, 4, 1)
    assert (host.number(0x60C2, 1), host.number(0x60C2, 2)) == (4, -3)
    for size in (0, 1, 4, 110, 111, 117, 230, 237, 512):
        text = bytes(65 + n % 26 for n in range(size))
        if size:
            host.download_text(0x5FFE, 5, text)
        assert host.upload(0x5FFE, 5) == (text if size else b"")


@pytest.mark.parametrize(("index", "sub", "value", "size", "code"), [
    (0x2222, 0, 0, 1, 0x06020000), (0x1018, 9, 0, 4, 0x06090011), (0x6041, 0, 0, 2, 0x06010002),
    (0x6040, 0, 0, 4, 0x06070010), (0x6060, 0, 77, 1, 0x06090030), (0x6072, 0, 65535, 2, 0x06090031),
    (0x1600, 0, 9, 1, 0x06090031), (0x1016, 1, 0, 4, 0x06020000), (0x1C00, 1, 0, 1, 0x06010002),
])
def test_an_abort_has_the_right_code(index, sub, value, size, code):
    assert Host().preop().refused(index, sub, value, size) == code


def test_an_invalid_sdo_is_refused_and_the_server_continues():
    host = Host().preop()
    for request, code in ((bytes((0x50,)) + b"\x18\x10\x00" + bytes(4), 0x06010000),      # complete access
                          (b"\xe0" + bytes(7), 0x05040001), (b"\x60" + bytes(7), 0x05040001)):
        with pytest.raises(SdoAbort) as refused:
            host.sdo(request)
        assert refused.value.code == code
    host.sdo(struct.pack("<BHBI", 0x21, 0x5FFE, 5, 300) + bytes(110))
    with pytest.raises(SdoAbort) as refused:
        host.sdo(bytes((0x10,)) + bytes(7))
    assert refused.value.code == 0x05030000                                              # toggle
    assert host.mailbox(b"\x00\x80" + bytes(8)) == b"\1\0\5\0"                            # an unknown CoE service
    assert host.upload(0x6041) == b"\x50\x02"


def test_a_duplicate_message_is_executed_once_and_a_lost_reply_is_repeated():
    host = Host().preop()
    message = (struct.pack("<HHBB", 10, 0, 0, 3 | 5 << 4) + b"\x00\x20" + struct.pack("<BHB4x", 0x40, 0x6041, 0))
    for _ in range(2):
        assert host.ask(FPWR, (STATION, 0x1000), message.ljust(128, b"\0"))[1] == 1
    assert host.read(0x080D, 1) & 8
    first, counter = host.ask(FPRD, (STATION, 0x1080), bytes(128))
    assert counter == 1 and host.ask(FPRD, (STATION, 0x1080), bytes(128))[1] == 0
    host.write(0x080E, 3, 1)                                                             # repeat request
    assert host.read(0x080F, 1) & 2
    assert host.ask(FPRD, (STATION, 0x1080), bytes(128)) == (first, 1)


def test_mapping_is_written_in_preop_as_count_entries_count():
    host = Host().preop()
    assert host.refused(0x1600, 1, 0x60FF0020, 4) == 0x08000022       # counts still
    host.map((0x60400010, 0x60FF0020), (0x60410010, 0x606C0020, 0x60770010))
    assert host.refused(0x1C12, 0, 9, 1) == 0x06090031
    host.download(0x1600, 0, 0, 1)
    for wrong in (0x60410010, 0x60FF0010, 0x10080008, 0x00000005):
        assert host.refused(0x1600, 1, wrong, 4) == 0x06040041
    assert host.refused(0x1600, 1, 0x22220010, 4) == 0x06020000
    host.download(0x1600, 0, 2, 1)
    host.safeop(6, 8).op()
    assert host.refused(0x1600, 0, 0, 1) == 0x08000022
    assert host.state(PREOP) == (PREOP, 0) and host.refused(0x1600, 0, 0, 1) == 0


def test_two_pdos_follow_each_other():
    host = Host().preop()
    host.download(0x1C13, 0, 0, 1)
    host.download(0x1A01, 1, 0x60740010, 4)
    host.download(0x1A01, 0, 1, 1)
    host.download(0x1C13, 2, 0x1A01, 2)
    host.download(0x1C13, 0, 2, 1)
    host.safeop(10, 16)
    assert host.read(0x0130) == SAFEOP


def test_outputs_act_in_operational_only():
    host = Host().preop()
    host.download(0x5FFE, 3, 2000, 4)
    host.safeop()
    host.cycle(outputs(0x06, 9))
    assert host.slave.application.controlword == 0
    host.op()
    host.cycle(outputs(0x06, 9))
    assert host.slave.application.controlword == 6 and host.slave.application.mode == 9


@pytest.mark.parametrize("mode", [3, 9])
def test_a_speed_setpoint_turns_the_shaft(mode):
    host = enabled(running(), mode)
    for step in range(1500):
        data, counter = host.cycle(outputs(0x0F, mode, speed=min(300, step)))
        assert counter == 3
    status, shown, torque, speed, position = inputs(data)
    assert shown == mode and status & 0x6F == 0x27
    assert speed == pytest.approx(300, abs=3) and position > 0 and torque > 0
    assert host.slave.inverter.speed_rad_s == pytest.approx(300 * 2.0 * 3.141592653589793 / 600.0, rel=0.01)


@pytest.mark.parametrize("mode", [4, 10])
def test_a_torque_setpoint_is_the_torque_of_the_shaft(mode):
    host = enabled(running(), mode)
    for _ in range(300):
        data, _ = host.cycle(outputs(0x0F, mode, torque=80))
    assert inputs(data)[2] == pytest.approx(80, abs=1)
    assert host.slave.inverter.torque_nm == pytest.approx(80.0, rel=0.01)


def test_leaving_operational_while_enabled_is_a_lost_connection():
    host = enabled(running(), 9)
    for _ in range(500):
        host.cycle(outputs(0x0F, 9, speed=200))
    assert host.state(PREOP) == (PREOP, 0)
    assert host.slave.application.state.name.startswith("FAULT")
    assert host.number(0x603F) == 0x8130 - 0x10000 and host.number(0x1001) == 0x11


def test_an_emergency_comes_by_the_mailbox():
    host = enabled(running("emcy@0.05s=7305h"), 9)
    for _ in range(20):
        host.cycle(outputs(0x0F, 9))
    data, counter = host.ask(FPRD, (STATION, 0x1080), bytes(128))
    assert counter == 1 and data[6:11] == b"\x00\x10\x05\x73\x11"
    assert host.read(0x0130) == OP


def test_the_shaft_repeats_with_a_seed_to_the_last_frame():
    from sim_bus.params import RigParams

    def run():
        host = enabled(running(rig=RigParams()), 10)
        return [host.cycle(outputs(0x0F, 10, torque=60))[0] for _ in range(200)]

    assert run() == run()


@pytest.mark.parametrize(("name", "vendor", "pdos", "there", "missing"), [
    ("maxon/epos4-ethercat", 0xFB, (0x1600, 0x1A00), ((0x3001, 2), (0x3001, 5), (0x60A9, 0)), (0x6072, 0x6074)),
    ("elmo/gold-ethercat", 0x9A, (0x1607, 0x1A07), ((0x608F, 1), (0x6072, 0)), (0x6080, 0x6074)),
    ("beckhoff/ax8000", 0x02, (0x1600, 0x1A00), ((0x3005, 2), (0x6085, 0)), (0x6007, 0x6080)),
])
def test_a_profile_gives_the_drive_its_identity_its_pdos_and_its_objects(name, vendor, pdos, there, missing):
    host = Host(profile=load_ethercat_profile(name)).preop()
    assert host.sii(8) == vendor
    assert host.number(0x1018, 1) == vendor
    assert (host.number(0x1C12, 1), host.number(0x1C13, 1)) == pdos
    assert host.number(pdos[0], 1) == 0x60400010
    for place in there:
        host.upload(*place)
    for index in missing:
        with pytest.raises(SdoAbort) as refused:
            host.upload(index)
        assert refused.value.code == 0x06020000
