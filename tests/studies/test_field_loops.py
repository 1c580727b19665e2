"""Figure 19 by the CANopen path: the loop changes the motion of the shaft, but not the slope."""

import pytest

from tdhil.cli.study import SimulatedFieldBench
from tdhil.studies.field.loops import LoopScatter
from tdhil.studies.field.settings import LoopPair, ScatterSettings

pytestmark = [pytest.mark.long, pytest.mark.one_worker]


@pytest.fixture(scope="module")
def outcome():
    pairs = ((300.0, 300.0), (150.0, 300.0), (300.0, 2500.0))
    loops = tuple(LoopPair(kp_nm_s_rad=kp, ki_nm_rad=ki) for kp, ki in pairs)
    settings = ScatterSettings(loops=loops, repeats=2, measured_s=15.0)
    return LoopScatter(SimulatedFieldBench()).run(settings, lambda share, text: None)


def test_one_slope_for_every_loop_at_one_tone(outcome):
    slopes = [run["slope_kg_m2"] for run in outcome.document["runs"]]
    assert len(slopes) == 4
    assert max(slopes) - min(slopes) < 0.02 * min(slopes)
    assert slopes == pytest.approx([118.5] * 4, rel=0.02)


def test_the_motion_is_not_the_same(outcome):
    motion = [run["acceleration_rms_rad_s2"] for run in outcome.document["runs"]]
    assert max(motion) > 1.2 * min(motion)


def test_it_states_that_the_paper_s_claim_does_not_hold_and_why(outcome):
    claim, _, why = outcome.statements
    assert claim.holds is False
    assert why.holds is None
    assert "torque and acceleration alike" in why.ours
