"""Live display: its content. A blocked terminal never delays the control loop."""

import io
import os
import pty
import re
import threading

import pytest
from rich.console import Console, Group

from drivers.drive import Command, Mode, PowerState, Sample
from tdhil.recording import LiveInertia
from tdhil.recording.recording import Stage
from tdhil.report.live import MOST_LINES, LiveDisplay, Painter, inertia_rows

COMMAND = Command(Mode.SPEED, 3.0, 0.0)


def sample(time_s):
    return Sample(time_s, 0.0, 0.0, True, 3.0, 80.0, None, Mode.SPEED, PowerState.ENABLED, False, False, 0x27)


class Stuck:
    """Terminal after Ctrl-S: every write blocks until ``go`` is set."""

    encoding = "utf-8"

    def __init__(self):
        self.go = threading.Event()
        self.writes = 0

    def write(self, text):
        self.writes += 1
        self.go.wait()
        return len(text)

    def flush(self):
        pass

    def isatty(self):
        return True


def whole_run(display, cycles=300):
    """Make every call of a run to a display, from the control loop."""
    for name in ("setup", "speed"):
        display.stage_started(name, 10.0)
        for cycle in range(cycles):
            display._next_s = 0.0      # every cycle draws
            display.cycle(COMMAND, sample(0.004 * cycle))
        display.say("a line")
        display.stage_ended(Stage(name, 0.0, 1.0, "ok"))
    display.stopped(True)


@pytest.mark.parametrize("terminal", [True, False])
def test_a_blocked_write_delays_no_cycle(terminal):
    stuck = Stuck()
    console = Console(file=stuck, force_terminal=terminal, width=80)
    display = LiveDisplay(console, show_preflight=False)
    done = threading.Event()

    def control_loop():
        whole_run(display)
        done.set()

    threading.Thread(target=control_loop, daemon=True).start()
    assert done.wait(30.0), "the control loop hangs on the terminal"
    assert stuck.writes <= 2           # one write is blocked, and no other was attempted
    stuck.go.set()
    assert display._painter.flush(30.0)


def test_a_pty_without_a_reader_delays_no_cycle():
    leader, follower = pty.openpty()
    done = threading.Event()
    try:
        file = os.fdopen(follower, "w", encoding="utf-8")
        display = LiveDisplay(Console(file=file, force_terminal=True, width=80), show_preflight=False)

        def control_loop():
            for _ in range(200):        # far more than the buffer of a pty
                display.say("x" * 1000)
            whole_run(display, cycles=50)
            done.set()

        threading.Thread(target=control_loop, daemon=True).start()
        assert done.wait(30.0), "the control loop hangs on the terminal"
        assert not display._painter.flush(0.2)      # it is full
    finally:
        reader = threading.Thread(target=lambda: _drain(leader), daemon=True)
        reader.start()
        assert display._painter.flush(30.0)
        os.close(leader)


def _drain(leader):
    try:
        while os.read(leader, 65536):
            pass
    except OSError:
        pass


def test_the_end_waits_for_a_blocked_terminal_for_a_bounded_time(monkeypatch):
    monkeypatch.setattr("tdhil.report.live._LONGEST_FLUSH_S", 0.05)
    stuck = Stuck()
    done = threading.Event()

    def run():
        with LiveDisplay(Console(file=stuck, force_terminal=True, width=80), show_preflight=False) as display:
            display.stage_started("setup", 10.0)
            display.cycle(COMMAND, sample(0.0))
        done.set()

    threading.Thread(target=run, daemon=True).start()
    assert done.wait(30.0)
    stuck.go.set()


def test_a_late_picture_is_not_drawn_after_the_end():
    """The next output, such as a prompt or the card, would follow on the same line."""
    import io

    shown, go = io.StringIO(), threading.Event()
    display = LiveDisplay(Console(file=shown, force_terminal=True, width=80), show_preflight=False)
    display.stage_started("setup", 10.0)
    display.cycle(COMMAND, sample(0.0))
    assert display._painter.flush(30.0)
    display._painter.line(lambda: go.wait(30.0))      # a busy computer
    display.stopped(True)
    threading.Timer(0.2, go.set).start()
    display.pause()
    assert display._painter.flush(30.0)
    assert shown.getvalue().count("\x1b[?25l") == 1    # taken once,
    assert shown.getvalue().endswith("\n\x1b[?25h")    # and ended on a new line
    display._painter.end()


def test_lines_come_in_order_and_before_it_is_left():
    import io

    shown = io.StringIO()
    with LiveDisplay(Console(file=shown, width=100), show_preflight=False) as display:
        whole_run(display, cycles=3)
    assert [line for line in shown.getvalue().splitlines() if line] == [
        "stage setup …", "a line", "stage setup ok, 1 s", "stage speed …", "a line", "stage speed ok, 1 s",
        "shaft at standstill, drive disabled",
    ]


def test_an_aborted_stage_shows_its_message_without_the_class_of_the_error():
    import io

    shown = io.StringIO()
    with LiveDisplay(Console(file=shown, width=100), show_preflight=False) as display:
        display.stage_ended(Stage("setup", 0.0, 2.0, "aborted", "PreflightRefused: 1000h: no answer"))
    assert shown.getvalue().strip() == "stage setup aborted, 2 s: 1000h: no answer"


def test_its_thread_ends_with_it():
    import io

    before = set(threading.enumerate())
    with LiveDisplay(Console(file=io.StringIO(), width=100), show_preflight=False) as display:
        whole_run(display, cycles=3)
        threads = [one for one in set(threading.enumerate()) - before if one.name == "display"]
    for thread in threads:
        thread.join(10.0)
    assert threads
    assert not any(thread.is_alive() for thread in threads)


def test_on_a_terminal_the_last_picture_is_that_of_the_end():
    import io

    shown = io.StringIO()
    with LiveDisplay(Console(file=shown, force_terminal=True, width=100), show_preflight=False) as display:
        whole_run(display, cycles=3)
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown.getvalue())       # the final picture with the visible cursor
    assert text.rstrip().splitlines()[-1].startswith("shaft at standstill")
    assert text.endswith("\n")


def test_a_lost_terminal_does_not_affect_the_run():
    painter = Painter()

    def gone():
        raise OSError(5, "hung up")

    painter.line(gone)
    assert painter.flush(30.0)
    seen = []
    painter.line(lambda: seen.append(1))
    assert painter.flush(30.0)
    assert not seen


def test_a_programming_error_is_raised_in_the_control_loop():
    painter = Painter()
    painter.line(lambda: 1 / 0)
    assert painter.flush(30.0)
    with pytest.raises(ZeroDivisionError):
        painter.picture(lambda: None)
    painter.picture(lambda: None)      # once
    assert painter.flush(30.0)


def test_the_latest_picture_and_a_limited_number_of_lines_are_kept():
    painter, go, seen = Painter(), threading.Event(), []
    started = threading.Event()

    def slow():
        started.set()
        go.wait()

    painter.line(slow)
    assert started.wait(30.0)
    for number in range(MOST_LINES + 100):
        painter.line(lambda number=number: seen.append(number))
        painter.picture(lambda number=number: seen.append(-number))
    go.set()
    assert painter.flush(30.0)
    assert seen == [*range(100, MOST_LINES + 100), -(MOST_LINES + 99)]


def test_there_is_no_wait_before_the_first_job():
    assert Painter().flush(0.0)


# -- J during the run -------------------------------------------------------------------------------------------


def answers(**more):
    """Return ten intervals that become narrower."""
    return [
        LiveInertia(60.0 + 20.0 * k, 3 + k, 0.95, "valid", "", 104.0, 104.0 - 4.0 / (k + 1), 104.0 + 3.0 / (k + 1),
                    100.0, 108.0, 0.41, **more)
        for k in range(10)
    ]


def drawn(inertias, width=80):
    console = Console(file=io.StringIO(), width=width)
    console.print(Group(*inertia_rows(inertias, console.width)))
    return console.file.getvalue().splitlines()


def test_the_intervals_of_j_are_drawn_to_one_scale_in_80_columns():
    title, scale, *bars, good, bad, said = drawn(answers())
    assert good.startswith("Good: ") and bad.startswith("Bad: ")
    assert "95 % interval (repeatability)" in title
    assert scale.split() == ["100", "107"]
    assert len(bars) == 6                      # the first, and the latest five
    widths = [bar.index("┤") - bar.index("├") for bar in bars]
    assert widths == sorted(widths, reverse=True)
    assert all("●" in bar and "±" in bar for bar in bars)
    assert bars[-1].split()[-3:] == ["104", "±0.34", "%"]
    assert "12 periods, p 0.41" in said
    assert said.endswith("p 0.41. --tolerance ends a run at an interval.")
    assert max(map(len, drawn(answers(tolerance=0.01, least_left_s=39.0)))) <= 80
    assert "at least 39 s to ±1 %" in drawn(answers(tolerance=0.01, least_left_s=39.0))[-1]


@pytest.mark.parametrize("width", [40, 50, 60, 72, 80])
def test_no_figure_is_cut_in_a_narrow_terminal(width):
    lines = drawn(answers(), width)
    assert max(map(len, lines)) <= width
    bars = [line for line in lines if "●" in line]
    assert [bar.split()[-3:] for bar in bars] == [
        ["104", f"±{half}", "%"] for half in ("3.4", "0.56", "0.48", "0.42", "0.37", "0.34")]
    assert lines[1].split() == ["100", "107"]


def test_one_period_is_written_in_the_singular():
    first = LiveInertia(60.0, 1, 0.95, "valid", "", 104.0, 100.0, 108.0, 100.0, 108.0)
    assert drawn([first])[-1].startswith("1 period. ")


def test_without_a_number_the_reason_is_shown():
    unknown = LiveInertia(80.0, 2, 0.95, "not_identifiable", "too few periods")
    assert drawn([unknown]) == ["J is not known yet: too few periods"]
    assert "now: too few periods" in drawn([answers()[0], unknown])[-1]


def test_a_function_gets_each_answer_and_its_error_ends_no_run():
    console, got = Console(file=io.StringIO(), width=80), []

    def take(found):
        got.append(found)
        if len(got) == 2:
            raise RuntimeError("mine")

    assert not LiveDisplay(console, show_preflight=False).follows_inertia
    display = LiveDisplay(console, show_preflight=False, on_inertia=take)
    assert display.follows_inertia
    for one in answers():
        display.inertia(one)
    assert display._painter.flush(30.0)
    display.say("goes on")
    assert display._painter.flush(30.0)
    assert got == answers()[:2]
    assert "on_inertia is not called any more: RuntimeError: mine" in console.file.getvalue()
