"""State sequences of each family, with words and bits from the manuals, not from a profile."""

import numpy as np
import pytest

from sim_bus.cia402 import Application, OperationMode
from sim_bus.inverter import Inverter
from sim_bus.modbus.control_words import FAMILIES, Wiring
from tests.rigs import QUIET_RIG

STEP_S = 0.002


class Bench:
    """One family with a drive, without registers."""

    def __init__(self, family: str, **wiring: object) -> None:
        self.application = Application(Inverter(QUIET_RIG, np.random.default_rng(0)))
        self.application.set_mode(OperationMode.CYCLIC_VELOCITY)
        self.words = FAMILIES[family](self.application, Wiring(**wiring))  # type: ignore[arg-type]

    def send(self, word: int, for_s: float = 0.02) -> int:
        """Return the status word after the control word has been set for a time."""
        self.words.write(word)
        return self.run(for_s)

    def run(self, for_s: float) -> int:
        self.application.target_speed_rad_s = -2.0 if self.words.reversed else 2.0
        self.application.target_torque_nm = 100.0
        self.application.regulate()
        for _ in range(round(for_s / STEP_S)):
            self.application.step(STEP_S)
        return self.words.status()

    @property
    def speed(self) -> float:
        return self.application.inverter.speed_rad_s


# -- ABB and PROFIdrive: 1142, 1143, 1151 start; OFF1, OFF2, OFF3 stop ---------------------------------------------

OFF_FAMILIES = pytest.mark.parametrize("family", ["abb", "profidrive"])


def started(family: str, **wiring: object) -> Bench:
    bench = Bench(family, **wiring)
    assert bench.words.status() & 0x0047 == 0x0040                             # inhibited
    assert bench.send(0x0476) & 0x0077 == 0x0031                               # ready to switch on
    assert bench.send(0x0477) & 0x0077 == 0x0033                               # ready to run
    assert bench.send(0x047F) & 0x027F == 0x0237                               # operation, remote
    assert bench.run(8.0) & 0x0100 and bench.speed == pytest.approx(2.0, abs=0.05)
    return bench


@OFF_FAMILIES
def test_off1_ramps_down_and_leaves_the_drive_ready(family: str) -> None:
    bench = started(family)
    status = bench.send(0x047E)
    assert status & 0x0075 == 0x0031 and bench.speed > 1.9                     # reference no longer acts
    assert bool(status & 2) is (family == "profidrive")
    bench.run(1.0)
    assert 0.8 < bench.speed < 1.4                                             # 1 rad/s²
    assert bench.run(4.0) & 0x0077 == 0x0031 and bench.speed == pytest.approx(0.0, abs=0.01)
    assert bench.send(0x047F) & 0x0007 == 0x0007                               # no inhibit after OFF1


@OFF_FAMILIES
def test_off2_coasts_and_inhibits(family: str) -> None:
    bench = started(family)
    assert bench.send(0x047D) & 0x0057 == 0x0040 and bench.application.inverter.torque_nm == 0.0
    assert bench.send(0x047F) & 0x0057 == 0x0050                               # still on: must go to OFF1 first
    assert bench.speed > 1.5
    assert bench.send(0x047E) & 0x0047 == 0x0001


@OFF_FAMILIES
def test_off3_is_the_quick_stop_and_inhibits(family: str) -> None:
    bench = started(family)
    assert bench.send(0x047B) & 0x0024 == 0x0000                               # OFF3 acts, operation not enabled
    assert bench.send(0x047F) & 0x0024 == 0x0000                               # not cancelled during the stop
    bench.run(0.7)
    assert bench.speed < 0.8                                                   # 3 rad/s² plus the lag of the loop
    assert bench.run(2.0) & 0x0067 == 0x0060 and abs(bench.speed) < 0.01
    assert bench.send(0x047F) & 0x0067 == 0x0060


@OFF_FAMILIES
def test_inhibiting_operation_coasts(family: str) -> None:
    bench = started(family)
    assert bench.send(0x0477) & 0x0077 == 0x0033 and bench.application.inverter.torque_nm == 0.0


@OFF_FAMILIES
def test_fault_and_reset_on_the_edge(family: str) -> None:
    bench = started(family)
    bench.application.fault()
    assert bench.run(3.0) & 0x000F == 0x0008 and abs(bench.speed) < 0.01
    assert bench.send(0x047E) & 0x0008
    assert bench.send(0x04FE) & 0x0009 == 0x0001
    bench.application.fault()
    assert bench.send(0x04FE) & 0x0008                                         # no edge
    bench.send(0x047E)
    assert not bench.send(0x04FE) & 0x0008


def test_without_the_bus_bit_profidrive_ignores_the_word() -> None:
    bench = started("profidrive")
    for word in (0x0000, 0x007B, 0x007E):
        assert bench.send(word, 0.5) & 0x0007 == 0x0007 and not bench.words.listens
    assert bench.speed == pytest.approx(2.0, abs=0.05)


def test_without_the_bus_bit_abb_uses_only_the_off_bits() -> None:
    bench = started("abb")
    assert bench.send(0x0077) & 0x0007 == 0x0007 and not bench.words.listens   # bit 3 at 0 is ignored
    assert bench.send(0x007B) & 0x0024 == 0x0000                               # OFF3 is not


def test_ext2_is_torque_where_it_is_wired() -> None:
    bench = started("abb", torque_bits=0x0800)
    assert bench.send(0x0C7F) & 0x0804 == 0x0804 and bench.words.torque
    assert not bench.send(0x047F) & 0x0800 and not bench.words.torque
    other = started("abb")
    assert other.send(0x0C7F) & 0x0800 and not other.words.torque


@OFF_FAMILIES
def test_a_drive_that_stopped_without_a_command_stays_stopped(family: str) -> None:
    bench = started(family)
    bench.application.settings.connection_option = 3
    bench.application.abort_connection()
    bench.words.host_lost()
    assert bench.send(0x047F, 3.0) & 0x0047 == 0x0040 and abs(bench.speed) < 0.01


def test_bits_particular_to_profidrive() -> None:
    bench = started("profidrive", reverse_bits=0x0800)
    assert bench.words.status() & 0xF800 == 0xE800                             # no limit, forward, no overtemperature
    bench.application.inverter.control.limits.torque_forward_nm = 1.0
    assert not bench.run(1.0) & 0x0800
    bench.application.inverter.control.limits.torque_forward_nm = 400.0
    assert not bench.send(0x0C7F, 8.0) & 0x4000 and bench.speed == pytest.approx(-2.0, abs=0.05)


# -- CiA 402 --------------------------------------------------------------------------------------------------------

def test_cia402_words() -> None:
    bench = Bench("cia402", holds_after_quick_stop=True)
    assert bench.words.status() & 0x4F == 0x40
    for word, status in ((0x06, 0x21), (0x07, 0x23), (0x0F, 0x27)):
        assert bench.send(word) & 0x6F == status
    assert bench.run(8.0) & 0x6F == 0x27 and bench.speed == pytest.approx(2.0, abs=0.05)
    assert bench.send(0x02, 3.0) & 0x6F == 0x07 and abs(bench.speed) < 0.01
    assert bench.send(0x0F) & 0x6F == 0x27
    assert bench.send(0x00) & 0x4F == 0x40
    bench.application.fault()
    assert bench.run(0.1) & 0x4F == 0x08 and bench.send(0x80) & 0x4F == 0x40


@pytest.mark.parametrize(("brakes", "status"), [(True, 0x07), (False, 0x40)])
def test_a_quick_stop_in_torque_mode_depends_on_the_drive(brakes: bool, status: int) -> None:
    bench = Bench("cia402", holds_after_quick_stop=True, brakes_in_torque=brakes, torque_bits=0x0800)
    for word in (0x06, 0x07, 0x0F):
        bench.send(word)
    bench.run(5.0)
    bench.send(0x080F, 0.5)
    assert bench.words.torque
    assert bench.send(0x0802, 0.3) & 0x4F == status
    assert (bench.application.inverter.torque_nm < 0.0) is brakes


def test_some_drives_switch_only_while_off() -> None:
    bench = Bench("cia402", torque_bits=0x0800, switch_while_enabled=False)
    for word in (0x06, 0x07, 0x0F, 0x080F):
        bench.send(word)
    assert not bench.words.torque
    bench.send(0x0000)
    bench.send(0x0806)
    assert bench.words.torque


# -- drives that start and stop by level ----------------------------------------------------------------------------

DANFOSS = {"run": 0x047C, "stop": 0x043C, "quick": 0x046C, "coast": 0x0474, "on": (0x0800, 0x0800),
           "off": (0x0800, 0), "fault": (0x0008, 0x0008), "reset": (0x043C, 0x04BC)}
YASKAWA = {"run": 0x0001, "stop": 0x0000, "on": (0x0001, 0x0001), "off": (0x0043, 0x0042), "fault": (0x4000, 0x4000),
           "reset": (0x0000, 0x0008)}
DELTA = {"run": 0x0012, "stop": 0x0011, "on": (0x0003, 0x0003), "off": (0x0003, 0x0002)}


def shows(status: int, bits: object) -> bool:
    assert isinstance(bits, tuple)
    return status & bits[0] == bits[1]


@pytest.mark.parametrize(("family", "words"), [("danfoss_fc", DANFOSS), ("yaskawa", YASKAWA), ("delta", DELTA)])
def test_start_stop_and_fault(family: str, words: dict[str, int]) -> None:
    bench = Bench(family, status_address=0x2101 if family == "delta" else 0x2C)
    assert not shows(bench.words.status(), words["on"])
    assert shows(bench.send(words["run"]), words["on"])
    bench.run(8.0)
    assert bench.speed == pytest.approx(2.0, abs=0.05)
    status = bench.send(words["stop"], 0.5)
    assert 0.4 < bench.speed < 1.8
    if family == "delta":
        assert status & 3 == 1
    assert shows(bench.send(words["stop"], 4.0), words["off"]) and abs(bench.speed) < 0.01
    assert shows(bench.send(words["run"], 5.0), words["on"])
    if "coast" in words:
        assert shows(bench.send(words["coast"]), words["off"]) and bench.application.inverter.torque_nm == 0.0
        assert bench.speed > 1.5
        bench.send(words["run"], 5.0)
        assert shows(bench.send(words["quick"], 0.7), words["on"]) and bench.speed < 0.8
        assert shows(bench.run(2.0), words["off"]) and abs(bench.speed) < 0.01
        bench.send(words["run"], 5.0)
    bench.application.settings.connection_option = 3
    bench.application.abort_connection()
    bench.words.host_lost()
    bench.send(words["run"], 4.0)
    assert abs(bench.speed) < 0.01                                             # the old word doesn't start it again
    bench.send(words["stop"])
    assert shows(bench.send(words["run"]), words["on"])
    if "fault" in words:
        bench.application.fault()
        assert shows(bench.run(3.0), words["fault"]) and abs(bench.speed) < 0.06
        for word in words["reset"]:  # type: ignore[attr-defined]
            bench.send(word)
        assert not shows(bench.words.status(), words["fault"])
        assert shows(bench.send(words["run"]), words["on"])


def test_danfoss_documented_words() -> None:
    bench = Bench("danfoss_fc")
    bench.send(0x047C, 8.0)
    assert bench.words.status() == 0x0F07                                      # running at the reference
    assert bench.send(0x007C) == 0x0F07 and not bench.words.listens            # bit 10: the word is ignored
    assert bench.send(0x003C) == 0x0F07
    assert bench.send(0x847C, 0.0) and bench.words.reversed


@pytest.mark.parametrize(("wiring", "word"), [({}, 0x0002), ({"reverse_bits": 2}, 0x0003)])
def test_yaskawa_directions(wiring: dict[str, int], word: int) -> None:
    bench = Bench("yaskawa", status_address=0x20, **wiring)
    assert bench.send(word, 8.0) & 0x000F == 0x0007 and bench.speed == pytest.approx(-2.0, abs=0.05)
    assert bench.send(0x0004, 4.0) & 0x0008                                    # external fault
    assert Bench("yaskawa", status_address=0x4B).words.status() & 0x00A0 == 0x0020


def test_delta_has_direction_fault_and_reset_elsewhere() -> None:
    bench = Bench("delta", status_address=0x2226)
    extras = bench.words.extras()
    assert bench.send(0x0022, 8.0) & 0x001F == 0x0016 and bench.speed == pytest.approx(-2.0, abs=0.05)
    write = extras[0x2002].write
    assert write is not None and extras[0x2100].read() == 0
    write(1)
    assert bench.run(4.0) & 0x000C == 0x0008 and extras[0x2100].read() == 49
    write(0)
    write(2)
    assert bench.words.status() & 0x000C == 0x0004 and extras[0x2100].read() == 0
    assert bench.send(0x0000) & 0x0010 == 0                                    # 00: nothing
