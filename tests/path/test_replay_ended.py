"""Replays of aborted runs: only data before the abort count, and the result states the cause of the abort."""

import shutil

import pytest

from tests.path.path_runs import QUICK, identify, tdhil

pytestmark = pytest.mark.one_worker      # its run is made once

CANOPEN = ("--simulate", *QUICK, "--seed", 7)
MODBUS = ("--drive", "modbus", "--simulate", "--seed", 7)


@pytest.fixture(scope="module")
def sto(tmp_path_factory):
    return identify(tmp_path_factory.mktemp("sto"), *CANOPEN, "--periods", 5, "--fault", "sto@acquire+97s")


@pytest.mark.heavy
def test_an_aborted_run_is_a_partial_result(sto):
    assert sto.code == 6
    again = tdhil("replay", "--json", sto.log)
    assert again.code == 3
    inertia = again.document["inertia_kg_m2"]
    assert inertia["low"] < 104.0 < inertia["high"]
    assert "aborted in stage acquire (statusword " in again.document["warnings"][0]
    assert again.document["ended"]["exit_code"] == 6
    assert again.document["ended"]["kind"] == "DriveFault"


@pytest.mark.heavy
def test_its_recovered_copy_is_a_partial_result(sto, tmp_path):
    cut, whole = tmp_path / "cut.mcap", tmp_path / "whole.mcap"
    shutil.copy(sto.log, cut)
    with cut.open("r+b") as file:
        file.truncate(cut.stat().st_size - 200)
    assert tdhil("recover", cut, "-o", whole).code == 3
    again = tdhil("replay", "--json", whole)
    assert again.code == 3
    assert "aborted in stage acquire" in again.document["warnings"][0]


@pytest.mark.parametrize(("arguments", "code", "said"), [
    ((*CANOPEN, "--fault", "sdo-timeout"), 5, "does not answer"),
    ((*CANOPEN, "--fault", "watchdog-not-armed"), 4, "1016h"),
    ((*MODBUS, "--fault", "fault-at-start"), 4, ""),
])
def test_a_refused_run_says_its_refusal(tmp_path, arguments, code, said):
    run = identify(tmp_path, *arguments)
    assert run.code == code
    again = tdhil("replay", run.log)
    assert again.code == code
    assert "ended in stage setup, with nothing to identify from" in again.err
    assert said in again.err
    assert run.document["error"]["message"].split(". ")[-1] in again.err      # the next step
    assert "whole periods" not in again.err + again.out
