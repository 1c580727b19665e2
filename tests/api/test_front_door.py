"""Python API: the same documents as on the command line, and the same guard, stop and confirmation."""

import contextlib
import json
import os
import runpy
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

import tdhil
from drivers.drive import Identity, Mode, Preflight
from drivers.errors import PreflightRefused
from tdhil.cli.main import main
from tdhil.errors import Interrupted, UsageError
from tdhil.session.confirm import CallbackOperator, TerminalOperator
from tdhil.session.stop_signals import stop_on_signals
from tests.rigs import rig_file

pytestmark = pytest.mark.one_worker      # its fixture is expensive

SHORT = tdhil.Multisine(frequency_hz=0.3, periods=6)
EXAMPLE = Path(__file__).parents[2] / "examples" / "identify_in_python.py"


@pytest.fixture(autouse=True)
def here(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    with contextlib.chdir(folder), tdhil.simulate(seed=7) as drive:
        return tdhil.run(drive, SHORT, mode="speed", rate_hz=50.0, log=folder / "run.mcap", operator="A. Tester")


def test_importing_it_loads_nothing():
    code = "import sys, tdhil; print(sorted({'numpy', 'scipy', 'can', 'rich', 'pydantic'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_public_name_exists():
    for name in tdhil.__all__:
        assert getattr(tdhil, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = tdhil.nothing


@pytest.mark.long(but_first=2)
@pytest.mark.heavy
@pytest.mark.parametrize("first", ["tdhil", "tdhil.runner", "tdhil.runner.guard", "tdhil.api"])
def test_run_is_callable_after_any_imports(first):
    code = f"import {first}, tdhil\ntry: tdhil.run(tdhil.simulate(seed=7).__enter__(), no_guard=True)\n"
    code += "except tdhil.TdhilError as err: print(err)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "unknown option: no_guard" in done.stdout


@pytest.mark.heavy
def test_a_run_is_read_back_unchanged(record):
    again = tdhil.read(record.log)
    assert (again.recording.time_s == record.recording.time_s).all()
    assert (again.recording.torque_nm == record.recording.torque_nm).all()
    assert again.recording.excitation == record.recording.excitation
    assert again.whole
    assert again.configuration["operator"] == "A. Tester"
    assert tdhil.identify(again).to_dict() == tdhil.identify(record).to_dict()


@pytest.mark.heavy
def test_the_document_is_that_of_the_command_line(record, capsys):
    code = main(["replay", record.log, "--json", "--model", "rigid", "--confidence", "0.9"])
    result = tdhil.identify(tdhil.read(record.log), model="rigid", confidence=0.9)
    assert json.loads(json.dumps(result.to_dict())) == json.loads(capsys.readouterr().out)
    assert result.exit_code == code


@pytest.mark.heavy
def test_a_result_shows_itself_as_the_card(record, capsys):
    result = tdhil.identify(record)
    main(["replay", record.log])
    assert str(result).split() == capsys.readouterr().out.split()
    html = result._repr_html_()
    assert html.startswith("<pre") and "moment of inertia at the motor shaft" in html and "SIMULATED" in html
    assert max(map(len, str(result).splitlines())) <= 80
    assert "SIMULATED" in repr(record)
    assert repr(result).startswith(f"<SIMULATED {result.verdict.value}: {result.inertia.value:.1f} (")
    assert repr(result).endswith(f" kg·m², {record.log}>")
    known = {"value": 104.0, "low_total": 100.0, "high_total": 108.0}
    with_number = replace(result, document={**result.document, "inertia_kg_m2": known})
    assert "104.0 (100.0 to 108.0) kg·m²" in repr(with_number)


@pytest.mark.heavy
def test_a_trace_in_csv_takes_the_options_of_replay(record, capsys, tmp_path):
    rows = zip(record.recording.time_s, record.recording.speed_rad_s, record.recording.torque_nm, strict=True)
    trace = tmp_path / "trace.csv"
    trace.write_text("t,w,m\n" + "".join(f"{t:.4f},{w / 0.10471975512:.4f},{m:.3f}\n" for t, w, m in rows))
    columns = ["time=t:s", "speed=w:rpm", "torque=m:N·m"]
    found = tdhil.identify(tdhil.read(trace, columns=columns, gear_ratio=2.0, torque_scale_rel_sd=0.01))
    main(["replay", str(trace), "--json", "--gear", "2", "--torque-scale-sd", "0.01", "--columns", *columns])
    assert json.loads(json.dumps(found.to_dict())) == json.loads(capsys.readouterr().out)
    with pytest.raises(UsageError, match="for a trace in CSV"):
        tdhil.read(record.log, gear_ratio=2.0)


@pytest.mark.heavy
def test_the_cause_of_an_abort_is_raised_at_standstill(tmp_path):
    with tdhil.simulate(seed=7, faults=["sto@speed+15s"]) as drive, pytest.raises(tdhil.TdhilError) as caught:
        tdhil.run(drive, SHORT, log="broken.mcap")
    assert "log: broken.mcap" in caught.value.__notes__
    assert tdhil.read("broken.mcap").ended is not None
    assert not tdhil.read("broken.mcap").whole


def test_a_refusal_before_motion_is_raised_and_keeps_the_last_log():
    with tdhil.simulate(seed=7) as drive, pytest.raises(PreflightRefused, match="plan of stage 5"):
        tdhil.run(drive, tdhil.Multisine(amplitude_rad_s=1000.0), log="none.mcap")
    assert not Path("none.mcap").exists()


@pytest.mark.parametrize(("wrong", "said"), [
    ({"plant": "nowhere.yaml"}, "nowhere.yaml"),
    ({"faults": ["nonsense"]}, "no fault is called"),
    ({"profile": "nobody/nothing"}, "nobody/nothing"),
])
def test_impossible_values_are_reported_when_the_drive_is_named(wrong, said):
    with pytest.raises(tdhil.TdhilError, match=said), tdhil.simulate(seed=7, **wrong):
        pass


@pytest.mark.parametrize(("wrong", "said"), [
    ({"rate_hz": -1.0}, "rate_hz: "),
    ({"node": 300}, "node: "),
    ({"real_time": True, "stepped": True}, "stepped"),
])
def test_an_option_has_its_python_name(tmp_path, wrong, said):
    rig = rig_file(tmp_path, "run: {seed: 7}\n")
    with pytest.raises(UsageError) as caught, tdhil.open_drive(rig, **wrong):
        pass
    assert said in str(caught.value) and f"--{said[:4]}" not in str(caught.value)


@pytest.mark.heavy
def test_impossible_values_have_their_python_names(record, tmp_path, capsys):
    with pytest.raises(UsageError, match="confidence") as caught:
        tdhil.identify(record, confidence=7.0)
    assert "--confidence" not in str(caught.value)
    with pytest.raises(UsageError, match="tolerance: ") as caught, tdhil.simulate(seed=7) as drive:
        tdhil.run(drive, tolerance=-1.0, log=tmp_path / "none.mcap")
    assert "--tolerance" not in str(caught.value)
    with pytest.raises(tdhil.TdhilError, match="columns") as caught:
        trace = tmp_path / "trace.csv"
        trace.write_text("a,b,c\n1,2,3\n2,2,3\n")
        tdhil.read(trace)
    assert "--columns" not in str(caught.value)
    assert main(["replay", str(trace), "--json"]) == 2             # the same error, on the command line
    assert "--columns" in capsys.readouterr().err


def test_a_drive_is_named_without_a_motion_being_planned(tmp_path):
    rig = rig_file(tmp_path, "run: {amplitude_rad_s: 50.0}\n")             # no motion of this bench fits its limits
    with tdhil.simulate(rig=rig) as drive, pytest.raises(PreflightRefused, match="plan of stage 5"):
        tdhil.run(drive, tdhil.Multisine())
    with tdhil.open_drive(rig, simulate=True) as drive:
        assert drive.rig.run.amplitude_rad_s == 50.0


class AskedLater(tdhil.StopRequest):
    """Stop request that triggers after a number of checks, independent of any clock."""

    polls = 1500

    @property
    def signum(self):
        self.polls -= 1
        return int(signal.SIGINT) if self.polls < 0 else None

    @signum.setter
    def signum(self, value):
        assert value is None


@pytest.mark.heavy
def test_a_run_in_a_thread_is_stopped_by_its_request_without_changes_of_signals(tmp_path):
    former = signal.getsignal(signal.SIGINT)
    handlers = set()

    def run():
        with tdhil.simulate(seed=7) as drive:
            handlers.add(signal.getsignal(signal.SIGINT))
            return tdhil.run(drive, SHORT, log=tmp_path / "run.mcap", stop=AskedLater())

    with ThreadPoolExecutor(1) as pool, pytest.raises(Interrupted, match="Ctrl-C") as caught:
        pool.submit(run).result()
    assert handlers == {former} and signal.getsignal(signal.SIGINT) is former
    assert any(str(tmp_path / "run.mcap") in note for note in caught.value.__notes__)
    recording = tdhil.read(tmp_path / "run.mcap").recording
    assert recording.speed_rad_s.max() > 0.4 and abs(recording.speed_rad_s[-1]) < 0.1


def test_an_own_request_also_receives_signals_in_the_main_thread():
    mine = tdhil.StopRequest()
    with stop_on_signals(mine) as request:
        assert request is mine
        os.kill(os.getpid(), signal.SIGTERM)
    assert (mine.signum, mine.count) == (signal.SIGTERM, 1)
    other = tdhil.StopRequest()
    other.ask()
    assert other.signum == signal.SIGINT


def test_an_unknown_option_is_refused():
    with tdhil.simulate(seed=7) as drive, pytest.raises(UsageError, match="unknown option: no_guard"):
        tdhil.run(drive, SHORT, no_guard=True)


class Asked:
    """Preflight of a real drive, with the fields that a confirmation uses."""

    def __init__(self):
        self.cycles = 0

    def idle(self):
        self.cycles += 1


def ask(operator_interface, real_preflight, asked):
    from tdhil.config.rig import simulated_default_rig
    from tdhil.runner.settings import ExcitationRequest
    from tdhil.runner.task import Task
    from tdhil.session.task import machine_limits

    task = Task(machine_limits(simulated_default_rig()), ExcitationRequest())
    operator_interface.confirm(task, real_preflight, asked.idle, ())


@pytest.fixture
def real_preflight():
    return Preflight(
        identity=Identity(1, 2, 3, 4, "a real drive", simulated=False), checks=(),
        modes=frozenset({Mode.SPEED, Mode.TORQUE}), switch_while_enabled=True, quick_stop_in_torque_mode=True,
        rated_torque_nm=500.0, torque_resolution_nm=0.5, speed_resolution_rad_s=0.01, watchdog_s=0.5,
        safe_action="quick_stop",
    )


@pytest.mark.parametrize("answer", [False, None, "yes", 1])
def test_only_true_moves_a_real_shaft(real_preflight, answer):
    from tdhil.report.console import stderr_console

    told = []
    operator_interface = CallbackOperator(stderr_console(), lambda text: told.append(text) or answer)
    with pytest.raises(PreflightRefused, match="not confirmed"):
        ask(operator_interface, real_preflight, Asked())
    assert "hard-wired emergency stop" in told[0]


def test_a_confirmation_that_fails_moves_nothing_and_feeds_the_watchdog(real_preflight):
    import time

    from tdhil.report.console import stderr_console

    asked = Asked()

    def fails(text):
        while not asked.cycles:
            time.sleep(0.001)
        raise RuntimeError("nobody home")

    with pytest.raises(RuntimeError, match="nobody home"):
        ask(CallbackOperator(stderr_console(), fails), real_preflight, asked)
    assert asked.cycles > 0


def test_without_a_terminal_there_is_no_confirmation(real_preflight, monkeypatch):
    from tdhil.report.console import stderr_console

    monkeypatch.setattr("sys.stdin", None)
    with pytest.raises(PreflightRefused, match="no operator can confirm"):
        ask(TerminalOperator(stderr_console()), real_preflight, Asked())


def test_true_moves(real_preflight):
    from tdhil.report.console import stderr_console

    ask(CallbackOperator(stderr_console(), lambda text: True), real_preflight, Asked())


@pytest.mark.heavy
def test_frames_for_notebooks(record):
    pytest.importorskip("pandas")
    frame = record.to_pandas()
    assert list(frame.columns) == ["speed_rad_s", "torque_nm", "fresh", "limited"]
    assert frame.index.name == "time_s" and len(frame) == len(record)
    assert frame.attrs["units"]["torque_nm"] == "N m"


@pytest.mark.heavy
def test_datasets_for_notebooks(record):
    pytest.importorskip("xarray")
    data = record.to_xarray()
    assert data.speed_rad_s.attrs["units"] == "rad/s"
    assert data.sizes == {"time_s": len(record)}


@pytest.mark.heavy
def test_a_library_that_is_missing_is_named(record, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(UsageError, match=r"pandas is not installed.*notebook"):
        record.to_pandas()


@pytest.mark.heavy
def test_the_example_runs(capsys):
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    assert "kg·m²" in capsys.readouterr().out
