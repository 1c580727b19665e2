"""Messages of a run whose drive has no watchdog, and the override for it."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.drive import Identity, Mode, Preflight
from drivers.errors import CommunicationLost, DriveFault
from tdhil.config.rig import load_rig, simulated_default_rig
from tdhil.errors import exit_code
from tdhil.runner import preconditions
from tdhil.runner.settings import ExcitationRequest
from tdhil.session.confirm import motion_summary
from tdhil.session.task import machine_limits
from tests.rigs import LIMITS, rig_file
from tests.soft_torque.test_evaluation import CASE as STRING
from tests.speed_loop.test_verification import CASE as STEPS

ACTS = "Check the cable; the drive's own watchdog stops the shaft"


def preflight(watchdog_s: float) -> Preflight:
    return Preflight(
        Identity(1, 2, 3, 4, "a drive", False), (), frozenset(Mode), True, True, 1000.0, 1.0, 0.01, watchdog_s,
        "quick_stop" if watchdog_s else "none",
    )


def test_the_confirmation_states_it_and_requires_an_operator_at_the_stop() -> None:
    armed = motion_summary(preflight(0.5), LIMITS, ExcitationRequest())
    assert "watchdog        0.5 s in the drive, then quick stop" in armed
    assert "--accept" not in armed
    unarmed = motion_summary(preflight(0.0), LIMITS, ExcitationRequest())
    assert "watchdog        NONE, accepted by --accept-no-watchdog: the drive will not stop by itself" in unarmed
    assert "[ ] an operator stays at that stop for the whole run" in unarmed
    assert unarmed.count("[ ]") == armed.count("[ ]") + 1


def test_the_confirmation_names_the_motion_of_a_run_without_an_excitation() -> None:
    for case, said in ((STEPS, "small steps of the set speed"), (STRING, "virtual drill string")):
        text = motion_summary(preflight(0.5), LIMITS, ExcitationRequest(), (), case)
        assert f"excitation      {said}" in text and "multisine" not in text
    assert "excitation      multisine" in motion_summary(preflight(0.5), LIMITS, ExcitationRequest())


def test_it_is_not_the_default_and_no_file_sets_it(tmp_path: Path) -> None:
    assert not LIMITS.accept_no_watchdog
    assert not machine_limits(simulated_default_rig()).accept_no_watchdog
    assert machine_limits(simulated_default_rig(), accept_no_watchdog=True).accept_no_watchdog
    for text in ("accept_no_watchdog: true\n", "run: {accept_no_watchdog: true}\n"):
        with pytest.raises(Exception, match=r"rig\.yaml:1: .*accept_no_watchdog"):
            load_rig(rig_file(tmp_path, text))


@pytest.mark.parametrize("found", [None, preflight(0.5)])
def test_an_armed_watchdog_changes_no_message(found: Preflight | None) -> None:
    error = CommunicationLost("no feedback", next_step=ACTS)
    preconditions.correct(error, found)
    assert error.next_step == ACTS
    assert found is None or preconditions.configuration(found) == {}


def test_without_an_armed_watchdog_no_message_promises_its_reaction() -> None:
    found = preflight(0.0)
    error = CommunicationLost("no feedback", where="node 1", next_step=ACTS)
    preconditions.correct(error, found)
    assert "own watchdog" not in str(error)
    assert str(error).startswith("node 1: no feedback. If the shaft still turns, use the hard-wired emergency stop now")
    assert exit_code(error) == 5
    other = DriveFault("EMCY 7305h", next_step="Mend the sensor")
    preconditions.correct(other, found)
    assert other.next_step == "Mend the sensor"
    assert len(preconditions.precondition_warnings(preconditions.configuration(found))) == 1


@pytest.mark.parametrize("run", [{}, {"watchdog": None}, {"watchdog": 3}, {"watchdog": {"armed": True}},
                                 {"watchdog": {"armed": 0}}, {"watchdog": ["armed"]}])
def test_a_log_without_this_entry_gives_no_warning(run: dict[str, object]) -> None:
    assert preconditions.precondition_warnings(run) == ()
