"""Gains that the drive reports, on the whole path: preflight, log, document, replay, `tdhil tune speed`."""

from __future__ import annotations

import json

import pytest

from tests.path.path_runs import QUICK, identify, tdhil
from tests.rigs import plant_file

pytestmark = pytest.mark.heavy
PLANT = "drive: {speed_gain_nm_s_rad: 250.0, speed_integral_gain_nm_rad: 125.0}\n"


@pytest.mark.parametrize(("words", "where"), [
    (QUICK, ["5FFDh:1", "5FFDh:2", "5FFDh:3"]),
    (("--drive", "ethercat", *QUICK), ["5FFDh:1", "5FFDh:2", "5FFDh:3"]),
    (("--drive", "modbus", *QUICK), ["register 64", "register 66", "register 68"]),
])
def test_they_are_shown_without_input(tmp_path, words, where):
    run = identify(tmp_path, "--simulate", *words, "--plant", plant_file(tmp_path, PLANT), "--seed", 3, "--periods", 3)
    assert run.code == 0, run.err
    present = run.document["speed_loop_present"]
    assert (present["gain_nm_s_rad"], present["integral_nm_rad"]) == (pytest.approx(250.0), pytest.approx(125.0))
    assert present["filter_s"] == pytest.approx(0.02)
    assert [one["where"] for one in present["settings"].values()] == where
    again = tdhil("replay", "--json", run.log)
    assert again.document == run.document

    result = tmp_path / "result.json"
    result.write_text(run.out, encoding="utf-8")
    for source in (result, run.log):
        tuned = tdhil("tune", "speed", source, "--json")
        assert tuned.code == 0, tuned.err
        first = json.loads(tuned.out)["controllers"][0]
        assert first["kind"] == "present"
        assert (first["gain_nm_s_rad"], first["integral_nm_rad"]) == (pytest.approx(250.0), pytest.approx(125.0))
        assert tuned.document["tuned_for"]["present_from"] == f"reported by the drive ({where[0]}, {where[1]})"
