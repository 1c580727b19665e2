"""Tuned gains on the simulated drive, by CANopen frames in stepped time: a bit that sticks, and one that turns.

The string of the simulated drive and the string of the tuning share no code.
"""

from __future__ import annotations

import argparse
from math import pi
from pathlib import Path

import numpy as np
import pytest

from drivers import Command, Mode, PowerState, SteppedClock
from drivers.canopen import CanopenDrive
from drivers.drive import DriveLimits
from profiles.library import load_canopen_profile
from sim_bus.canopen.command import add_arguments
from sim_bus.canopen.inline import InlineSimulator
from sim_bus.command_arguments import rig_of
from tdhil.soft_torque import Interval, TopDrive, TuneCase, load_string, tune
from tests.rigs import plant_file

EXAMPLES = Path(__file__).parents[2] / "examples"
RPM = 2.0 * pi / 60.0
LIMITS = DriveLimits(speed_rad_s=25.0, torque_nm=28_000.0, quick_stop_rad_s2=1.0, watchdog_s=0.5,
                     accept_wider=frozenset({"quick-stop", "torque", "speed"}))
SET_RPM, RAMP_RPM_S, SECONDS = 100.0, 4.0, 85.0


@pytest.fixture(scope="module")
def tuned():
    """Return stiff and soft gains for the machine of plant.yaml, with lags of 20 and 10 ms and its sampling."""
    return gains()


def gains():
    """Return the gains by kind."""
    drive = TopDrive(1500.0, 8.0, 60.0, (0.020, 0.010, 0.003))
    case = TuneCase(load_string(EXAMPLES / "string.yaml"), drive, Interval(1500.0, 1440.0, 1560.0))
    return {one.kind: one.controller for one in tune(case, search=None).tuned}


def rig_with(tmp_path, law):
    """Return the rig of `tdhil simulate canopen --plant … --gains P I`: the example with 3,000 m."""
    text = (EXAMPLES / "plant_stick_slip.yaml").read_text(encoding="utf-8")
    plant = plant_file(tmp_path, text.replace("kind: string\n", "kind: string\n  length_m: 3000.0\n", 1))
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    return rig_of(parser.parse_args(
        ["--plant", str(plant), "--gains", f"{law.gain_nm_s_rad:.6g}", f"{law.integral_nm_rad:.6g}"]))


def turned(rig, set_rpm=SET_RPM, seconds=SECONDS, trace=None):
    """Ramp the set speed over the bus; return times, true speed of the bit, reported speed of the top, rad/s."""
    simulated = InlineSimulator(rig, seed=5).open()
    profile = load_canopen_profile("generic/cia402")
    drive = CanopenDrive(simulated.station(), profile, SteppedClock(), node=1, rate_hz=25.0)
    times, bit, top = [], [], []
    try:
        assert drive.connect().simulated
        assert not drive.preflight(LIMITS).refused
        drive.enable(Mode.SPEED)
        enabled_s = None
        while not times or times[-1] < seconds:
            wanted = 0.0 if enabled_s is None else min(set_rpm, RAMP_RPM_S * (times[-1] if times else 0.0)) * RPM
            sample = drive.exchange(Command(Mode.SPEED, wanted, 0.0))
            if enabled_s is None:
                enabled_s = sample.time_s if sample.state is PowerState.ENABLED else None
                continue
            times.append(sample.time_s - enabled_s)
            bit.append(simulated.simulator.node.inverter.state.bottom_speed_rad_s)
            top.append(sample.speed_rad_s)
    finally:
        drive.close()
        simulated.close()
    return np.array(times), np.array(bit), np.array(top)


@pytest.mark.heavy
@pytest.mark.parametrize(("kind", "sticks"), [("stiff", True), ("soft", False)])
def test_the_bit_sticks_under_the_stiff_gains_and_turns_under_the_soft_ones(tuned, tmp_path, kind, sticks):
    times, bit, top = turned(rig_with(tmp_path, tuned[kind]))
    late = times > SECONDS - 25.0
    assert np.mean(top[late]) == pytest.approx(SET_RPM * RPM, rel=0.05)
    if sticks:
        assert np.mean(bit[late] == 0.0) > 0.1
        assert bit[late].max() > 1.8 * SET_RPM * RPM
    else:
        assert bit[late].min() > 0.9 * SET_RPM * RPM
        assert bit[late].max() < 1.1 * SET_RPM * RPM


def test_invalid_gains_are_refused(tmp_path, capsys):
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    for words in (["--gains", "300"], ["--gains", "-1", "3"], ["--gains", "nan", "3"]):
        with pytest.raises(SystemExit):
            parser.parse_args(words)
    assert "is not a gain" in capsys.readouterr().err
    assert rig_of(parser.parse_args([])).drive.speed_gain_nm_s_rad == 300.0
