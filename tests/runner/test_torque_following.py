"""Mean reported and commanded torque over a window of torque mode."""

import pytest

from drivers.drive import Command, Mode
from tdhil.runner.observer.torque_following import TORQUE_WINDOW_S, TorqueFollowing
from tests.runner.fake_drive import LIMITS
from tests.runner.guarded import sample

BLOCK_S, COMMANDED_NM = 0.5, 100.0


@pytest.mark.parametrize(("reported_nm", "contradicts"), [(COMMANDED_NM, False), (200.0, True), (0.0, True)])
def test_a_wrong_mean_is_found_once_the_window_is_full(reported_nm, contradicts):
    following, command = TorqueFollowing(LIMITS, 0.0), Command(Mode.TORQUE, 0.0, COMMANDED_NM)
    seen = sample(5.0, reported_nm)._replace(mode=Mode.TORQUE)
    *before, last = (following.see(command, seen, 0.0, BLOCK_S) for _ in range(round(TORQUE_WINDOW_S / BLOCK_S)))
    assert before == [None] * len(before)
    assert (last is not None) is contradicts
