"""A stated lag that the data contradict: it is named, and gives no J."""

from dataclasses import replace

import pytest

from tdhil.estimation import Verdict, identify
from tdhil.recording.recording import LagPrior

OBJECT = "object 0x2250"


@pytest.mark.heavy
@pytest.mark.parametrize(("prior", "said"), [
    (LagPrior(0.20, 0.01, source="rig.yaml"), "rig.yaml states a lag of the reported speed of 0.2 s ± 0.01 s"),
    (LagPrior(0.40, 0.01, 0.05, 0.005, OBJECT), f"{OBJECT} states a lag of the reported torque of 0.05 s ± 0.005 s"),
    (LagPrior(0.20, 0.01, 0.05, 0.005, f"rig.yaml; {OBJECT}"), f"rig.yaml and {OBJECT} state a lag of the reported"),
])
def test_a_wrong_lag_is_named_beside_that_of_the_data(one_recording, prior, said):
    found = identify(replace(one_recording, lag_prior=prior))
    assert found.verdict is Verdict.MODEL_REJECTED and found.inertia is None
    assert f". {said}" in found.reason
    given = f"Without this statement the data give {0.4 if prior.speed_lag_s == 0.20 else 0.15:.1f}"[:-1]
    assert given in found.reason
    assert "filter in the drive" in found.advice
    assert not any("Filters of two poles" in one for one in found.warnings)


def test_a_right_lag_is_not_named(one_recording):
    found = identify(replace(one_recording, lag_prior=LagPrior(0.40, 0.01, 0.15, 0.01, "rig.yaml")))
    assert found.verdict is not Verdict.MODEL_REJECTED
    assert "Without this statement" not in found.reason
