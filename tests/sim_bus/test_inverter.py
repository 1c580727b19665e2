import math

import numpy as np
import pytest

from sim_bus.inverter import RPM, Inverter
from sim_bus.params import FAITHFUL, QUIET, NoiseParams, ReportingParams, RigParams
from sim_bus.plant.rigid import Params

DT = 0.002


def inverter(**parts: object) -> Inverter:
    settings: dict[str, object] = {"noise": QUIET, "reporting": FAITHFUL, **parts}
    return Inverter(RigParams(**settings), np.random.default_rng(1))  # type: ignore[arg-type]


def run(drive: Inverter, seconds: float) -> list[float]:
    speeds = []
    for _ in range(round(seconds / DT)):
        drive.step(DT)
        speeds.append(drive.speed_rad_s)
    return speeds


def test_speed_step_settles_with_the_friction_torque() -> None:
    drive = inverter()
    drive.control.speed(2.0)
    speeds = run(drive, 25.0)
    assert speeds[-1] == pytest.approx(2.0, abs=1e-3)
    assert drive.torque_nm == pytest.approx(60.0 + 8.0 * 2.0, abs=0.5)
    assert max(speeds) < 2.0 * 1.5


def test_torque_limit_holds_and_the_integral_does_not_wind_up() -> None:
    drive = inverter()
    drive.control.speed(10.0)
    torques = []
    for _ in range(6000):
        drive.step(DT)
        torques.append(drive.torque_nm)
    assert max(torques) <= 400.0
    assert drive.control.limited is False
    long_saturation = max(run(drive, 5.0))
    assert long_saturation < 10.0 * 1.15


def test_torque_mode_gives_the_torque_after_its_lag() -> None:
    drive = inverter()
    drive.control.torque(200.0)
    run(drive, 0.01)
    assert drive.torque_nm == pytest.approx(200.0 * (1.0 - math.exp(-1.0)), rel=1e-9)
    run(drive, 0.2)
    assert drive.torque_nm == pytest.approx(200.0)


def test_torque_slope() -> None:
    drive = inverter()
    drive.control.torque(200.0, 100.0)
    run(drive, 1.0)
    assert drive.control.demand_nm == pytest.approx(100.0)
    assert not drive.control.ramp_done


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_speed_limit_acts_in_torque_mode_only_beyond_it(side: float) -> None:
    drive = inverter()
    drive.control.limits.speed_rad_s = 3.0
    drive.control.torque(side * 200.0)
    while abs(drive.control.filtered_rad_s) < 2.99:
        drive.step(DT)
        assert drive.control.demand_nm == side * 200.0
        assert not drive.control.limited
    speeds = run(drive, 15.0)
    assert max(abs(speed) for speed in speeds) < 3.5
    assert abs(speeds[-1]) == pytest.approx(3.0, abs=5e-3)
    assert drive.control.limited
    drive.control.torque(side * 50.0)
    run(drive, 5.0)
    assert abs(drive.speed_rad_s) < 2.9 and not drive.control.limited


def test_switching_is_bumpless_both_ways() -> None:
    drive = inverter()
    drive.control.speed(3.0)
    run(drive, 20.0)
    flowing = drive.control.demand_nm
    drive.control.torque(flowing)
    jumps = []
    for _ in range(500):
        before = drive.control.demand_nm
        drive.step(DT)
        jumps.append(abs(drive.control.demand_nm - before))
    assert max(jumps) < 0.5
    drive.control.speed(drive.control.filtered_rad_s, 1.0, 1.0)
    for _ in range(500):
        before = drive.control.demand_nm
        drive.step(DT)
        jumps.append(abs(drive.control.demand_nm - before))
    assert max(jumps) < 0.5


@pytest.mark.parametrize("torque_mode", [False, True])
def test_stop_follows_its_ramp_and_does_not_reverse(torque_mode: bool) -> None:
    drive = inverter()
    drive.control.speed(5.0)
    run(drive, 20.0)
    if torque_mode:
        drive.control.torque(drive.control.demand_nm)
        run(drive, 1.0)
    drive.control.stop(2.0)
    speeds = run(drive, 6.0)
    rest = next(k for k, speed in enumerate(speeds) if abs(speed) < 0.02) * DT
    assert 5.0 / 2.0 - 0.3 < rest < 5.0 / 2.0 + 0.8
    assert min(speeds) > -0.1
    assert speeds[-1] == 0.0


def test_reporting_is_the_exact_first_order_response() -> None:
    lags = FAITHFUL.model_copy(update={"speed_lag_s": 0.40, "torque_lag_s": 0.15})
    drive = inverter(reporting=lags)
    for k in range(1, 400):
        drive.reporting.step(2.0, 100.0, 0.0, 0.0)
        assert drive.reporting.speed_rad_s == pytest.approx(2.0 * (1 - math.exp(-k * DT / 0.40)), rel=1e-10)
        assert drive.reporting.torque_nm == pytest.approx(100.0 * (1 - math.exp(-k * DT / 0.15)), rel=1e-10)


def test_lag_does_not_depend_on_the_step() -> None:
    results = []
    for dt in (0.002, 0.001, 0.0005):
        drive = inverter(reporting=ReportingParams(speed_noise_rad_s=0.0, torque_noise_nm=0.0, speed_quantum_rpm=0.0,
                                                   torque_quantum_permille=0.0))
        drive.control.torque(200.0)
        for _ in range(round(1.0 / dt)):
            drive.step(dt)
        results.append(drive.reporting.speed_rad_s)
    assert results[0] == pytest.approx(results[2], rel=2e-3)


def test_resolution() -> None:
    drive = Inverter(RigParams(), np.random.default_rng(3))
    drive.control.speed(3.0)
    run(drive, 2.0)
    counts = drive.reporting.speed_rad_s / (0.1 * RPM)
    assert counts == pytest.approx(round(counts), abs=1e-9)
    assert drive.reporting.torque_nm == pytest.approx(round(drive.reporting.torque_nm), abs=1e-9)


@pytest.mark.heavy
def test_noise_has_the_stated_size_and_repeats_with_its_seed() -> None:
    def load(seed: int) -> list[float]:
        params = RigParams(plant=Params(coulomb_nm=1e6), noise=NoiseParams(speed_sensor_rad_s=0.0, torque_nm=0.0))
        drive = Inverter(params, np.random.default_rng(seed))
        values = []
        for _ in range(50000):
            drive.step(DT)
            values.append(drive._disturbance.load_nm)
        return values

    values = load(5)
    assert np.std(values) == pytest.approx(3.0, rel=0.25)
    lagged = np.corrcoef(values[:-250], values[250:])[0, 1]
    assert lagged == pytest.approx(math.exp(-1.0), abs=0.15)
    assert values[:100] == load(5)[:100] != load(6)[:100]


def test_steps_are_equal_and_never_longer_than_the_control_period() -> None:
    drive = inverter()
    assert [drive.steps(period)[0] for period in (0.001, 0.002, 0.004, 0.005, 0.01, 0.0201)] == [1, 1, 2, 3, 5, 11]


def test_no_torque_when_disabled() -> None:
    drive = Inverter(RigParams(), np.random.default_rng(0))
    run(drive, 1.0)
    assert drive.speed_rad_s == 0.0 and drive.torque_nm == 0.0


def test_a_torque_offset_is_added_within_the_limit_and_the_speed_loop_compensates_it() -> None:
    drive = inverter()
    drive.control.speed(3.0)
    run(drive, 20.0)
    before = drive.control.demand_nm
    drive.control.offset_nm = 50.0
    drive.step(DT)
    assert drive.control.demand_nm - before == pytest.approx(50.0, abs=0.5)
    run(drive, 25.0)
    assert drive.speed_rad_s == pytest.approx(3.0, abs=2e-3)
    assert drive.control.demand_nm == pytest.approx(60.0 + 8.0 * 3.0, abs=1.0)
    drive.control.offset_nm = 1000.0
    drive.step(DT)
    assert drive.control.demand_nm == 400.0 and drive.control.limited


def test_a_stop_with_a_remaining_offset_reaches_standstill() -> None:
    drive = inverter()
    drive.control.speed(3.0)
    run(drive, 20.0)
    drive.control.offset_nm = 50.0
    drive.control.stop(2.0)
    run(drive, 15.0)
    assert drive.speed_rad_s == pytest.approx(0.0, abs=1e-3)


def test_the_reference_filter_is_of_first_order_and_begins_at_the_present_speed() -> None:
    slow = RigParams().drive.model_copy(
        update={"reference_filter_s": 0.5, "speed_gain_nm_s_rad": 30000.0, "speed_filter_s": 0.0, "torque_lag_s": 0.0,
                "torque_limit_nm": 4000.0}
    )
    drive = inverter(drive=slow)
    drive.control.speed(2.0)
    speeds = run(drive, 0.5)
    assert speeds[-1] == pytest.approx(2.0 * (1.0 - math.exp(-1.0)), rel=0.02)
    run(drive, 5.0)
    drive.control.torque(drive.control.demand_nm)
    drive.control.speed(2.0)
    drive.step(DT)
    assert drive.speed_rad_s == pytest.approx(2.0, abs=0.01)


def test_every_torque_of_the_drive_shares_its_wrong_unit() -> None:
    drive = inverter(reporting=FAITHFUL.model_copy(update={"torque_scale": 1.05}))
    drive.control.torque(210.0)
    run(drive, 0.5)
    assert drive.torque_nm == pytest.approx(200.0)
    assert drive.reporting.torque_nm == pytest.approx(210.0)
    assert drive.reported_demand_nm == pytest.approx(210.0)


def test_speed_has_a_wrong_unit_and_the_position_counts_true_turns() -> None:
    drive = inverter(reporting=FAITHFUL.model_copy(update={"speed_scale": 1.03}))
    drive.control.speed(2.06)
    run(drive, 30.0)
    before = drive.reported_angle_rad
    run(drive, 1.0)
    assert drive.reporting.speed_rad_s == pytest.approx(2.06, abs=1e-3)
    assert drive.speed_rad_s == pytest.approx(2.0, abs=1e-3)
    assert drive.reported_angle_rad - before == pytest.approx(2.0, abs=2e-3)


@pytest.mark.parametrize("kind", ["rigid", "two_mass", "string"])
def test_an_added_body_is_part_of_the_inertia_at_the_motor(kind: str) -> None:
    def angle(plant: dict[str, object]) -> float:
        drive = inverter(plant=RigParams.model_validate({"plant": {"kind": kind, **plant}}).plant)
        drive.control.torque(300.0)
        run(drive, 1.0)
        return drive.state.angle_rad

    assert angle({"inertia_kg_m2": 100.0, "added_inertia_kg_m2": 55.0}) == angle({"inertia_kg_m2": 155.0})
