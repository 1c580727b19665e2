"""Gains of the drive's speed loop, read in preflight: by objects, by registers, in every unit."""

import math

import pytest

from drivers.clock import SteppedClock
from drivers.drive import Outcome
from drivers.errors import ObjectRefused
from drivers.modbus.drive import ModbusDrive
from drivers.modbus.link import EmbeddedLink
from drivers.preflight import PreflightTable
from drivers.speed_loop import ReadSetting, read_speed_loop
from profiles import SpeedControllerParameters
from profiles.library import load_modbus_profile
from sim_bus.params import FAITHFUL, QUIET, DriveParams, RigParams
from tests.drivers.drive_benches import LIMITS, CanopenBench
from tests.drivers.modbus_bench import ModbusBench

RIG = RigParams(noise=QUIET, reporting=FAITHFUL, drive=DriveParams(
    speed_gain_nm_s_rad=1234.5, speed_integral_gain_nm_rad=246.9, speed_filter_s=0.008))
ROWS = ["speed loop: gain", "speed loop: integral", "speed loop: filter"]
ENTRY = {"title": "the manual's", "source": "the manual", "confidence": "likely"}


@pytest.fixture
def bench(request, open_bench):
    return open_bench(request.param, RIG)


def preflight(drive):
    drive.connect()
    return drive.preflight(LIMITS)


def rows_of(found):
    return {check.name: check for check in found.checks if check.name in ROWS}


@pytest.mark.parametrize("bench", [CanopenBench, ModbusBench], indirect=True)
def test_preflight_reads_the_gains_of_the_simulated_drive(bench):
    found = preflight(bench.drive)
    assert found.refused == ()
    present = found.speed_loop
    assert present.gain_nm_s_rad == pytest.approx(1234.5, rel=1e-7)
    assert present.integral_nm_rad == pytest.approx(246.9, rel=1e-6)
    assert present.filter_s == pytest.approx(0.008, rel=1e-6)
    assert list(rows_of(found)) == ROWS
    assert {check.outcome for check in rows_of(found).values()} == {Outcome.NOTE}


def test_counts_value_and_place_are_kept(open_bench):
    bench = open_bench(ModbusBench, RIG)
    present = preflight(bench.drive).speed_loop
    assert (present.gain.raw, present.gain.where, present.gain.unit) == (123450000.0, "register 64", "nm_s_rad")
    assert (present.integral.raw, present.integral.value, present.integral.unit) == (5000000.0, 5000.0, "ms")


@pytest.mark.parametrize("bench", [CanopenBench], indirect=True)
def test_an_object_that_is_not_there_is_a_note(bench):
    bench.simulated.simulator.node.store.remove(0x5FFD)
    found = preflight(bench.drive)
    assert found.refused == ()
    assert {check.found for check in rows_of(found).values()} == {"not reported by the drive"}
    assert (found.speed_loop.gain, found.speed_loop.gain_nm_s_rad, found.speed_loop.integral_nm_rad) == (None,) * 3


def test_a_register_that_is_not_there_is_a_note(open_bench):
    bench = open_bench(ModbusBench, RIG)
    profile = load_modbus_profile("generic/modbus")
    parameters = tuple(
        one if one.name != "speed_gain" else one.model_copy(
            update={"register_": one.register_.model_copy(update={"address": 900})}) for one in profile.parameters)
    clock = SteppedClock()
    drive = ModbusDrive(EmbeddedLink(bench._serve, clock), profile.model_copy(update={"parameters": parameters}),
                        unit=1, rate_hz=100.0)
    found = preflight(drive)
    assert found.refused == ()
    assert rows_of(found)["speed loop: gain"].found == "not reported by the drive"
    present = found.speed_loop
    assert present.gain is None and present.integral.value == 5000.0
    assert present.integral_nm_rad is None                     # an integral time alone gives no gain


def read(values, gain="nm_s_rad", integral="s", smoothing="s", simulated=True, **more):
    said = {
        "gain": {"unit": gain, "parameter": "gain", **ENTRY},
        "integral": {"unit": integral, "parameter": "integral", **ENTRY},
        "filter": {"unit": smoothing, "parameter": "filter", **ENTRY},
    }
    table = PreflightTable()

    def one(name):
        if values[name] is None:
            raise ObjectRefused("no such object", where=name)
        return ReadSetting(values[name], values[name])

    found = read_speed_loop(
        table, SpeedControllerParameters.model_validate(said | more), one, lambda name: f"object {name}",
        simulated=simulated)
    assert all(check.outcome is Outcome.NOTE for check in table.checks)
    return found, table.checks


@pytest.mark.parametrize(("units", "values", "si"), [
    (("nm_s_rad", "s", "s"), (40.0, 0.5, 0.02), (40.0, 80.0, 0.02)),
    (("nm_s_rad", "ms", "ms"), (40.0, 500.0, 20.0), (40.0, 80.0, 0.02)),
    (("nm_s_rad", "nm_rad", "hz"), (40.0, 80.0, 5.0), (40.0, 80.0, 1.0 / (10.0 * math.pi))),
    (("nm_s_rad", "s", "hz"), (40.0, 0.0, 0.0), (40.0, 0.0, 0.0)),              # no integral part, no filter
    (("percent_per_percent", "s", "s"), (10.0, 0.5, 0.02), (None, None, 0.02)),
    (("percent_per_percent", "nm_rad", "s"), (10.0, 80.0, 0.02), (None, 80.0, 0.02)),
    (("a_s_rad", "s", "s"), (10.0, 0.5, 0.02), (None, None, 0.02)),
    (("unknown", "unknown", "unknown"), (10.0, 0.5, 3.0), (None, None, None)),
    (("nm_s_rad", "s", "s"), (None, 0.5, None), (None, None, None)),
    (("nm_s_rad", "s", "s"), (-1.0, math.nan, math.inf), (None, None, None)),
])
def test_units(units, values, si):
    found, checks = read(dict(zip(("gain", "integral", "filter"), values, strict=True)), *units)
    assert (found.gain_nm_s_rad, found.integral_nm_rad, found.filter_s) == tuple(
        value if value is None else pytest.approx(value) for value in si)
    assert [check.name for check in checks] == ROWS


def test_objects_of_the_simulator_are_not_read_from_a_real_drive():
    values = {"gain": 40.0, "integral": 0.5, "filter": 0.02}
    assert read(values, simulated=False, simulated_only=True) == (None, [])
    assert read(values, simulated=True, simulated_only=True)[0].gain_nm_s_rad == 40.0
    assert read(values, simulated=False)[0].gain_nm_s_rad == 40.0
    assert read_speed_loop(PreflightTable(), None, lambda name: ReadSetting(1.0, 1.0), str, simulated=True) is None
