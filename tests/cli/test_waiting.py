"""Sign of activity of a command that identifies again for seconds: at a terminal only."""

import io

import pytest
from rich.console import Console

from tdhil.cli.main import main
from tdhil.report import working
from tests.evidence.small_runs import write_run

COMMANDS = [
    ("replay {log}", "identifying …"),
    ("frf {log}", "reading the record …"),
    ("frf {log}", "identifying …"),
    ("compare {log} {log}", "identifying …"),
    ("calibrate torque {log} --plan", "identifying …"),
    ("calibrate torque {log} {other} --added 5", "fitting the runs together …"),
    ("tune speed {log}", "reading the result …"),
    ("severity {log} --result {log}", "reading the result …"),
    ("evidence {log} --publisher A --publish all --simulated", "making the archive …"),
    ("evidence --check {log}", "checking the archive …"),
]


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    return {"log": write_run(folder / "a.mcap"), "other": write_run(folder / "b.mcap")}


@pytest.mark.parametrize(("command", "sign"), COMMANDS)
def test_at_a_terminal_there_is_a_moving_sign_during_identification(logs, command, sign, monkeypatch, capsys):
    out = io.StringIO()
    monkeypatch.setattr("tdhil.report.console.stderr_console",
                        lambda: Console(file=out, force_terminal=True, width=80))
    main([word.format(**logs) for word in command.split()])
    assert sign in out.getvalue() and out.getvalue().count("\x1b[?25l") == out.getvalue().count("\x1b[?25h")


def test_the_path_of_the_report_is_printed(logs, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    main(["replay", str(logs["log"]), "--json", "--report", str(tmp_path / "r.html")])
    assert capsys.readouterr().err.endswith(f"report: {tmp_path / 'r.html'}\n") and (tmp_path / "r.html").exists()


def test_elsewhere_nothing_is_printed():
    out = io.StringIO()
    with working("identifying …", Console(file=out, force_terminal=False)):
        pass
    assert out.getvalue() == ""
