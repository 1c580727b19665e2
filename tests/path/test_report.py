"""`--report`: one page, equal from a run and from its replay, without an effect on either."""

from datetime import datetime
from hashlib import sha256

import pytest

from tests.path.path_runs import QUICK, identify, tdhil

pytestmark = pytest.mark.one_worker

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    done = identify(folder, "--simulate", *QUICK, "--seed", 4, "--periods", 4, "--report", folder / "live.html",
                    "--operator", "A. Person", "--note", "after the repair")
    assert done.code == 0, done.err
    return done


@pytest.mark.heavy
def test_a_run_has_cross_checks_and_a_friction_curve(run):
    opinions = run.document["second_opinions"]
    assert [opinion["route"] for opinion in opinions] == ["speed change"]
    assert opinions[0]["inertia_kg_m2"]["low"] < 104.0 < opinions[0]["inertia_kg_m2"]["high"]
    assert opinions[0]["agrees"] is True
    assert len(run.document["friction_curve"]) >= 3


@pytest.mark.heavy
def test_the_replay_gives_the_same_page_and_the_same_numbers_to_the_last_bit(run):
    page = run.log.parent / "replay.html"
    again = tdhil("replay", "--json", run.log, "--report", page)
    assert again.code == 0, again.err
    for part in ("inertia_kg_m2", "second_opinions", "friction_curve", "lines", "budget", "warnings"):
        assert again.document[part] == run.document[part]
    assert page.read_bytes() == (run.log.parent / "live.html").read_bytes()
    text = page.read_text(encoding="utf-8")
    assert sha256(run.log.read_bytes()).hexdigest() in text
    for wanted in ("SIMULATED", "A. Person", "after the repair"):
        assert wanted in text
    assert "speed change" in text


@pytest.mark.heavy
def test_json_has_time_drive_and_program(run):
    found = run.document
    assert datetime.fromisoformat(found["date"]).utcoffset() is not None
    assert (found["operator"], found["note"]) == ("A. Person", "after the repair")
    assert found["drive"]["serial"] == 1
    assert found["profile"]["name"] == "generic/cia402"
    assert found["rig"]["limits"]["torque_nm"] == 400.0
    again = tdhil("replay", "--json", "--operator", "B. Other", run.log).document
    assert again["operator"] == "B. Other"
    assert {name for name in again if again[name] != found[name]} == {"operator"}


@pytest.mark.heavy
def test_a_pdf_is_written_for_a_name_with_pdf(run):
    page = run.log.parent / "report.PDF"
    assert tdhil("replay", run.log, "--report", page).code == 0
    before = page.read_bytes()
    assert before.startswith(b"%PDF-")
    refused = tdhil("replay", run.log, "--report", page)
    assert refused.code == 2
    assert "already exists and was not overwritten" in refused.err
    assert page.read_bytes() == before


@pytest.mark.parametrize(("name", "said"), [("run.mcap", "the log itself"), ("no/r.html", "no such folder")])
def test_an_unwritable_place_of_a_report_is_refused_before_motion(tmp_path, name, said):
    done = identify(tmp_path, "--simulate", "--report", tmp_path / name)
    assert done.code == 2
    assert said in done.err
    assert not (tmp_path / "run.mcap").exists()


@pytest.mark.heavy
def test_a_report_never_overwrites_its_log(run):
    before = run.log.read_bytes()
    done = tdhil("replay", run.log, "--report", run.log)
    assert done.code == 2
    assert "the log itself" in done.err
    assert run.log.read_bytes() == before
