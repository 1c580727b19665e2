"""Calibration file: written, read, refused by name, applied to a recording, and contained in the log."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from drivers import PreflightRefused
from profiles import MessageCode
from tdhil.errors import UsageError
from tdhil.session import (
    conclude,
    document_of_calibration,
    find_calibration,
    load_calibration,
    save_calibration,
    with_calibration,
)
from tdhil.session.stored_calibration import apply_calibration, refuse_another_drive
from tests.calibration.bodies import IDENTITY, INERTIA, SCALE, recording, two


@pytest.fixture(scope="module")
def document(tmp_path_factory):
    return document_of_calibration(find_calibration(two(tmp_path_factory.mktemp("logs")), "motor"))


pytestmark = pytest.mark.one_worker      # its fixture is expensive

RUN = {"identity": IDENTITY, "started": "2026-12-01T10:00:00+00:00"}


@pytest.mark.heavy
def test_a_run_with_a_calibration_is_in_calibrated_torque(document):
    plain = conclude(recording(0.0, 7), RUN, "run.mcap").identification
    found = conclude(recording(0.0, 7), {**RUN, "torque_calibration": document}, "run.mcap")
    inertia = found.identification.inertia
    assert plain.inertia.value == pytest.approx(SCALE * INERTIA, rel=0.01)
    assert inertia.low_total <= INERTIA <= inertia.high_total
    assert inertia.high_total - inertia.low_total < 0.6 * (plain.inertia.high_total - plain.inertia.low_total)
    assert found.identification.coulomb_nm.value == pytest.approx(60.0, rel=0.02)
    assert "torque scale, calibrated 2026-11-23" in [line.source for line in found.identification.budget]
    assert plain.calibration_advised and not found.identification.calibration_advised
    assert "tdhil calibrate torque" not in found.identification.advice
    assert found.document["torque_calibration"]["factor"] == document["calibration_factor"]["value"]
    assert conclude(recording(0.0, 7), RUN, "run.mcap").document["torque_calibration"] is None

    limited, setting = replace(recording(0.0, 7), torque_limit_nm=400.0), [
        {"name": "torque-limit", "value": 400.0, "tolerance": 0.1}]
    accepted = conclude(limited, {**RUN, "torque_calibration": document, "acceptance": setting}, "run.mcap").document
    assert accepted["torque_limit_nm"] == pytest.approx(400.0 * document["calibration_factor"]["value"])
    assert accepted["acceptance"]["verdict"] == "pass"


@pytest.mark.heavy
def test_the_file_is_read_again_and_never_written_over(document, tmp_path):
    path = tmp_path / "calibration.json"
    save_calibration(document, path)
    assert load_calibration(path) == json.loads(path.read_text())
    with pytest.raises(UsageError, match="already exists and was not overwritten"):
        save_calibration(document, path)


@pytest.mark.parametrize(("text", "words"), [
    ("no JSON", "is no JSON"), ("[1]", "no calibration of"), ("{}", "no calibration of"),
    ('{"kind": "torque_calibration", "calibration_factor": null}', "was refused"),
    ('{"kind": "torque_calibration", "calibration_factor": {"value": NaN, "low": 1, "high": 1, "confidence": 0.95}}',
     "no number"),
    ('{"kind": "torque_calibration", "calibration_factor": {"value": 1, "low": 2, "high": 3, "confidence": 0.95}}',
     "can't be"),
])
def test_an_invalid_calibration(tmp_path: Path, text, words):
    path = tmp_path / "calibration.json"
    path.write_text(text)
    with pytest.raises(UsageError, match=words):
        load_calibration(path)


def test_a_missing_file(tmp_path: Path):
    with pytest.raises(UsageError, match="no such file"):
        load_calibration(tmp_path / "calibration.json")


@pytest.mark.heavy
def test_another_drive_is_refused_before_motion_and_never_calibrated(document):
    other = {**IDENTITY, "serial": 23}
    with pytest.raises(PreflightRefused, match="serial is 17, and 23"):
        refuse_another_drive({"torque_calibration": document}, other)
    refuse_another_drive({"torque_calibration": document}, IDENTITY)
    concluded = conclude(recording(0.0, 7), {"identity": other, "torque_calibration": document}, "run.mcap")
    assert concluded.document["torque_calibration"] is None
    found = concluded.identification
    assert found.inertia.value == pytest.approx(SCALE * INERTIA, rel=0.01)
    assert any("not applied" in warning and "serial" in warning for warning in found.warnings)


MODBUS = {"vendor": 0, "product": 0, "revision": 0, "serial": 0, "name": "drive", "simulated": False}
FACTOR = {"value": 1.08, "low": 1.07, "high": 1.09, "confidence": 0.95}


def stored(drive=MODBUS, profile="danfoss/fc302", simulated=False):
    return {"kind": "torque_calibration", "calibration_factor": FACTOR, "date": "2026-11-23T10:00:00+00:00",
            "drive": drive, "settings": {"profile": profile}, "simulated": simulated}


def both(document, drive, profile, simulated):
    """Return the refusal before motion, '' without one, and the calibration that is applied after the run."""
    identity = {**drive, "simulated": simulated}
    run = {"identity": identity, "profile": {"name": profile}, "torque_calibration": document}
    refusal = ""
    try:
        refuse_another_drive(run, identity)
    except PreflightRefused as error:
        refusal = str(error)
    return refusal, apply_calibration(replace(recording(0.0, 7), simulated=simulated), run)


@pytest.mark.parametrize(("document", "drive", "profile", "simulated", "words"), [
    (stored(), MODBUS, "generic/modbus", True, "this drive is simulated"),
    (stored(), MODBUS, "danfoss/fc302", True, "this drive is simulated"),
    (stored(simulated=True), MODBUS, "danfoss/fc302", False, "on a simulated drive"),
    (stored(), MODBUS, "abb/acs880_modbus", False, "its profile is danfoss/fc302, and abb/acs880_modbus here"),
    (stored(IDENTITY, "generic/cia402"), {**IDENTITY, "product": 403}, "generic/cia402", False, "its product is 402"),
    (stored({**IDENTITY, "product": 0}, "own"), IDENTITY, "generic/cia402", False, "its profile is own"),
])
def test_the_calibration_of_another_drive_or_of_the_simulator_is_refused(document, drive, profile, simulated, words):
    """A drive on Modbus reports no identity: only its profile and the simulator's marker distinguish it."""
    refusal, applied = both(document, drive, profile, simulated)
    assert words in refusal
    assert applied.day == "" and words in applied.warnings[0]
    assert applied.warnings[0].entry is MessageCode.CALIBRATION_WARNING


@pytest.mark.parametrize(("document", "drive", "profile", "codes"), [
    (stored(), MODBUS, "danfoss/fc302", [MessageCode.CALIBRATION_UNCHECKED]),
    (stored({}), IDENTITY, "danfoss/fc302", [MessageCode.CALIBRATION_UNCHECKED]),
    (stored({**IDENTITY, "serial": 0}), IDENTITY, "danfoss/fc302", [MessageCode.CALIBRATION_UNCHECKED]),
    (stored(IDENTITY), IDENTITY, "danfoss/fc302", []),
    (stored(IDENTITY), IDENTITY, "./copy-of-it", [MessageCode.CALIBRATION_WARNING]),
    ({**stored(), "own_log": True}, MODBUS, "danfoss/fc302", []),
])
def test_a_drive_that_cannot_be_compared_gives_a_warning(document, drive, profile, codes):
    """The own copy of a profile has another name, and the same vendor and product number."""
    refusal, applied = both(document, drive, profile, simulated=False)
    assert refusal == "" and applied.day == "2026-11-23"
    assert [one.entry for one in applied.warnings] == codes


def test_a_result_repeats_the_warning_of_its_calibration():
    document = {**stored(IDENTITY), "warnings": ["the factor differs from 1 by 13 %", "assumed"],
                "warning_codes": ["TDH-064", "TDH-020"]}
    _, applied = both(document, IDENTITY, "danfoss/fc302", simulated=False)
    assert [one.entry for one in applied.warnings] == [MessageCode.FACTOR_UNLIKE_SCALE]
    assert "has a warning: the factor differs from 1 by 13 %" in applied.warnings[0]


@pytest.mark.heavy
def test_an_old_calibration_is_reported(document):
    old = {**RUN, "started": "2028-01-01T00:00:00+00:00", "torque_calibration": {**document, "valid_days": 100.0}}
    warnings = conclude(recording(0.0, 7), old, "run.mcap").identification.warnings
    assert any("valid for 100" in warning for warning in warnings)


@pytest.mark.heavy
def test_a_replay_accepts_the_calibration_of_its_drive_only(document):
    found = with_calibration(RUN, recording(0.0, 7), document, "calibration.json")
    assert found["torque_calibration"] == document
    with pytest.raises(UsageError, match="of another drive: its serial"):
        with_calibration({"identity": {**IDENTITY, "serial": 23}}, recording(0.0, 7), document, "calibration.json")
    with pytest.raises(UsageError, match="simulated"):
        with_calibration(RUN, replace(recording(0.0, 7), simulated=False), document, "calibration.json")


@pytest.mark.heavy
def test_a_log_that_was_calibrated_before_is_calibrated_from_the_drives_own_unit(document, tmp_path):
    runs = [replace(one, record=replace(one.record, configuration={**one.record.configuration,
                                                                   "torque_calibration": document}))
            for one in two(tmp_path)]
    assert find_calibration(runs, "motor").calibration.factor.value == document["calibration_factor"]["value"]


@pytest.mark.heavy
def test_a_log_of_the_calibration_is_as_uncertain_as_the_calibration(document):
    """Its noise is in the factor and in J with the same sign. A sum of squares would be too narrow."""
    own = with_calibration(RUN, recording(0.0, 1), document, "calibration.json", document["runs"][0]["sha256"])
    other = with_calibration(RUN, recording(0.0, 1), document, "calibration.json", "0" * 64)
    assert other["torque_calibration"] == document
    found, plain = (conclude(recording(0.0, 1), run, "run.mcap").identification.inertia for run in (own, other))
    of_calibration = document["inertia_kg_m2"]
    assert found.high_total - found.low_total >= of_calibration["high"] - of_calibration["low"]
    assert found.high_total - found.low_total > plain.high_total - plain.low_total
