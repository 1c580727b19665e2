"""Confirmations and overrides of the operator: only on the command line of the run, never in a file."""

from __future__ import annotations

import pytest

from drivers.errors import DataFileError, PreflightRefused
from tdhil.cli.main import main
from tdhil.config.options import RESOLVED
from tdhil.config.resolution import resolve
from tdhil.session.confirm import confirm_motion
from tests.rigs import limits_text, loaded_rig, rig_file


@pytest.mark.parametrize("value", ["true", "false"])
def test_a_file_does_not_confirm(tmp_path, capsys, monkeypatch, value):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CI", "true")
    path = rig_file(tmp_path, limits_text(watchdog_s=None), f"run:\n  seed: 3\n  yes: {value}\n")
    assert main(["identify", "--rig", str(path), "-i", "socketcan", "-c", "can0"]) == 2
    said = capsys.readouterr().err
    assert "rig.yaml:11:" in said
    assert "belongs to one run, never to a file" in said
    assert "--yes" in said
    assert not list(tmp_path.glob("*.mcap"))


@pytest.mark.parametrize("section", ["", "run:\n  "])
@pytest.mark.parametrize("key", [
    "yes", "accept_no_watchdog", "accept_shared_watchdog", "accept_wider_limit", "accept_speed_unit",
    "reset_fault",
])
def test_nothing_that_the_operator_answers_for_stands_in_a_file(tmp_path, section, key):
    with pytest.raises(DataFileError) as caught:
        loaded_rig(tmp_path, f"node: 3\n{section}{key}: true\n")
    (problem,) = caught.value.problems
    assert problem.line == (3 if section else 2)
    assert f"--{key.replace('_', '-')}" in problem.message


def test_no_option_takes_the_confirmation_from_a_rig():
    assert {option.name for option in RESOLVED if not option.at} == {"yes"}
    assert resolve({"yes": True}, None).yes is True
    assert resolve({}, None).yes is False


def test_an_override_in_a_file_is_for_the_profile_of_that_file(tmp_path):
    bench = loaded_rig(tmp_path, "profile: danfoss/fc302\naccept_unverified: [likely]\n")
    assert resolve({}, bench).accept_unverified == ("likely",)
    assert resolve({"profile": "danfoss/fc302"}, bench).accept_unverified == ("likely",)
    other = resolve({"profile": "abb/acs880-enhanced"}, bench)
    assert other.accept_unverified == ()
    assert other.source("accept_unverified") == "rig.yaml:2 is for the profile of that file, not for --profile"
    both = resolve({"profile": "abb/acs880-enhanced", "accept_unverified": ["watchdog"]}, bench)
    assert (both.accept_unverified, both.source("accept_unverified")) == (("watchdog",), "--accept-unverified")


def test_without_standard_input_there_is_no_operator_at_the_prompt(monkeypatch):
    from types import SimpleNamespace

    from rich.console import Console

    from drivers.drive import Identity
    from tdhil.runner.settings import ExcitationRequest, MachineLimits

    monkeypatch.setattr("sys.stdin", None)
    monkeypatch.setattr("tdhil.session.confirm.motion_summary", lambda *_: "")
    task = SimpleNamespace(limits=MachineLimits, request=ExcitationRequest, case=None)
    preflight = SimpleNamespace(identity=Identity(1, 2, 3, 4, "drive", False))
    with pytest.raises(PreflightRefused, match="no operator can confirm"):
        confirm_motion(
            task, preflight, lambda: None, yes=False, console=Console(quiet=True), pause_display=lambda: None
        )
