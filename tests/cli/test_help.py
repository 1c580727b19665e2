"""Help in groups and in two lengths, a mistyped option, and the completion of a shell."""

import re
import subprocess
import sys

import pytest

from tdhil.buses import all_buses
from tdhil.cli.main import _COMMANDS, _GROUPS, build_parser, main
from tdhil.config import OPTIONS

COMMON = 20
"""Options that `identify --help` shows."""


def _help(capsys, *words):
    with pytest.raises(SystemExit) as ended:
        main(list(words))
    assert ended.value.code == 0
    return capsys.readouterr().out


def _flags(text):
    return set(re.findall(r"^  (?:-\w \S+, )?(--[a-z][a-z-]+)", text, re.MULTILINE))


def test_the_commands_are_in_groups_of_one_line_each(capsys):
    text = _help(capsys, "--help")
    assert all(len(line) <= 80 for line in text.splitlines())
    at = [text.index(f"\n{title}:\n") for title in _GROUPS]
    assert at == sorted(at)
    assert [re.findall(rf"^  {name} +\S", text, re.MULTILINE) for name in _COMMANDS if f"  {name} " not in text] == []


def test_identify_shows_the_options_that_most_runs_need(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    short, full = _help(capsys, "identify", "--help"), _help(capsys, "identify", "--help-all")
    shown = _flags(short) - {"--help", "--help-all"}
    of_buses = {flag for bus in all_buses() for flag in bus.common_flags}
    common = {one.flag for one in OPTIONS if one.common} | of_buses | {"--rig", "--dry-run", "--report"}
    assert shown == common and len(shown) == COMMON
    assert {one.flag for one in OPTIONS} | shown <= _flags(full)
    assert all(len(line) <= 80 for line in short.splitlines())


@pytest.mark.parametrize("command", sorted(_COMMANDS))
def test_each_command_has_help(command, capsys, monkeypatch):
    pytest.importorskip("starlette", reason="of the extra service")
    monkeypatch.setenv("COLUMNS", "80")
    assert _help(capsys, command, "--help").startswith(f"usage: tdhil {command}")


@pytest.mark.parametrize(("typed", "meant"), [
    ("identify --simulat", "--simulate"), ("identify --amplitud=3", "--amplitude"),
    ("replay --tolerence 1%", "--tolerance"),
    ("scan --chanel can0", "--channel"), ("profiles show generic/cia402 --jsn", "--json"),
])
def test_a_mistyped_option_is_corrected(typed, meant, capsys):
    assert main(typed.split()) == 2
    assert f"Did you mean '{meant}'? See tdhil " in capsys.readouterr().err


@pytest.mark.parametrize("typed", ["--xyzzy", "--quiet", "--verbose", "--torque", "--csv", "--duration"])
def test_an_option_unlike_any_other_gets_no_guess(typed, capsys):
    assert main(["identify", typed]) == 2
    assert capsys.readouterr().err == (
        f"tdhil: identify: there is no option {typed}. See tdhil identify --help [TDH-202]\n")


def test_hiding_an_option_does_not_change_it():
    parser = build_parser("identify")
    parser.format_help()
    assert parser.parse_args(["identify", "--periods", "5"]).periods == 5


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_a_shell_completes_commands_and_options(shell, capsys):
    pytest.importorskip("shtab", reason="shtab is not installed (pip install '.[completion]')")
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert all(name in script for name in _COMMANDS) and "--accept-unverified" in script
    if shell == "bash":
        assert subprocess.run(["bash", "-n"], input=script.encode(), check=False).returncode == 0


def test_without_shtab_it_names_the_package_to_install(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main(["completion", "bash"]) == 2
    assert "pip install 'shtab" in capsys.readouterr().err
