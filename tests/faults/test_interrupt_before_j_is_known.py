"""Ctrl-C in stage 2 on drives that remove their torque at the end of a quick stop, while the speed report lags."""

import signal

import numpy as np
import pytest

from profiles import load_profile, profile_names
from tdhil.errors import ExitCode
from tdhil.runner.control_loop import ControlLoop
from tdhil.runner.stage_log import StageBook

ENDS_OFF = [name for name in sorted(profile_names()) if load_profile(name).quick_stop.ends == "off"]
AFTER_S = 8.0
"""Time in stage 2, s, of the interruption: the shaft turns steadily, and J is not known."""


@pytest.fixture
def interrupt(monkeypatch):
    """Request a stop by Ctrl-C some seconds after the begin of a stage, in the time of the run."""
    begun, announce, cycle = [], StageBook._announce, ControlLoop.cycle

    def announced(book, name):
        if name == "speed":
            begun.append(book._drive.clock.now_s())
        return announce(book, name)

    def interrupted(loop, command):
        if begun and loop.now_s - begun[0] >= AFTER_S:
            loop._stop_request.ask(signal.SIGINT)
        return cycle(loop, command)

    monkeypatch.setattr(StageBook, "_announce", announced)
    monkeypatch.setattr(ControlLoop, "cycle", interrupted)


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("profile", ENDS_OFF)
def test_the_stop_is_confirmed(profile, rehearse, interrupt):
    bus = load_profile(profile).bus
    run = rehearse("--drive", bus, "--profile", profile)
    assert run.done.code == ExitCode.INTERRUPTED, run.done.err
    assert float(np.abs(run.shaft.speed_rad_s).max()) > 1.0
    assert "is at standstill" in run.done.err
