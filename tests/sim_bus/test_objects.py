"""Configuration over SDO: identity, marker, limits, PDO remapping, NMT."""

import struct
from collections.abc import Callable
from typing import Any

import can
import canopen
import pytest

from profiles import TdhilError
from profiles.simulator_marker import MARKER_INDEX, MARKER_TEXT
from sim_bus.application_objects import rated_torque_counts
from sim_bus.objects import generic_eds
from tests.rigs import QUIET_RIG

Open = Callable[..., tuple[Any, Any]]


def test_remote_node_of_canopen_as_master(bench: Open) -> None:
    simulated, _ = bench()
    network = canopen.Network()
    network.connect(interface="virtual", channel=simulated.channel)
    try:
        node = network.add_node(canopen.RemoteNode(1, generic_eds()))
        node.sdo.RESPONSE_TIMEOUT = 3.0
        assert node.sdo[MARKER_INDEX][1].raw == MARKER_TEXT          # segmented upload
        assert [node.sdo[0x1018][sub].raw for sub in (1, 2)] == [0, 402]
        assert node.sdo[0x6076].raw == 1_000_000 and node.sdo[0x6072].raw == 400
        assert node.sdo[0x6502].raw == 1 << 2 | 1 << 3 | 1 << 8 | 1 << 9
        node.tpdo.read()
        node.tpdo[1].clear()
        for index in (0x6041, 0x6077, 0x606C):
            node.tpdo[1].add_variable(index)
        node.tpdo[1].trans_type = 1
        node.tpdo[1].enabled = True
        node.tpdo[1].save()
        assert node.sdo[0x1A00][0].raw == 3
        for variable in node.object_dictionary.values():             # everything readable can be read
            for entry in [variable] if isinstance(variable, canopen.objectdictionary.ODVariable) else variable.values():
                if entry.readable and entry.index != 0x1003 and entry.index > 7:
                    node.sdo.upload(entry.index, entry.subindex)
        with pytest.raises(canopen.SdoAbortedError) as abort:
            node.sdo.download(0x6041, 0, b"\0\0")
        assert abort.value.code == 0x06010002
    finally:
        network.disconnect()


@pytest.mark.parametrize(("index", "sub", "value", "size", "code"), [
    (0x1234, 0, 0, 4, 0x06020000),       # no such object
    (0x1018, 9, 0, 4, 0x06090011),       # no such subindex
    (0x6041, 0, 0, 2, 0x06010002),       # read only
    (0x6085, 0, 1, 2, 0x06070010),       # length
    (0x6072, 0, 401, 2, 0x06090031),     # above the drive's own limit
    (0x6083, 0, 0, 4, 0x06090032),       # too low
    (0x6060, 0, 8, 1, 0x06090030),       # mode not supported
    (0x605A, 0, 4, 2, 0x06090030),       # option not supported
    (0x6007, 0, 4, 2, 0x06090031),
    (0x1029, 1, 3, 1, 0x06090031),
    (0x1005, 0, 0x81, 4, 0x06090031),
    (0x1400, 2, 250, 1, 0x06090030),     # reserved transmission type
    (0x1600, 1, 0x60710010, 4, 0x08000022),  # mapping of an existing PDO
    (0x1401, 1, 0x20000301, 4, 0x06090030),  # 29-bit identifier
])
def test_refusals(bench: Open, index: int, sub: int, value: int, size: int, code: int) -> None:
    _, host = bench()
    assert host.refused(index, sub, value, size) == code


def test_remapping_rules(bench: Open) -> None:
    _, host = bench()
    host.write(0x1800, 1, 0xC0000181, 4)
    assert host.refused(0x1A00, 1, 0x60770010, 4) == 0x08000022       # count is not 0
    host.write(0x1A00, 0, 0, 1)
    assert host.refused(0x1A00, 1, 0x60770020, 4) == 0x06040041       # wrong length
    assert host.refused(0x1A00, 1, 0x60850020, 4) == 0             # mappable though a parameter
    assert host.refused(0x1A00, 1, 0x60760020, 4) == 0x06040041       # not mappable
    assert host.refused(0x1A00, 1, 0x77770020, 4) == 0x06020000
    for number, entry in enumerate((0x606C0020, 0x606B0020, 0x60770010), 1):
        host.write(0x1A00, number, entry, 4)
    assert host.refused(0x1A00, 0, 3, 1) == 0x06040042                # ten bytes
    host.write(0x1A00, 0, 2, 1)
    host.write(0x1800, 1, 0x40000181, 4)
    assert host.refused(0x1800, 1, 0x40000182, 4) == 0x06090030       # an existing PDO keeps its identifier
    host.write(0x1400, 1, 0x80000201, 4)
    host.write(0x1600, 0, 0, 1)
    assert host.refused(0x1600, 1, 0x60410010, 4) == 0x06040041       # read only in an RPDO
    assert host.refused(0x1600, 1, 0x00050008, 4) == 0                # a dummy


def test_a_drive_that_keeps_bit_30_of_the_cob_ids_of_its_tpdos(bench: Open) -> None:
    simulated, host = bench()
    before = host.read(0x1800, 1)
    simulated.simulator.node.refuse_remote_frames()
    assert host.read(0x1800, 1) == before | 0x40000000
    assert host.refused(0x1800, 1, 0x80000181, 4) == 0x06090030
    assert host.refused(0x1800, 1, 0xC0000181, 4) == 0
    assert host.refused(0x1801, 1, 0x00000281, 4) == 0x06090030
    assert host.refused(0x1400, 1, 0x80000201, 4) == 0                # an RPDO has no remote frames


def test_marker_switches_the_clock(bench: Open) -> None:
    simulated, host = bench(stepped=False)
    assert host.read(MARKER_INDEX, 2) == 0
    host.write(MARKER_INDEX, 2, 1, 1)
    assert host.read(MARKER_INDEX, 2) == 1
    host.write(0x1006, 0, 4000, 4)
    before = simulated.simulator.node.time_us
    for _ in range(10):
        host.send(0x080)
    host.read(0x1000)
    assert simulated.simulator.node.time_us == before + 40_000
    host.write(MARKER_INDEX, 2, 0, 1)


def test_sdo_is_silent_in_stopped_and_pdo_outside_operational(bench: Open) -> None:
    _, host = bench()
    host.remap()
    host.write(0x1006, 0, 10_000, 4)
    host.send(0x080)
    host.read(0x1000)
    assert not [frame for frame in host.heard if frame[0] == 0x181]    # pre-operational: no PDO
    host.nmt(2)
    host.send(0x601, struct.pack("<BHB4x", 0x40, 0x1000, 0))
    host.nmt(1)
    host.cycle(0x06)
    assert host.heard == []                                           # no reply while stopped
    assert host.read(0x6041) & 0x6F == 0x21


@pytest.mark.parametrize(("command", "kept"), [(129, False), (130, True)])
def test_nmt_resets(bench: Open, command: int, kept: bool) -> None:
    _, host = bench()
    host.set_up()
    host.write(0x6085, 0, 777, 4)
    host.nmt(command)
    assert host.wait(0x701) == b"\0"
    assert host.read(0x6085) == (777 if kept else 300)
    assert host.read(0x1A00, 0) == 1 and host.read(0x1006) == 0
    assert host.read(MARKER_INDEX, 2) == 1                            # the clock is not reset
    host.nmt(129, node=5)
    assert host.read(0x1000) == 0x00020192


def test_producer_heartbeat_in_plant_time(bench: Open) -> None:
    _, host = bench()
    host.set_up()
    host.write(0x1017, 0, 50, 2)
    host.heard.clear()
    host.cycle(0x06, times=50)
    host.read(0x1000)
    assert 9 <= len([data for can_id, data in host.heard if can_id == 0x701 and data == b"\x05"]) <= 11


def test_transmission_types(bench: Open) -> None:
    _, host = bench()
    host.set_up()
    host.write(0x1800, 2, 5, 1)
    host.heard.clear()
    for _ in range(20):
        host.send(0x080)
    host.read(0x1000)
    assert len([1 for can_id, _ in host.heard if can_id == 0x181]) == 4
    host.write(0x1800, 2, 255, 1)                                     # by event: a change of state
    host.write(0x1400, 2, 255, 1)
    host.heard.clear()
    host.send(0x201, struct.pack("<Hhi", 0x06, 0, 0))
    host.send(0x080)
    assert struct.unpack_from("<H", host.wait(0x181))[0] & 0x6F == 0x21


def test_sync_rpdo_waits_and_short_or_disabled_ones_do_nothing(bench: Open) -> None:
    _, host = bench()
    host.set_up()
    host.send(0x201, struct.pack("<Hhi", 0x06, 0, 0))
    assert host.read(0x6041) & 0x6F == 0x40                           # not yet: no SYNC
    host.send(0x080)
    assert host.read(0x6041) & 0x6F == 0x21
    host.send(0x201, b"\x07\x00")
    host.send(0x080)
    assert 0x8210 in host.emcy() and host.read(0x6041) & 0x6F == 0x21
    host.write(0x1400, 1, 0x80000201, 4)
    host.send(0x201, struct.pack("<Hhi", 0x07, 0, 0))
    host.send(0x080)
    assert host.read(0x6041) & 0x6F == 0x21


def test_malformed_frames_do_no_harm(bench: Open) -> None:
    _, host = bench()
    for data in (b"", b"\x40", b"\x80" * 8, b"\x60" + bytes(7), b"\xC0" * 8, b"\xFF" * 8, b"\x00" * 3):
        host.send(0x601, data)
        host.send(0x000, data[:1])
    host.bus.send(can.Message(arbitration_id=0x601, is_remote_frame=True, dlc=8, is_extended_id=False))
    host.bus.send(can.Message(arbitration_id=0x080, is_extended_id=True))
    host.send(0x601, struct.pack("<BHB4x", 0x40, 0x6502, 0))
    answers = [host.wait(0x581)]
    while answers[-1][:4] != struct.pack("<BHB", 0x43, 0x6502, 0):
        answers.append(host.wait(0x581))


def test_a_rated_torque_out_of_the_range_of_6076h_is_refused_with_a_reason():
    """An EPOS4 counts µN·m in 32 bits."""
    assert rated_torque_counts(4294.0, 1e-6) == 4_294_000_000
    with pytest.raises(TdhilError, match=r"6076h cannot hold the rated torque of 7580 N·m: .* ends at 4295 N·m"):
        rated_torque_counts(7580.0, 1e-6)


@pytest.mark.parametrize(("speed_limit_rpm", "tenths_rpm"), [(200.0, 5), (250.0, 5), (3000.0, 45)])
def test_a_fast_drive_has_a_higher_velocity_threshold(bench: Open, speed_limit_rpm: float, tenths_rpm: int) -> None:
    """606Fh of a slow drive is below the noise of a servo, which would never report standstill."""
    drive = QUIET_RIG.drive.model_copy(update={"speed_limit_rpm": speed_limit_rpm})
    _, host = bench(QUIET_RIG.model_copy(update={"drive": drive}))
    assert host.read(0x606F) == tenths_rpm
