"""PDO mapping in the order that CiA 301 asks for."""

import pytest

from drivers.canopen.bus import CanLink
from drivers.canopen.pdo import Slow
from drivers.canopen.pdo_mapping import layout, write_pdo
from drivers.canopen.sdo import SdoObjects
from drivers.clock import SteppedClock
from drivers.errors import ObjectRefused, PreflightRefused
from tests.drivers.drive_benches import Run


@pytest.fixture
def objects(wire, peer):
    return SdoObjects(CanLink(wire, SteppedClock()), 1)


def written(peer):
    return [(f"{index:04X}:{sub}", int.from_bytes(data, "little")) for index, sub, data in peer.writes]


def test_the_order_for_the_first_pair(objects, peer):
    first, second = layout(Slow(demand=True))[:2]
    write_pdo(objects, 1, first)
    write_pdo(objects, 1, second)
    assert written(peer) == [
        ("1400:1", 0x80000201), ("1600:0", 0), ("1600:1", 0x60400010), ("1600:2", 0x60710010), ("1600:3", 0x60FF0020),
        ("1600:0", 3), ("1400:2", 1), ("1400:1", 0x201),
        ("1800:1", 0x80000181), ("1A00:0", 0), ("1A00:1", 0x60410010), ("1A00:2", 0x60770010), ("1A00:3", 0x606C0020),
        ("1A00:0", 3), ("1800:2", 1), ("1800:1", 0x181),
    ]


@pytest.mark.parametrize(("former", "kept"), [
    (0xC0000181, 0x40000000), (0x40000199, 0x40000000), (0x80000181, 0), (0xC0012981, 0x40012800),
    (0xFABCD181, 0x40000000),            # a 29-bit identifier: its upper bits are no bits of the drive
])
def test_the_drives_own_bits_of_a_cob_id_are_kept(objects, peer, former, kept):
    """Bit 30 of a TPDO's COB-ID must stay 1 in some drives (CiA 301, 1800h: no remote frames)."""
    peer.objects[0x1800, 1] = former.to_bytes(4, "little")
    write_pdo(objects, 1, layout(Slow(demand=True))[1])
    assert [value for place, value in written(peer) if place == "1800:1"] == [0x80000181 | kept, 0x181 | kept]
    objects.restore()
    assert peer.value(0x1800, 1) == former


@pytest.mark.parametrize("with_demand", [True, False])
def test_the_order_for_the_second_pair(objects, peer, with_demand):
    for pdo in layout(Slow(with_demand))[2:]:
        write_pdo(objects, 1, pdo)
    slow = [("1A01:1", 0x60610008)] + [("1A01:2", 0x60740010)] * with_demand
    assert written(peer) == [
        ("1401:1", 0x80000301), ("1601:0", 0), ("1601:1", 0x60600008), ("1601:0", 1), ("1401:2", 1), ("1401:1", 0x301),
        ("1801:1", 0x80000281), ("1A01:0", 0), *slow, ("1A01:0", len(slow)), ("1801:2", 5), ("1801:1", 0x281),
    ]


@pytest.mark.parametrize(("node", "identifiers"), [
    (1, [0x201, 0x181, 0x301, 0x281]), (0x7F, [0x27F, 0x1FF, 0x37F, 0x2FF]),
])
def test_identifiers_of_the_predefined_connection_set(node, identifiers):
    assert [pdo.identifier(node) for pdo in layout(Slow(demand=True))] == identifiers


def test_a_fixed_mapping_that_differs(objects, peer):
    peer.refuse_write[0x1600, 0] = 0x06010002
    with pytest.raises(ObjectRefused) as caught:
        write_pdo(objects, 1, layout(Slow(demand=True))[0])
    assert caught.value.where == "1600h"


def test_a_fixed_mapping_that_agrees(objects, peer):
    peer.deaf_to |= {(0x1600, sub) for sub in range(9)}
    with pytest.raises(PreflightRefused, match="60400010h") as caught:
        write_pdo(objects, 1, layout(Slow(demand=True))[0])
    assert caught.value.where == "1600h"
    assert "mapping of this drive may be fixed" in caught.value.next_step


@pytest.mark.parametrize("sub", [1, 2])
def test_a_communication_parameter_that_is_not_stored(objects, peer, sub):
    """A PDO that stays disabled or does not follow the SYNC is refused like one with the wrong content."""
    peer.deaf_to.add((0x1800, sub))
    with pytest.raises(PreflightRefused) as caught:
        write_pdo(objects, 1, layout(Slow(demand=True))[1])
    assert "1800h" in caught.value.where


def test_a_drive_that_refuses_a_tpdo_with_remote_frames(bench):
    """Without bit 30 it aborts with 06090030h, as Roboteq's and Lika's drives do."""
    bench.simulated.simulator.node.refuse_remote_frames()
    places = ((0x1800, 1), (0x1801, 1))
    before = bench.settings(places)
    run = Run(bench)
    run.ready()
    assert bench.settings(places) == {"1800h:1": 0x40000181, "1801h:1": 0x40000281}
    assert run.go(1.0).fresh
    run.drive.close()
    assert bench.settings(places) == before
