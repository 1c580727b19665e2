"""Bench of the field studies on the real path: repeatability, refusals, and Ctrl-C."""

import signal

import numpy as np
import pytest

from drivers.errors import LimitHit
from tdhil.cli.study import SimulatedFieldBench, bench_rig, plant_of
from tdhil.errors import Interrupted
from tdhil.studies.field.bench import FieldRun
from tdhil.studies.field.settings import SimulatedRig

SHORT = {"amplitude_rad_s": 0.2, "offset_rad_s": 2.5, "periods": 12, "rate_hz": 50.0}


def wish(**changes):
    return FieldRun(SimulatedRig(), **({
        "frequency_hz": 1.0, "speed_gain_nm_s_rad": 300.0, "integral_gain_nm_rad": 300.0, "seed": 1} | SHORT | changes))


def run(**changes):
    return SimulatedFieldBench().run(wish(**changes), lambda share: None)


@pytest.mark.heavy
def test_the_five_stages_ran_and_a_seed_repeats_them():
    first, again, other = run(), run(), run(seed=2)
    assert [stage.name for stage in first.stages] == ["setup", "speed", "torque", "hold", "acquire"]
    assert first.simulated
    assert first.complete
    assert np.array_equal(first.torque_nm, again.torque_nm)
    assert np.array_equal(first.time_s, again.time_s)
    assert not np.array_equal(first.torque_nm, other.torque_nm)
    (segment,) = first.excitation.segments
    assert segment.lines_hz == (1.0,)
    assert segment.amplitudes_rad_s == (0.2,)


@pytest.mark.heavy
def test_progress_rises_to_one():
    shares = []
    SimulatedFieldBench().run(wish(), shares.append)
    assert shares == sorted(shares)
    assert shares[0] == 0.0
    assert shares[-1] == 1.0
    assert len(shares) > 20


@pytest.mark.heavy
def test_a_motion_that_does_not_fit_is_refused_with_the_limit():
    with pytest.raises(LimitHit, match="torque limit"):
        run(amplitude_rad_s=1.5)


@pytest.mark.heavy
def test_ctrl_c_ends_it_as_an_interruption():
    def press(share):
        if share > 0.5 and not pressed:
            pressed.append(share)
            signal.raise_signal(signal.SIGINT)

    pressed: list[float] = []
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(Interrupted):
        SimulatedFieldBench().run(wish(), press)
    assert pressed
    assert signal.getsignal(signal.SIGINT) is before


def test_the_request_reaches_plant_and_guard():
    asked = wish(torque_limit_nm=1500.0, speed_gain_nm_s_rad=700.0)
    plant, rig = plant_of(asked), bench_rig(asked)
    assert plant.drive.speed_gain_nm_s_rad == 700.0
    assert plant.drive.torque_limit_nm == plant.drive.rated_torque_nm == 1500.0
    assert plant.reporting.speed_lag_s == SimulatedRig().speed_lag_s
    assert rig.limits.torque_nm == 1500.0
