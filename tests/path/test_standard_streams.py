"""stdout and stderr that are closed, full or ASCII only: the run ends normally, and its result is not lost."""

from __future__ import annotations

import errno
import io
import os
import subprocess
import sys

import pytest

from tdhil.cli.main import main
from tdhil.errors import UsageError
from tdhil.estimation import identify
from tdhil.recording.log_reader import read_run
from tdhil.session.conclusion import conclude
from tests.path.path_runs import QUICK, clean_environment

pytestmark = pytest.mark.one_worker      # its run is made once

FULL = "/dev/full"


@pytest.fixture(scope="module")
def ended(tmp_path_factory):
    """Return (exit code, stderr, log) of a whole run with a full stdout. A replay prints the same end."""
    log, err = tmp_path_factory.mktemp("streams") / "run.mcap", io.StringIO()
    with (
        pytest.MonkeyPatch.context() as patch,
        open(FULL, "w", encoding="utf-8") as stdout,  # noqa: PTH123
    ):
        patch.setattr(sys, "stdout", stdout)
        patch.setattr(sys, "stderr", err)
        code = main(["identify", "--simulate", *map(str, QUICK), "--seed", "4", "--periods", "3", "--log", str(log)])
    return code, err.getvalue(), log


@pytest.fixture(scope="module")
def once():
    """Identify once for all tests: all replays here are of one log and differ in their output streams."""
    kept = {}

    def identified(recording, options):
        if options not in kept:
            kept[options] = identify(recording, options)
        return kept[options]

    return identified


@pytest.fixture
def log(ended, once, monkeypatch):
    monkeypatch.setattr("tdhil.estimation.identification.identify", once)
    return ended[2]


def run(monkeypatch, stdout, *arguments, stderr=None):
    err = stderr or io.StringIO()
    monkeypatch.setattr(sys, "stdout", stdout)
    monkeypatch.setattr(sys, "stderr", err)
    code = main([str(argument) for argument in arguments])
    return code, "" if stderr is not None else err.getvalue()


@pytest.mark.long(but_first=3)
@pytest.mark.heavy
@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252", "koi8-r"])
@pytest.mark.parametrize("arguments", [(), ("--json",)])
def test_an_encoding_that_lacks_our_signs(log, monkeypatch, encoding, arguments):
    raw = io.BytesIO()
    code, err = run(monkeypatch, io.TextIOWrapper(raw, encoding=encoding, errors="strict"), "replay", *arguments, log)
    sys.stdout.flush()
    text = raw.getvalue().decode(encoding)
    assert code == 0, err
    assert "Traceback" not in err
    assert ("kg" in text) if not arguments else (text.count("{") == text.count("}") > 5)
    if encoding == "ascii" and not arguments:
        assert "kg.m2" in text and "+-" in text
        assert {len(line) for line in text.splitlines()} == {80}      # the right edge of the frame stays a line


@pytest.mark.heavy
def test_a_full_device(log, monkeypatch):
    with open(FULL, "w", encoding="utf-8") as stdout:  # noqa: PTH123
        code, err = run(monkeypatch, stdout, "replay", log)
    assert code == 3
    assert "stdout: can't be written: No space left on device" in err
    assert "kg·m²" in err                  # the card
    assert "Traceback" not in err


@pytest.mark.heavy
def test_a_replay_into_a_closed_pipe_prints_nothing_else(log):
    """The reader closes early, as with ``tdhil replay run.mcap | head -n 1``."""
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run([sys.executable, "-m", "tdhil", "replay", str(log)], stdout=writing, stderr=subprocess.PIPE,
                          timeout=600, env=clean_environment())
    os.close(writing)
    assert done.stderr == b""


@pytest.mark.heavy
def test_a_full_device_at_the_end_of_a_run(ended):
    code, err, log = ended
    assert code == 3, err
    assert "stdout: can't be written: No space left on device" in err
    assert "Traceback" not in err
    assert "kg·m²" in err
    kept = read_run(log)
    assert kept.complete
    assert kept.result is not None
    assert kept.result["inertia_kg_m2"]["value"] > 0


def test_any_command_into_a_full_device(monkeypatch):
    with open(FULL, "w", encoding="utf-8") as stdout:  # noqa: PTH123
        code, err = run(monkeypatch, stdout, "profiles")
    assert code == 3
    assert "stdout: can't be written" in err
    assert "Traceback" not in err


@pytest.mark.heavy
def test_no_stdout_at_all(log, monkeypatch):
    code, err = run(monkeypatch, None, "replay", log)
    assert code == 0
    assert "kg·m²" in err


@pytest.mark.heavy
def test_neither_stdout_nor_stderr(log, monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    assert main(["replay", str(log)]) == 0


@pytest.mark.parametrize("buffering", [1, -1])
def test_a_dead_stderr_hides_no_cause(monkeypatch, tmp_path, buffering):
    with open(FULL, "w", encoding="utf-8", buffering=buffering) as stderr:  # noqa: PTH123
        assert run(monkeypatch, io.StringIO(), "replay", tmp_path / "none.mcap", stderr=stderr)[0] == 2


@pytest.mark.heavy
def test_closed_descriptors_are_not_reused_by_files():
    script = "import os, sys; os.close(1); os.close(0)\n" \
             "from tdhil.cli.main import main; main(['profiles', 'show', 'nothing'])\n" \
             "sys.exit(0 if min(os.open('/dev/null', 0), 9) > 2 else 1)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, timeout=600, env=clean_environment())
    assert done.returncode == 0, done.stderr


def test_ctrl_c_while_a_command_is_being_loaded(monkeypatch, capsys):
    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr("tdhil.cli.main._builder", interrupted)
    assert main(["identify"]) == 130
    assert capsys.readouterr().err == "tdhil: interrupted [TDH-1300]\n"


@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENOSPC, errno.EIO, errno.ENOMEM])
def test_a_refusal_of_the_system_gives_one_line(monkeypatch, capsys, number):
    def refused(_):
        raise OSError(number, "the system's word")

    monkeypatch.setattr("tdhil.cli.main._builder", refused)
    assert main(["identify"]) == 1
    said = "tdhil: The operating system refused a request: the system's word [TDH-102]\n"
    assert capsys.readouterr().err == said


def test_an_unknown_model_in_a_log():
    with pytest.raises(UsageError, match=r"run\.mcap: model must be .*'magic'.*--model"):
        conclude(None, {"identify": {"model": "magic"}}, "run.mcap")      # type: ignore[arg-type]


@pytest.mark.heavy
@pytest.mark.parametrize("fault", [(), ("--fault", "sto@hold+1s")])
def test_nothing_is_loaded_once_the_shaft_may_move(tmp_path, fault):
    """Later there may be no free descriptor or no disk for an import."""
    script = f"""
import sys
from tdhil.session import confirm
before = set()
whole = confirm.confirm_motion
def noted(*args, **named):
    whole(*args, **named)
    before.update(sys.modules)
confirm.confirm_motion = noted
from tdhil.cli.main import main
main({["identify", "--simulate", *map(str, QUICK), "--seed", "4", "--periods", "3", *fault]!r})
assert before
slow = {{"scipy.stats", "scipy.signal"}}     # a second each; no run needs them
print(sorted(set(sys.modules) - before | slow & before), file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=600, cwd=tmp_path,
                          env=clean_environment())
    assert done.stderr.splitlines()[-1] == "[]"


def test_ctrl_c_while_the_command_line_is_imported(monkeypatch, capsys):
    from tdhil.__main__ import console

    class Interrupts:
        def find_spec(self, name, *_):
            if name == "tdhil.cli.main":
                raise KeyboardInterrupt

    monkeypatch.delitem(sys.modules, "tdhil.cli.main")
    monkeypatch.setattr(sys, "meta_path", [Interrupts(), *sys.meta_path])
    with pytest.raises(SystemExit) as ended:
        console()
    assert ended.value.code == 130
    assert capsys.readouterr().err == "tdhil: interrupted\n"
