"""Question to the operator at the first slow speed, and accepted answers."""

import errno
import io
import os
import signal
import sys
import threading
import time
from unittest.mock import Mock

import pytest
from rich.console import Console

from drivers.errors import PreflightRefused
from tdhil.config.rig import RunSection
from tdhil.errors import Interrupted
from tdhil.session.confirm import confirm_speed, turns_text


class Terminal(io.StringIO):
    def isatty(self):
        return True


def ask(monkeypatch, typed, terminal=True, **options):
    """Return the printed text. The cycles continue while the operator decides."""
    monkeypatch.setattr(sys, "stdin", Terminal(typed) if terminal else io.StringIO(typed))
    console, cycles = Console(file=io.StringIO(), width=200), []
    confirm_speed(
        0.5236, "the drive tells no angle of its shaft", lambda: cycles.append(1), console=console,
        pause_display=lambda: None, **options,
    )
    assert cycles
    return console.file.getvalue()


def test_yes(monkeypatch):
    shown = ask(monkeypatch, "yes\n")
    assert "Does it turn forward once every 12 s?" in shown
    assert "0.524 rad/s" in shown
    assert "tells no angle" in shown


def test_the_main_shaft_is_named_where_a_gear_is(monkeypatch):
    assert "the main shaft, behind the gear, forward once every 60 s" in ask(monkeypatch, "Y\n", gear_ratio=5.0)


@pytest.mark.parametrize("typed", ["no\n", "\n", "", "MOVE\n", "yes it is\n", "ja\n"])
def test_any_other_answer_is_a_no(monkeypatch, typed):
    with pytest.raises(PreflightRefused, match="not confirm that the shaft turns forward once every 12 s") as caught:
        ask(monkeypatch, typed)
    assert "speed scaling in the profile" in caught.value.next_step


def test_without_an_answer_at_the_terminal_it_is_a_no(monkeypatch):
    with pytest.raises(PreflightRefused, match="no operator can confirm") as caught:
        ask(monkeypatch, "yes\n", terminal=False)
    assert "--accept-speed-unit" in caught.value.next_step


def test_a_program_in_the_background_is_refused_not_stopped(monkeypatch):
    """SIGTTIN is ignored in this time, so that a read of the terminal fails with EIO."""
    terminal = Terminal()
    terminal.readline = Mock(side_effect=OSError(errno.EIO, "Input/output error"))
    monkeypatch.setattr(sys, "stdin", terminal)
    with pytest.raises(PreflightRefused, match="the terminal can't be read: Input/output error"):
        confirm_speed(1.0, "", lambda: None, console=Console(file=io.StringIO()), pause_display=lambda: None)


def test_a_terminal_that_takes_nothing_holds_no_cycle_up(monkeypatch):
    """With Ctrl-S or a blocked connection, cycles and stop continue while the shaft turns."""
    taken, cycles = threading.Event(), []
    stuck = io.StringIO()
    stuck.write = lambda text: taken.wait(5.0) and len(text)
    monkeypatch.setattr(sys, "stdin", Terminal("yes\n"))

    def idle():
        cycles.append(1)
        if len(cycles) == 50:
            raise Interrupted(signal.SIGINT)

    try:
        with pytest.raises(Interrupted):
            confirm_speed(1.0, "", idle, console=Console(file=stuck), pause_display=lambda: None)
    finally:
        taken.set()
        for thread in threading.enumerate():       # it still reads sys.stdin, which is that of the next test then
            if thread.name == "prompt":
                thread.join()


@pytest.mark.skipif(sys.platform == "win32", reason="no such terminals there")
def test_what_was_typed_before_the_question_is_no_answer(monkeypatch):
    operator, terminal = os.openpty()
    shown, answered, cycles = io.StringIO(), [], []

    def idle():
        time.sleep(0.001)
        cycles.append(1)
        assert len(cycles) < 60_000, "the answer was not received"
        if "yes and Enter" in shown.getvalue() and not answered:    # after the question
            answered.append(os.write(operator, b"no\n"))

    with os.fdopen(terminal, encoding="utf-8") as stdin, os.fdopen(operator, "wb", buffering=0):
        monkeypatch.setattr(sys, "stdin", stdin)
        os.write(operator, b"yes\n")
        with pytest.raises(PreflightRefused, match="did not confirm that the shaft turns"):
            confirm_speed(1.0, "", idle, console=Console(file=shown, width=200), pause_display=lambda: None)


def test_no_terminal_at_all(monkeypatch):
    monkeypatch.setattr(sys, "stdin", None)
    with pytest.raises(PreflightRefused, match="no operator can confirm"):
        confirm_speed(1.0, "", lambda: None, console=Console(file=io.StringIO()), pause_display=lambda: None)


def test_no_file_answers_it():
    assert "--accept-speed-unit" in RunSection.never_here["accept_speed_unit"]


@pytest.mark.parametrize(("speed_rad_s", "said"), [
    (0.5236, "forward once every 12 s"), (-0.5236, "backwards once every 12 s"), (7.5, "forward 11.9 times in 10 s"),
])
def test_words_for_a_speed(speed_rad_s, said):
    assert turns_text(speed_rad_s) == said
