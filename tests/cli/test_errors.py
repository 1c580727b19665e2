"""Exit codes of errors, as in the manual."""

import json
import signal
from pathlib import Path

import pytest

from drivers.errors import (
    CommandRejected,
    CommunicationLost,
    DataFileError,
    DriveFault,
    LimitHit,
    ModeNotConfirmed,
    PreflightRefused,
    Problem,
    StopNotConfirmed,
    TdhilError,
)
from tdhil.cli.main import _INSTEAD, build_full_parser, main
from tdhil.errors import ExitCode, Interrupted, UsageError, exit_code


def one_document(capsys):
    """Return the document on stdout: there is one, and nothing else."""
    return json.loads(capsys.readouterr().out)


SPEED = ["calibrate", "speed", "--turns", "100", "--seconds", "312.4", "--speed", "2.0", "--json"]


def test_a_missing_folder_is_reported_before_the_result(tmp_path, capsys):
    assert main([*SPEED, "--save", str(tmp_path / "none" / "c.json")]) == 2
    assert "its folder does not exist" in one_document(capsys)["error"]["message"]


def test_stdout_has_one_document_also_if_a_later_step_fails(tmp_path, capsys, monkeypatch):
    def full(*_):
        raise UsageError("can't be written (No space left on device)")

    monkeypatch.setattr("tdhil.session.add_speed_calibration", full)
    assert main([*SPEED, "--save", str(tmp_path / "c.json")]) == 2
    out, err = capsys.readouterr()
    assert json.loads(out)["calibration_factor"] is not None and "No space left" in err


def test_a_json_file_that_is_nested_too_deeply_is_an_error_of_use(tmp_path, capsys):
    path = tmp_path / "r.json"
    path.write_text("[" * 200_000)
    for words in (["tune", "speed", str(path)], ["tune", "soft-torque", str(path)]):
        assert main([*words, "--json"]) == 2
        assert one_document(capsys)["exit_code"] == 2


def test_the_list_of_faults_is_a_document_too(capsys):
    assert main(["identify", "--fault", "list", "--json"]) == 0
    assert set(one_document(capsys)["buses"]) >= {"canopen", "modbus"}


@pytest.mark.parametrize("every", ["-1", "0", "0.01"])
def test_a_folder_is_not_polled_without_a_pause(tmp_path, capsys, every):
    assert main(["watch", str(tmp_path), "--every", every]) == 2
    assert "too short an interval" in capsys.readouterr().err


def test_a_rig_gets_no_name_that_is_refused_later(tmp_path, capsys):
    path = tmp_path / "rig.yaml"
    assert main(["rig", "new", str(path), "--profile", "generic/cia402", "--load", "none", "--name", "x" * 300]) == 2
    assert "too many" in capsys.readouterr().err and not path.exists()


class LogErrorLike(TdhilError):
    exit_code = 10


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (RuntimeError("x"), 1),
        (TdhilError("x"), 1),
        (CommandRejected("x"), 1),
        (UsageError("x"), 2),
        (DataFileError((Problem("f", 1, "x"),)), 2),
        (PreflightRefused("x"), 4),
        (CommunicationLost("x"), 5),
        (DriveFault("x"), 6),
        (ModeNotConfirmed("x"), 6),
        (LimitHit("x"), 7),
        (StopNotConfirmed("x"), 8),
        (LogErrorLike("x"), 10),
        (Interrupted(signal.SIGINT), 130),
        (KeyboardInterrupt(), 130),
        (Interrupted(signal.SIGTERM), 143),
        (Interrupted(signal.SIGHUP), 143),
    ],
)
def test_exit_codes(error: BaseException, code: int) -> None:
    assert exit_code(error) == code


def test_the_table_of_exit_codes() -> None:
    assert sorted(ExitCode) == [*range(13), 130, 143]


def test_an_attribute_of_an_instance_goes_first() -> None:
    error = TdhilError("x")
    error.exit_code = 3  # type: ignore[attr-defined]
    assert exit_code(error) is ExitCode.PARTIAL
    error.exit_code = 99  # type: ignore[attr-defined]
    assert exit_code(error) is ExitCode.INTERNAL


WITH_JSON = ("identify", "replay", "fleet", "watch", "trend", "compare", "tune", "evaluate", "recover", "study",
             "doctor", "profiles", "profiles show", "scan", "stop")


@pytest.mark.parametrize("command", WITH_JSON)
@pytest.mark.parametrize("wrong", ["--no-such-option", "--json=yes"])
def test_a_usage_error_is_a_document_if_json_is_requested(
    command: str, wrong: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command.split(), "--json", wrong]) == 2
    shown = capsys.readouterr()
    document = json.loads(shown.out)
    assert (document["exit_code"], document["error"]["kind"]) == (2, "UsageError")
    error = document["error"]
    assert error["code"].startswith("TDH-2")
    assert shown.err == f"tdhil: {error['message']} [{error['code']}]\n"


@pytest.mark.parametrize(("typed", "advice"), [
    ("flet", "Did you mean 'fleet'? See tdhil --help"), ("xyzzy", "See tdhil --help"),
    ("report", "Use tdhil replay run.mcap --report report.html"), ("help", "Use tdhil --help"),
])
def test_an_unknown_command_is_reported_with_a_suggestion(
    typed: str, advice: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([typed, "logs"]) == 2
    assert capsys.readouterr().err == f"tdhil: there is no command '{typed}'. {advice} [TDH-201]\n"


@pytest.mark.parametrize("call", sorted({one for one in _INSTEAD.values() if not one.startswith("tdhil --")}))
def test_the_call_named_for_another_tool_s_command_is_one_of_ours(call: str) -> None:
    build_full_parser().parse_args(call.split()[1:])


@pytest.mark.parametrize(("typed", "said"), [
    ("loop", "tdhil: tune: there is no action loop. Did you mean 'speed'? See tdhil tune --help [TDH-200]\n"),
    ("sped", "tdhil: tune: there is no action sped. Did you mean 'speed'? See tdhil tune --help [TDH-200]\n"),
    ("result.jsn", "tdhil: result.jsn: this file does not exist."),
    ("verfy", "tdhil: verfy: this file does not exist."),         # this names an existing file
])
def test_a_misspelt_action_is_no_file(
    typed: str, said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if typed == "verfy":
        (tmp_path / typed).mkdir()
    assert main(["tune", typed, *(["r.json"] if typed == "sped" else [])]) == 2
    assert capsys.readouterr().err.startswith(said)


@pytest.mark.parametrize(("words", "said"), [
    (("export", "first.mcap"), "export: the following arguments are required: --to candump|asc|csv|parquet. See"),
    (("rig", "new"), "rig new: the following arguments are required: --load none|string. See tdhil rig new --help"),
])
def test_a_missing_option_is_stated_with_its_values(
    words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(list(words)) == 2
    assert said in capsys.readouterr().err


def test_after_a_question_there_is_no_full_stop() -> None:
    assert str(UsageError("did you mean 'time'?", where="--columns", next_step="Such as: time=t_s")) == (
        "--columns: did you mean 'time'? Such as: time=t_s")


def test_without_json_a_wrong_value_is_a_line_on_stderr_alone(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["identify", "--excitation", "noise"]) == 2
    shown = capsys.readouterr()
    assert shown.out == "" and shown.err.startswith("tdhil: identify: argument --excitation: invalid choice")


def test_ctrl_c_is_named() -> None:
    assert "Ctrl-C" in str(Interrupted(signal.SIGINT))
    assert "SIGTERM" in str(Interrupted(signal.SIGTERM))


@pytest.mark.parametrize(("stopped", "said"), [
    (None, "tdhil stops the shaft. Lower it"), (True, "The shaft was stopped. Lower it"),
    (False, "Standstill was not confirmed. Lower it"),
])
def test_an_error_that_ends_a_motion_states_a_stop_only_if_it_was_confirmed(stopped: bool | None, said: str) -> None:
    error = LimitHit("too fast", next_step="Lower it", stops=True)
    error.stopped = stopped
    assert (str(error), error.next_step) == (f"too fast. {said}", said)
