"""Outcome of a run of the fake drive: stages by name and outcome, and the shaft at standstill."""

import pytest

from drivers.drive import PowerState
from tdhil.runner.task import STAGES

IN_STAGE = 20           # cycles into the stage; setup has moved the shaft by then (probe) after 120
EACH_STAGE = pytest.mark.parametrize("stage", STAGES)


def after(stage):
    return 120 if stage == "setup" else IN_STAGE


def outcomes(result):
    return [(stage.name, stage.outcome) for stage in result.stages]


def up_to(stage):
    index = STAGES.index(stage)
    return [(name, "ok") for name in STAGES[:index]] + [(stage, "aborted")]


def assert_at_rest(here, result):
    assert result.stop.confirmed
    assert here.drive.speed == 0.0
    assert here.drive.disabled_at == [0.0]
    assert here.drive.state is PowerState.OFF
    assert here.drive.closed
    assert here.drive.calls[-1] == "close"
    assert here.display.stops == [True]
