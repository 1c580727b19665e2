"""Simulator of the benchmark, compared with closed forms: every lag structure, the shaft, the noise."""

from dataclasses import replace

import numpy as np
import pytest

from tdhil.studies.coverage.plants import FLEET, FloatArray, HostSampling, PlantNoise, ReportFilter
from tdhil.studies.coverage.simulate import coloured, lagged, quiet_shaft, shown, simulate

STEP = 0.002
PLANT = {plant.name: plant for plant in FLEET}


def poles_by_scipy(report: ReportFilter, omega: float) -> complex:
    """Return poles by scipy, and average and delay by their textbook forms."""
    from scipy.signal import freqs

    bottom = np.array([1.0])
    for lag in report.lags_s:
        bottom = np.polymul(bottom, [lag, 1.0])
    _, h = freqs([1.0], bottom, worN=[omega])
    sinc = np.sinc(omega * report.average_s / (2.0 * np.pi)) * np.exp(-0.5j * omega * report.average_s)
    return complex(h[0] * sinc * np.exp(-1j * omega * report.delay_s))


@pytest.mark.parametrize(
    "report",
    [
        ReportFilter(),
        ReportFilter((0.4,)),
        ReportFilter((0.2, 0.07)),
        ReportFilter((), 0.4),
        ReportFilter((0.1,), 0.5),
        ReportFilter((0.2,), 0.0, 0.04),
        ReportFilter((0.15,), 0.3, 0.0137),
    ],
    ids=str,
)
@pytest.mark.parametrize("hertz", [0.1, 0.4, 2.0])
def test_a_report_has_its_closed_form_frequency_response(report: ReportFilter, hertz: float) -> None:
    time = np.arange(round(30.0 / STEP)) * STEP
    wave = np.cos(2.0 * np.pi * hertz * time)
    rng = np.random.default_rng(3)
    at = np.sort(rng.uniform(15.0, 29.0, 4000))
    seen = shown(lagged(wave[:, None], report, STEP)[:, 0], report, STEP, at)
    angle = 2.0 * np.pi * hertz * at
    p, q = np.linalg.lstsq(np.column_stack([np.cos(angle), np.sin(angle)]), seen, rcond=None)[0]
    expected = poles_by_scipy(report, 2.0 * np.pi * hertz)
    assert abs((p - 1j * q) - expected) < 1e-4
    mine = report.response(np.array([2j * np.pi * hertz]))[0]
    assert abs(mine - expected) < 1e-12


@pytest.mark.parametrize("name", ["servo", "field", "modbus"])
def test_a_report_is_constant_at_the_start_if_its_signal_is(name: str) -> None:
    report = replace(PLANT[name].speed_report, average_s=0.3)
    still = np.full((500, 1), 7.0)
    seen = shown(lagged(still, report, STEP)[:, 0], report, STEP, np.linspace(0.0, 0.9, 50))
    assert np.allclose(seen, 7.0, rtol=1e-12)


@pytest.mark.heavy
def test_the_shaft_follows_newton_at_every_line() -> None:
    plant = PLANT["field"]
    asked, shaft = quiet_shaft(plant, np.array([-1.0, 1.0]), 4)
    for run, segments in enumerate(asked.segments):
        for segment in segments:
            begin = segment.end_s - segment.period_s
            rows = slice(round(begin / STEP), round(segment.end_s / STEP))
            time = np.arange(rows.start, rows.stop) * STEP
            speed, torque = shaft.speed[rows, run], shaft.torque[rows, run]
            drift = (shaft.speed[rows.stop, run] - speed[0]) / segment.period_s
            assert torque.mean() == pytest.approx(60.0 + 8.0 * speed.mean() + 104.0 * drift, rel=1e-4)
            for hertz in segment.lines_hz:
                s = 2j * np.pi * hertz
                turned = np.exp(-s * (time - time[0]))
                # integration by parts: the net change of speed is the end term
                w, t = (turned * speed).mean(), (turned * torque).mean()
                assert t == pytest.approx((104.0 * s + 8.0) * w + 104.0 * drift, rel=1e-4)



@pytest.mark.heavy
@pytest.mark.parametrize("name", ["stribeck", "fan"])
def test_nonlinear_friction_agrees_with_an_integrator_of_scipy(name: str) -> None:
    """The reference integrates the torque of the run, linear between steps, with scipy."""
    from scipy.integrate import solve_ivp

    plant = PLANT[name]
    _, shaft = quiet_shaft(plant, np.array([0.5]), 4)
    time = np.arange(len(shaft.speed)) * STEP

    def rate(t: float, speed: FloatArray) -> FloatArray:
        bell = 24.0 * np.exp(-((speed / 1.5) ** 2)) if name == "stribeck" else 0.6 * speed**2
        viscous = 8.0 if name == "stribeck" else 4.0
        acceleration: FloatArray = (np.interp(t, time, shaft.torque[:, 0]) - viscous * speed - 60.0 - bell) / 104.0
        return acceleration

    end = 20.0
    found = solve_ivp(rate, (0.0, end), shaft.speed[0], max_step=STEP, rtol=1e-8, atol=1e-10)
    assert found.y[0, -1] == pytest.approx(float(shaft.speed[round(end / STEP), 0]), rel=3e-6)
    assert np.ptp(found.y[0]) > 1.0


def test_the_load_is_coloured_as_stated() -> None:
    white = np.random.default_rng(5).standard_normal((200_000, 4))
    found = coloured(white, STEP, 0.5)
    assert found.std() == pytest.approx(1.0, rel=0.06)
    later = 250
    assert np.mean(found[later:] * found[:-later]) == pytest.approx(np.exp(-1.0), abs=0.06)


@pytest.mark.heavy
def test_a_run_does_not_depend_on_the_other_runs() -> None:
    plant = PLANT["coarse"]
    alone = simulate(plant, [(1, 2, 3)], 4)[0]
    among = simulate(plant, [(1, 2, 9), (1, 2, 3)], 4)[1]
    for name in ("time_s", "speed_rad_s", "torque_nm", "fresh"):
        assert np.array_equal(getattr(alone, name), getattr(among, name)), name


@pytest.mark.heavy
def test_rounding_drops_and_rate_are_as_stated() -> None:
    plant = PLANT["coarse"]
    record = simulate(plant, [(1, 2, 3)], 4)[0]
    quantum = plant.noise.speed_quantum_rad_s
    assert np.allclose(record.speed_rad_s / quantum, np.round(record.speed_rad_s / quantum), atol=1e-9)
    assert np.mean(~record.fresh) == pytest.approx(0.05, abs=0.01)
    assert np.median(np.diff(record.time_s)) == pytest.approx(0.01, rel=0.1)
    assert np.all(np.diff(record.time_s) > 0.0)


@pytest.mark.heavy
def test_a_plant_whose_speed_reaches_zero_is_refused() -> None:
    wild = replace(PLANT["field"], noise=PlantNoise(load_nm=400.0, load_time_s=5.0), reading=HostSampling())
    with pytest.raises(ValueError, match="reaches zero"):
        simulate(wild, [(1,), (2,)], 4)
