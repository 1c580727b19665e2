"""End of `tdhil identify`: exit code and message of each failure, without a run."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from drivers.errors import CommunicationLost, DriveFault, LimitHit
from tdhil.cli.main import main
from tdhil.errors import ExitCode, Interrupted, LogBroken, exit_code
from tdhil.recording.log_reader import read_run
from tdhil.recording.mcap_container import Container
from tdhil.recording.recording import Stage
from tdhil.recording.run_end import find_ended
from tdhil.recording.run_log import RunLog
from tdhil.runner.stop import StopReport
from tdhil.runner.task import RunOutcome
from tdhil.service.run_state import State, end_of
from tdhil.session.conclusion import Conclusion
from tdhil.session.stop_signals import Ending, stop_on_signals

REST = StopReport(True, 12.25, True)
TURNING = StopReport(False, None, False, ("no feedback from the drive any more",))
STAGES = (Stage("setup", 0.0, 3.0, "ok", ""), Stage("speed", 3.0, 10.0, "aborted", ""))
CAUSES = {
    "none": (None, 0), "bus": (CommunicationLost("no feedback for 13 cycles"), 5), "fault": (DriveFault("EMCY"), 6),
    "limit": (LimitHit("too fast"), 7), "Ctrl-C": (Interrupted(2), 130), "SIGTERM": (Interrupted(15), 143),
    "log": (LogBroken("the log can't be written any more"), 3), "mistake": (ZeroDivisionError("ours"), 1),
}


@pytest.fixture
def ends(monkeypatch, tmp_path, capsys):
    """Return ``ends(cause, stop, verdict's code)``: (exit code, stdout, stderr) of a command with such a run."""
    monkeypatch.chdir(tmp_path)

    def ends(cause, stop, verdict=ExitCode.OK, *arguments):
        class Fake:
            def __init__(self, *_arguments, **_options):
                pass

            def run(self):
                return RunOutcome(STAGES, cause, stop, None)

        def conclude(*_arguments, **_options):
            return Conclusion(None, {"verdict": "as the test has it"}, verdict)

        monkeypatch.setattr("tdhil.session.run_session.Runner", Fake)
        monkeypatch.setattr("tdhil.session.conclusion.conclude", conclude)
        monkeypatch.setattr(
            "tdhil.cli.results.print_result", lambda document, _, *, of_motion: print(json.dumps(document)))
        code = main(["identify", "--simulate", "--seed", "1", *arguments])
        said = capsys.readouterr()
        return code, said.out, " ".join(said.err.split())

    return ends


@pytest.mark.parametrize("cause", [cause for cause in CAUSES if cause != "none"])
def test_at_standstill_the_exit_code_is_that_of_the_cause(ends, cause):
    error, code = CAUSES[cause]
    got, out, err = ends(error, REST)
    assert (got, out) == (code, "")
    assert str(error) in err and "the shaft is at standstill (seen at 12.2 s) and the drive is disabled" in err
    assert "tdhil replay run.mcap" in err and "hard-wired" not in err
    assert ("ZeroDivisionError: ours" in err) is (cause == "mistake")      # for a bug, with its traceback


@pytest.mark.parametrize("cause", CAUSES)
def test_an_unconfirmed_stop_ends_with_8_for_any_cause(ends, cause):
    error, _ = CAUSES[cause]
    got, _, err = ends(error, TURNING)
    assert got == 8
    assert "NOT confirmed: no feedback from the drive any more" in err
    assert "Use the hard-wired emergency stop now" in err
    assert error is None or str(error) in err
    assert "at standstill (seen" not in err and "nothing has moved" not in err


def test_before_motion_nothing_moved(ends):
    got, _, err = ends(CAUSES["bus"][0], None)
    assert got == 5 and "the drive was never enabled; nothing has moved" in err


@pytest.mark.parametrize(("stop", "code", "said"), [
    (REST, 7, "at standstill"), (TURNING, 8, "hard-wired emergency stop"),
])
def test_the_document_agrees(ends, stop, code, said):
    got, out, _ = ends(CAUSES["limit"][0], stop, ExitCode.OK, "--json")
    document = json.loads(out)
    assert got == document["exit_code"] == code
    assert document["error"] == {"kind": "LimitHit", "message": str(CAUSES["limit"][0]), "code": "TDH-700"}
    assert said in document["stop"] and document["log"] == "run.mcap"
    assert document["stages"] == [
        {"name": "setup", "outcome": "ok", "duration_s": 3.0},
        {"name": "speed", "outcome": "aborted", "duration_s": 7.0},
    ]


@pytest.mark.parametrize("verdict", [ExitCode.OK, ExitCode.NOT_IDENTIFIABLE])
def test_a_complete_run_has_the_exit_code_of_its_verdict(ends, verdict):
    got, out, err = ends(None, REST, verdict)
    assert got == verdict and json.loads(out) == {"verdict": "as the test has it"}
    assert "tdhil:" not in err


@pytest.mark.parametrize(("cause", "verdict", "code"), [
    ("none", ExitCode.OK, 3), ("none", ExitCode.NOT_IDENTIFIABLE, 9), ("limit", ExitCode.OK, 7),
])
def test_a_log_that_could_not_be_finished_is_never_exit_0(ends, monkeypatch, cause, verdict, code):
    def full(self):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Container, "finish", full)
    got, out, err = ends(CAUSES[cause][0], REST, verdict)
    assert got == code
    assert err.count("the log can't be written any more: No space left on device") == 1
    assert bool(out) is (cause == "none")


def test_the_error_of_the_log_is_reported_once(ends, monkeypatch):
    """The error ended the run, and the close of the log finds the same error."""
    plain = RunLog.close

    def broken(self):
        plain(self)
        raise LogBroken("the log can't be written any more")

    monkeypatch.setattr(RunLog, "close", broken)
    got, _, err = ends(CAUSES["log"][0], REST)
    assert got == 3 and err.count("can't be written any more") == 1


def test_the_result_is_in_the_log(ends):
    from tdhil.recording.log_reader import read_run

    assert ends(None, REST)[0] == 0
    assert read_run(Path("run.mcap")).result == {"verdict": "as the test has it"}


@pytest.mark.parametrize("name", ["SIGINT", "SIGQUIT", "SIGTERM", "SIGHUP", "SIGTSTP"])
def test_each_signal_is_a_wish_to_stop_and_the_first_one_stays(name):
    number, former = signal.Signals[name], signal.getsignal(signal.Signals[name])
    with stop_on_signals() as request:
        assert request.signum is None
        assert callable(signal.getsignal(number))      # otherwise a stop signal would stop the tests
        os.kill(os.getpid(), number)
        os.kill(os.getpid(), signal.SIGTERM)
        assert (request.signum, request.count) == (number, 2)
    assert signal.getsignal(number) is former


@pytest.mark.parametrize("name", ["SIGINT", "SIGQUIT", "SIGTERM", "SIGHUP", "SIGTSTP"])
def test_a_signal_of_a_user_stops_the_run_also_if_the_program_around_ignores_it(name):
    """Each of them stops a run under nohup or in the background of a script."""
    number = signal.Signals[name]
    former = signal.signal(number, signal.SIG_IGN)
    try:
        with stop_on_signals() as request:
            signal.raise_signal(number)
            assert request.signum == number
    finally:
        signal.signal(number, former)


KILLING = [number for number in sorted(signal.valid_signals()) if number not in {
    # Signals that cannot be caught, signals of a crash, harmless signals, and signals that Python ignores.
    signal.SIGKILL, signal.SIGSTOP, signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGCHLD,
    signal.SIGCONT, signal.SIGURG, signal.SIGWINCH, signal.SIGPIPE, signal.SIGXFSZ, signal.SIGTTIN, signal.SIGTTOU,
}]


@pytest.mark.parametrize("number", KILLING)
def test_every_signal_that_would_kill_the_host_is_a_request_to_stop(number):
    # An earlier test may have left a handler: a real-time loop uses SIGXCPU (`tdhil.session.real_time`).
    former = signal.getsignal(number)
    if number != signal.SIGINT:
        signal.signal(number, signal.SIG_DFL)
    try:
        with stop_on_signals() as request:
            signal.raise_signal(number)  # to this thread; os.kill may deliver it to another one
            assert request.signum == number
    finally:
        signal.signal(number, signal.SIG_DFL if former is None else former)
    error = Interrupted(number)
    asks_to_end = (signal.SIGHUP, signal.SIGTERM, signal.SIGQUIT, signal.SIGTSTP)
    assert int(error.exit_code) == (143 if number in asks_to_end else 128 + number)
    assert exit_code(error) == error.exit_code
    assert end_of(int(error.exit_code), stop_confirmed=True) is State.STOPPED


def test_a_signal_that_the_calling_program_handles_is_left_to_it():
    seen = []
    former = signal.signal(signal.SIGALRM, lambda number, frame: seen.append(number))
    try:
        with stop_on_signals() as request:
            os.kill(os.getpid(), signal.SIGALRM)
            assert (request.signum, seen) == (None, [signal.SIGALRM])
    finally:
        signal.signal(signal.SIGALRM, former)


def test_a_run_ended_by_such_a_signal_has_it_in_its_log(ends):
    code, _, err = ends(Interrupted(signal.SIGUSR1), REST)
    assert code == 128 + signal.SIGUSR1
    assert "interrupted by SIGUSR1" in err
    found = find_ended({"ended": {"exit_code": 128 + signal.SIGUSR1}}, ())
    assert found is not None and found.exit_code == 128 + signal.SIGUSR1
    assert find_ended({"ended": {"exit_code": 77}}, ()).exit_code == 1


def test_at_the_end_only_the_first_signal_interrupts():
    former = signal.getsignal(signal.SIGINT)
    with Ending(own_process=False) as ending:
        with pytest.raises(Interrupted):
            os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGTERM)
        assert (ending.code(0), ending.code(5)) == (130, 5)
    with Ending(own_process=False) as ending:
        with stop_on_signals(ending.request) as request:       # the handlers of a run have precedence
            os.kill(os.getpid(), signal.SIGUSR1)
            os.kill(os.getpid(), signal.SIGINT)
            assert request.signum == signal.SIGUSR1
        os.kill(os.getpid(), signal.SIGINT)        # the cause of the end of the run
        assert ending.code(138) == 138
    with Ending(own_process=False) as ending:
        ending.calm()
        for number in (signal.SIGUSR1, signal.SIGINT, signal.SIGTERM):
            os.kill(os.getpid(), number)
        assert ending.code(0) == 128 + signal.SIGUSR1
    with Ending(own_process=False) as ending:
        assert ending.code(0) == 0
    assert signal.getsignal(signal.SIGINT) is former


def test_in_its_own_process_signals_are_ignored_after_the_end():
    kept = {number: signal.getsignal(number) for number in KILLING}
    try:
        with Ending(own_process=True):
            pass
        assert signal.getsignal(signal.SIGINT) is signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGTSTP) is kept[signal.SIGTSTP]
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)


@pytest.mark.heavy
def test_a_burst_of_signals_up_to_the_exit_has_no_effect(tmp_path):
    """The signals come during the stop, while the log closes, and during the exit of the interpreter."""
    log = tmp_path / "run.mcap"
    child = subprocess.Popen(
        [sys.executable, "-m", "tdhil", "identify", "--simulate", "--seed", "1", "--log", str(log)],
        cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )
    assert child.stderr is not None
    for line in child.stderr:
        if "stage speed" in line:
            break
    child.send_signal(signal.SIGINT)
    while child.poll() is None:
        child.send_signal(signal.SIGINT)
        child.send_signal(signal.SIGUSR1)
        time.sleep(0.001)
    err = child.stderr.read()
    assert child.returncode == 130, err
    assert "the shaft is at standstill" in err
    assert read_run(log).complete


def test_a_program_in_the_background_is_not_stopped_by_its_terminal_while_a_shaft_turns():
    former = signal.signal(signal.SIGTTIN, signal.SIG_DFL)
    try:
        with stop_on_signals() as request:
            assert signal.getsignal(signal.SIGTTIN) is signal.getsignal(signal.SIGTTOU) is signal.SIG_IGN
            os.kill(os.getpid(), signal.SIGTTIN)
            assert request.signum is None
        assert signal.getsignal(signal.SIGTTIN) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGTTIN, former)


def test_in_another_thread_signals_stay_with_the_main_threads_owner():
    former = signal.getsignal(signal.SIGTERM)
    seen = []

    def elsewhere():
        with stop_on_signals() as request:
            request.ask(signal.SIGTERM)
            seen.append((request.signum, signal.getsignal(signal.SIGTERM)))

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert seen == [(signal.SIGTERM, former)]
