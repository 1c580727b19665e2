"""Stop with any faults of the feedback: no turning shaft is disabled, and standstill is confirmed only if true."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.drive import Sample
from drivers.errors import CommunicationLost
from tests.runner.fake_drive import PERIOD_S, FakeDrive, World

AT_REST_RAD_S = 0.2
"""Speed of standstill, as in the fault injection (`benchmarks/lying_reports.py`)."""

LONGEST_S = 400.0
"""Time limit of a stop, which detects a stop without an end."""


@dataclass(frozen=True)
class Episode:
    """One fault of the feedback, and its number of cycles."""

    kind: str
    cycles: int


@dataclass
class Troubled(FakeDrive):
    """Drive whose feedback goes through the episodes in order. It answers polls while ``answers``."""

    episodes: tuple[Episode, ...] = ()
    answers: bool = True
    interrupts: int = 3
    kept: Sample | None = None
    kinds: list[str] = field(default_factory=list)

    def begin(self):
        self.kinds = [one.kind for one in self.episodes for _ in range(one.cycles)]
        self.misbehave = self._report

    def _report(self, drive, sample):
        assert sample.time_s < LONGEST_S
        kind = self.kinds.pop(0) if self.kinds else "fine"
        if kind == "missing":
            return sample._replace(fresh=False)
        if kind == "lost":
            raise CommunicationLost("no statusword")
        if kind == "interrupt" and self.interrupts:
            self.interrupts -= 1
            raise KeyboardInterrupt
        if kind == "frozen":
            self.kept = self.kept or sample
            return self.kept._replace(time_s=sample.time_s)
        self.kept = None
        return sample

    def poll(self):
        return self.report() if self.answers else None


episodes = st.lists(
    st.builds(Episode, st.sampled_from(["fine", "missing", "lost", "frozen", "interrupt"]), st.integers(1, 150)),
    max_size=6,
).map(tuple)


any_trouble = given(episodes, st.floats(0.0, 9.0), st.booleans(), st.booleans(), st.booleans())


@settings(max_examples=20)
@any_trouble
def test_no_turning_shaft_is_disabled_and_standstill_is_never_false(happens, speed, brakes, in_torque_mode, answers):
    nothing_is_invented(happens, speed, brakes, in_torque_mode, answers)


@pytest.mark.heavy
@settings(max_examples=60)
@any_trouble
def test_the_same_with_more_faults(happens, speed, brakes, in_torque_mode, answers):
    nothing_is_invented(happens, speed, brakes, in_torque_mode, answers)


def nothing_is_invented(happens, speed, brakes, in_torque_mode, answers):
    drive = Troubled(episodes=happens, brakes=brakes, quick_stop_in_torque_mode=in_torque_mode, answers=answers)
    here = World(drive)
    here.turn(speed)
    drive.begin()
    report = here.stop_sequence().run()
    assert all(abs(one) <= AT_REST_RAD_S for one in drive.disabled_at)
    if report.confirmed:
        assert report.disabled and abs(drive.speed) <= AT_REST_RAD_S
    if report.at_rest_s is not None:
        assert report.at_rest_s <= drive.clock.now_s() + PERIOD_S


@settings(max_examples=40)
@given(episodes, st.floats(0.0, 9.0))
def test_a_drive_that_brakes_and_answers_is_confirmed_once_its_feedback_is_back(happens, speed):
    """The stop tolerates each episode, so it always confirms standstill."""
    short = tuple(one for one in happens if one.kind != "frozen")
    here = World(Troubled(episodes=short))
    here.turn(speed)
    here.drive.begin()
    report = here.stop_sequence().run()
    assert report.confirmed, report.trouble
