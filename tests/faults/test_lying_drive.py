"""Effect of each lie of `sim_bus.reports` on the five reports, compared with a twin of the drive with true reports.

Both drives have the same seed. A lie in a report alone does not change the shaft. One in the sensor or in the power
stage changes its motion; then the shaft is compared with its reports.
"""

from __future__ import annotations

from math import pi

import numpy as np
import pytest

from sim_bus.application_objects import ApplicationObjects
from sim_bus.canopen.faults import KINDS as CANOPEN
from sim_bus.cia402 import Application
from sim_bus.inverter import Inverter
from sim_bus.modbus.faults import KINDS as MODBUS
from sim_bus.modbus.faults import parse_all as parse_modbus
from sim_bus.objects import ObjectStore, generic_eds, key_of
from sim_bus.params import FAITHFUL, NoiseParams, RigParams
from sim_bus.reports import LIES
from tests.sim_bus.modbus_host import GenericHost, drive

DT_S = 0.002
FASTER = 5.8
OBJECTS = {"speed": 0x606C, "torque": 0x6077, "demand": 0x6074, "position": 0x6064, "status": 0x6041}
TENTH_RPM = pi / 300.0
COUNTS_PER_RAD = 8192 / (2.0 * pi)


class Drive:
    """Drive that is enabled in a cyclic mode, with its objects."""

    def __init__(self, noise: NoiseParams) -> None:
        self.inverter = Inverter(RigParams(reporting=FAITHFUL, noise=noise), np.random.default_rng(5))
        self.application = Application(self.inverter)
        self.store = ObjectStore(1, generic_eds())
        ApplicationObjects(self.store, self.application)
        for word in (6, 7, 15):
            self.application.write_controlword(word)

    def run(self, seconds: float, *, mode: int = 9, speed: float = 5.0, torque: float = 0.0) -> None:
        self.application.set_mode(mode)
        self.application.target_speed_rad_s, self.application.target_torque_nm = speed, torque
        for _ in range(round(seconds / DT_S)):
            self.application.regulate()
            self.application.step(DT_S)

    def told(self) -> dict[str, float]:
        return {name: self.store.number(key_of(index)) for name, index in OBJECTS.items()}


def pair(name: str, value: str = "", *, before_s: float = 3.0, after_s: float = 1.0) -> tuple[Drive, Drive]:
    """Return a drive with this lie for ``after_s`` during acceleration, and its twin."""
    drives = Drive(NoiseParams()), Drive(NoiseParams())
    for one in drives:
        one.run(before_s)
    row = LIES[name]
    row.make(value or row.value).begin(drives[0].inverter.lies)
    for one in drives:
        one.run(after_s, speed=FASTER)
    return drives


REPORTS = [
    ("speed-lost", "", "speed", lambda x: 0), ("torque-lost", "", "torque", lambda x: 0),
    ("demand-lost", "", "demand", lambda x: 0), ("position-lost", "", "position", lambda x: 0),
    ("speed-scale", "0.1", "speed", lambda x: 0.1 * x), ("torque-scale", "10", "torque", lambda x: 10 * x),
    ("demand-scale", "0.5", "demand", lambda x: 0.5 * x), ("position-scale", "2", "position", lambda x: 2 * x),
    ("speed-sign", "", "speed", lambda x: -x), ("torque-sign", "", "torque", lambda x: -x),
    ("demand-sign", "", "demand", lambda x: -x), ("position-sign", "", "position", lambda x: -x),
    ("encoder-inverted", "", "speed", lambda x: -x),
    ("speed-offset", "2", "speed", lambda x: x + 2 / TENTH_RPM), ("torque-offset", "-30", "torque", lambda x: x - 30),
    ("demand-offset", "30", "demand", lambda x: x + 30),
    ("position-offset", "1", "position", lambda x: x + COUNTS_PER_RAD),
    ("speed-coarse", "3", "speed", lambda x: round(x * TENTH_RPM / 3.0) * 3.0 / TENTH_RPM),
    ("torque-coarse", "50", "torque", lambda x: 50 * round(x / 50)),
    ("demand-coarse", "50", "demand", lambda x: 50 * round(x / 50)),
    ("position-coarse", "1", "position", lambda x: round(x / COUNTS_PER_RAD) * COUNTS_PER_RAD),
    ("speed-ones", "", "speed", lambda x: -1), ("torque-ones", "", "torque", lambda x: -1),
    ("demand-ones", "", "demand", lambda x: -1), ("position-ones", "", "position", lambda x: -1),
    ("status-zero", "", "status", lambda x: 0), ("status-ones", "", "status", lambda x: 0xFFFF),
]


@pytest.mark.heavy(but_first=4)
@pytest.mark.parametrize(("name", "value", "signal", "seen"), REPORTS)
def test_one_report_is_wrong_and_nothing_else(name, value, signal, seen):
    drive, twin = pair(name, value)
    told, true = drive.told(), twin.told()
    assert drive.inverter.speed_rad_s == twin.inverter.speed_rad_s
    assert told[signal] == pytest.approx(seen(true[signal]), abs=1.01)
    assert {k: v for k, v in told.items() if k != signal} == {k: v for k, v in true.items() if k != signal}


@pytest.mark.parametrize(("name", "signal"), [
    ("speed-frozen", "speed"), ("torque-frozen", "torque"), ("demand-frozen", "demand"),
    ("position-frozen", "position"),
])
def test_a_report_stays(name, signal):
    drive, twin = pair(name, after_s=DT_S)
    first = drive.told()[signal]
    assert first == twin.told()[signal]
    for one in (drive, twin):
        one.run(0.3, speed=FASTER)
    assert drive.told()[signal] == first != twin.told()[signal]


@pytest.mark.heavy(but_first=2)
@pytest.mark.parametrize(("name", "signals"), [
    ("speed-delay", ("speed",)), ("torque-delay", ("torque",)), ("demand-delay", ("demand",)),
    ("position-delay", ("position",)), ("feedback-delay", ("speed", "torque", "demand", "position")),
])
def test_a_report_comes_late(name, signals):
    drive, twin = pair(name, "200ms", after_s=0.3)
    early = twin.told()
    for one in (drive, twin):
        one.run(0.2, speed=FASTER)
    told, true = drive.told(), twin.told()
    for signal in OBJECTS:
        assert told[signal] == (early if signal in signals else true)[signal], signal
    assert all(early[signal] != true[signal] for signal in signals)


def test_a_statusword_stays():
    drive, _ = pair("status-frozen")
    first = drive.told()["status"]
    drive.application.write_controlword(0)
    assert drive.told()["status"] == first != drive.application.statusword()


@pytest.mark.parametrize(("name", "speed", "torque"), [
    ("speed-swapped", "torque", "torque"), ("torque-swapped", "speed", "speed"),
    ("speed-torque-swapped", "torque", "speed"),
])
def test_counts_are_exchanged(name, speed, torque):
    drive, twin = pair(name)
    told, true = drive.told(), twin.told()
    assert (told["speed"], told["torque"]) == (true[speed], true[torque])
    assert true["speed"] != true["torque"]


@pytest.mark.parametrize(("name", "status", "others"), [("feedback-zero", 0, 0), ("feedback-ones", 0xFFFF, -1)])
def test_all_of_the_feedback(name, status, others):
    drive, twin = pair(name)
    assert drive.told() == {signal: status if signal == "status" else others for signal in OBJECTS}
    assert drive.inverter.speed_rad_s == twin.inverter.speed_rad_s


@pytest.mark.heavy(but_first=2)
@pytest.mark.parametrize(("name", "value", "share"), [
    ("sensor-lost", "", 0.0), ("sensor-scale", "0.5", 0.5), ("sensor-sign", "", -1.0), ("sensor-slips", "40%", 0.6),
])
def test_a_wrong_sensor_misleads_the_drive_and_counts_wrong(name, value, share):
    drive, twin = pair(name, value, after_s=0.01)
    angle, told = drive.inverter.state.angle_rad, drive.told()["position"]
    for one in (drive, twin):
        one.run(1.0, speed=FASTER)
    turned = drive.inverter.state.angle_rad - angle
    counted = (drive.told()["position"] - told) / COUNTS_PER_RAD
    assert counted == pytest.approx(share * turned, rel=0.03, abs=0.003)
    assert drive.inverter.speed_rad_s - twin.inverter.speed_rad_s != 0.0         # the shaft moves differently
    assert drive.told()["torque"] == pytest.approx(drive.inverter.torque_nm, abs=1.0)


@pytest.mark.parametrize(("name", "value", "least", "most"), [
    ("sensor-frozen", "", 0.0, 0.0), ("sensor-offset", "1", 0.0, 9.0), ("sensor-delay", "500ms", 0.0, 9.0),
    ("sensor-coarse", "0.9", 0.8, 9.1),
])
def test_a_sensor_that_is_wrong_in_other_ways(name, value, least, most):
    drive, _ = pair(name, value, after_s=0.1)
    speeds = []
    for _ in range(100):
        drive.run(0.02, speed=FASTER)
        speeds.append(drive.told()["speed"] * TENTH_RPM)
    off = np.abs(np.array(speeds) - drive.inverter.speed_rad_s)
    assert off.max() > 0.3
    assert least <= np.ptp(speeds) <= most


def test_the_drive_turns_with_another_torque_than_it_reports():
    drive, twin = pair("torque-constant", "0.5", after_s=0.1)
    drive.run(0.5, mode=10, torque=200.0)
    assert drive.inverter.torque_nm == pytest.approx(100.0, abs=20.0)
    assert drive.told()["torque"] == pytest.approx(200.0, abs=40.0) == drive.told()["demand"]
    assert twin.inverter.torque_nm != drive.inverter.torque_nm


def test_phases_are_exchanged():
    drive, _ = pair("motor-polarity", after_s=0.01)
    drive.run(0.2, mode=10, torque=100.0)
    assert drive.inverter.torque_nm == pytest.approx(-100.0, abs=40.0)
    assert drive.told()["torque"] == pytest.approx(100.0, abs=40.0)


@pytest.mark.parametrize(("name", "value"), [("quick-stop-inverted", ""), ("torque-stuck", "300")])
def test_a_quick_stop_accelerates_and_the_torque_is_reported_as_it_is(name, value):
    drive, twin = pair(name, value, after_s=0.01)
    before = drive.inverter.speed_rad_s
    for one in (drive, twin):
        one.application.write_controlword(0x02)
        one.run(1.0)
    assert twin.inverter.speed_rad_s < before < drive.inverter.speed_rad_s
    assert drive.told()["torque"] == pytest.approx(drive.inverter.torque_nm, abs=1.0)
    assert drive.inverter.torque_nm > 0.0


@pytest.mark.heavy
def test_a_lie_ends():
    for name in LIES:
        drive, twin = Drive(NoiseParams()), Drive(NoiseParams())
        lie = LIES[name].make(LIES[name].value)
        lie.begin(drive.inverter.lies)
        lie.end(drive.inverter.lies)
        for one in (drive, twin):
            one.run(0.2)
        assert drive.told() == twin.told(), name


@pytest.mark.parametrize(("mode", "then"), [
    (10, lambda application: application.write_controlword(0x02)), (9, lambda application: None),
    (9, lambda application: application.write_controlword(0x00)),
    (9, lambda application: application.write_controlword(0x010F)),
])
def test_the_drive_detects_a_requested_stop(mode, then):
    drive, told = Drive(NoiseParams()), []
    drive.application.on_stop = lambda: told.append(drive.inverter.speed_rad_s)
    drive.run(2.0)
    drive.run(0.5, mode=mode, torque=20.0)
    assert told == []
    then(drive.application)
    drive.run(1.0, speed=0.0 if mode == 9 else 5.0)
    assert len(told) == 1 and told[0] > 1.0


def test_a_drive_at_standstill_is_not_in_a_requested_stop():
    drive, told = Drive(NoiseParams()), []
    drive.application.on_stop = lambda: told.append(0)
    drive.run(1.0, speed=0.0)
    drive.application.write_controlword(0x02)
    drive.run(1.0, speed=0.0)
    assert told == []


@pytest.mark.parametrize("bus", ["canopen", "modbus"])
def test_both_buses_know_every_lie(bus):
    kinds = {"canopen": CANOPEN, "modbus": MODBUS}[bus]
    assert set(LIES) <= set(kinds)
    assert all((kinds[name].takes, kinds[name].value) == (row.takes, row.value) for name, row in LIES.items())


@pytest.mark.parametrize(("fault", "seen"), [
    ("speed-lost@2s", lambda word, rpm, torque: (word, 0.0, torque)),
    ("speed-sign@2s", lambda word, rpm, torque: (word, -rpm, torque)),
    ("torque-scale@2s=2", lambda word, rpm, torque: (word, rpm, 2.0 * torque)),
    ("status-ones@2s", lambda word, rpm, torque: (0xFFFF, rpm, torque)),
    ("feedback-zero@2s", lambda word, rpm, torque: (0, 0.0, 0.0)),
])
def test_the_same_on_modbus(fault, seen):
    hosts = [GenericHost(drive(script=parse_modbus([text], "embedded"), seed=3)) for text in (fault, "sto@99s")]
    for host in hosts:
        for word in (6, 7, 15):
            host.command(word)
        host.command(15, 50.0)
        host.wait(2.5 - host.now_s)
    told, true = (host.command(15, 50.0) for host in hosts)
    assert told == pytest.approx(seen(*true), abs=0.01)
    assert abs(true[1]) > 5.0 and abs(true[2]) > 0.01


@pytest.mark.parametrize(("course", "stops"), [
    (lambda t: max(0.0, 5.0 - t), True), (lambda t: 3.0 + 2.0 * np.cos(2.0 * t), False),
    (lambda t: 2.7 + 2.3 * np.cos(0.6 * t), False), (lambda t: max(2.5, 5.0 - t), False), (lambda t: 4.0, False),
])
def test_a_speed_that_the_host_ramps_down_is_a_stop(course, stops):
    drive, told = Drive(NoiseParams()), []
    drive.run(3.0)
    drive.application.on_stop = lambda: told.append(drive.inverter.speed_rad_s)
    for number in range(90):
        counts = round(course(0.05 * number) / TENTH_RPM)
        drive.run(0.05, speed=counts * TENTH_RPM)
    assert bool(told) is stops
    assert all(speed > 1.0 for speed in told)
