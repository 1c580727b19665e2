"""Effect of each scripted error on the registers of generic/modbus, compared with the same drive without it."""

import struct
from math import pi

import pytest

from profiles.errors import TdhilError
from sim_bus.modbus.wrong_maps import KINDS, Wrong, parse
from tests.sim_bus.modbus_host import GenericHost, drive


def host(*wrongs: str) -> GenericHost:
    return GenericHost(drive(wrongs=wrongs))


def test_word_order() -> None:
    wrong = host("word_order")
    assert wrong.read(42, 2) == (0x5678, 0x1234)
    wrong.write(1, (0, 2000))
    assert wrong.drive.machine.application.target_speed_rad_s > 1e5              # 2000 · 65536 counts
    assert wrong.read(48, 2) == (0, 20_000)                                      # exchanged twice: no echo shows it


def test_scale_10() -> None:
    right, wrong = host(), host("scale_10")
    for address, kind in ((32, "I"), (34, "H"), (35, "H"), (38, "H"), (45, "H")):
        assert wrong.number(address, kind) == pytest.approx(10 * right.number(address, kind), abs=5)
    assert wrong.number(42, "I") == 0x12345678 and wrong.number(44) == -12345     # no scale
    wrong.write(1, struct.unpack(">3H", struct.pack(">ih", 2000, 100)))
    assert wrong.drive.machine.application.target_speed_rad_s == pytest.approx(2.0 * pi / 30)     # 20 rpm was intended
    assert wrong.number(48, "i") == 2000                                          # 0.001 rpm, a different count
    assert wrong.number(50, "i") == pytest.approx(1000, abs=1)                    # 0.01 N·m; 100 were intended
    for one in (right, wrong):
        one.enable(20.0)
        one.cycles(8.0, rpm=20.0)
    assert wrong.drive.speed_rad_s == pytest.approx(right.drive.speed_rad_s / 10, rel=0.05)


def test_address_off_by_one() -> None:
    right, wrong = host(), host("address_off_by_one")
    assert wrong.read(33, 15) == right.read(32, 15)
    assert wrong.refused(struct.pack(">BHH", 3, 16, 5)) == 2
    assert wrong.read(0xFDE8, 13) == right.read(0xFDE8, 13)                      # the marker is not of the drive


def test_sign() -> None:
    right, wrong = host(), host("sign")
    for one in (right, wrong):
        one.write(1, struct.unpack(">3H", struct.pack(">ih", -2000, 100)))
    assert (right.number(44), wrong.number(44)) == (-12345, 12345)
    assert (right.number(48, "i"), wrong.number(48, "i")) == (-20_000, 20_000)
    assert (right.number(50, "i"), wrong.number(50, "i")) == (10_000, -10_000)
    assert right.number(32, "I") == wrong.number(32, "I")                        # has no sign
    assert wrong.drive.machine.application.target_speed_rad_s < 0                # only the reported value


def test_unsigned() -> None:
    wrong = host("unsigned")
    assert wrong.number(44) == 12345
    wrong.write_one(3, 0x10000 - 100)
    assert wrong.drive.machine.application.target_torque_nm == pytest.approx(65436)
    assert wrong.number(50, "i") == pytest.approx(6_543_600)                      # shows the decoded value


def test_write_not_applied() -> None:
    wrong = host("write_not_applied")
    before = wrong.read(38)
    wrong.write_one(38, 77)
    assert wrong.read(38) == before
    wrong.write_one(3, 77)
    assert wrong.read(3) == (77,)                                                # setpoints are


def test_reads_back_something_else() -> None:
    wrong = host("reads_back_something_else:time_out")
    wrong.write_one(40, 200)
    assert wrong.read(40) == (301,)
    wrong.write_one(38, 200)
    assert wrong.read(38) == (200,)


def test_names() -> None:
    assert {parse(name).kind for name in KINDS if name != "reads_back_something_else"} < set(KINDS)
    assert parse("reads_back_something_else:time_out", ["time_out"]) == Wrong("reads_back_something_else", "time_out")
    for bad in ("", "wordorder", "scale_10:speed", "reads_back_something_else", "reads_back_something_else:nix"):
        with pytest.raises(TdhilError, match="--wrong"):
            parse(bad, ["time_out"])
