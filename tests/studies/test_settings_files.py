"""Settings from files and --set, and every refusal in one line (exit code 2)."""

import pytest

from profiles.errors import DataFileError
from profiles.model import DataModel
from tdhil.errors import ExitCode, UsageError, exit_code
from tdhil.studies.settings_files import load_study_file, with_assignments
from tests.studies.simulated_runs import STUDIES

GOOD = """\
study: table7
settings:
  kp_nm_s_rad: 3000
  duration_s: 4
  array: [[1, 1], [1, 2], [2, 1], [2, 2]]
  factors:
    - {name: J, levels: [450, 900]}
    - {name: viscous_nm_s_rad, levels: [10, 100]}
"""


@pytest.fixture
def load(tmp_path):
    def from_text(text):
        path = tmp_path / "my.yaml"
        path.write_text(text, encoding="utf-8")
        return load_study_file(path, STUDIES)

    return from_text


def test_a_file_changes_what_it_names_and_keeps_the_rest(load):
    study, settings = load(GOOD)
    assert study.name == "table7"
    assert settings.kp_nm_s_rad == 3000.0
    assert settings.ki_nm_rad == 1500.0
    assert [run.inertia_kg_m2 for run in settings.runs()] == [450, 450, 900, 900]
    study, settings = load("study: figure9\n")
    assert settings == STUDIES["figure9"].settings_model()


@pytest.mark.parametrize(("text", "line", "words"), [
    ("study: table9\n", 1, "no study 'table9'"),
    ("settings: {}\n", 1, "'study' is missing"),
    ("study: table7\nsetting: {}\n", 2, "unknown key 'setting'"),
    ("study: table7\nsettings:\n  kp: 3\n", 3, "unknown key 'kp'"),
    ("study: table7\nsettings:\n  kp_nm_s_rad: fast\n", 3, "must be a number"),
    ("study: table7\nsettings:\n  inertia_kg_m2: -1\n", 3, "greater than 0"),
    (GOOD.replace("[2, 2]]", "[2, 1]]"), 5, "not orthogonal"),
    (GOOD.replace("name: J", "name: Q"), 6, "no factor 'Q'"),
    (GOOD.replace("[450, 900]", "[450, 900, 1800]"), 6, "needs 2 different levels"),
    (GOOD.replace("array: [[1, 1], [1, 2], [2, 1], [2, 2]]", "array: L7"), 5, "no array 'L7'"),
    ("study: table7\nsettings:\n  sample_period_s: 0.1\n", 1, "sample_period_s"),
    ("study: [\n", 2, ""),
    ("", 0, "empty"),
])
def test_a_bad_file_is_refused_with_its_line(load, text, line, words):
    with pytest.raises(DataFileError) as caught:
        load(text)
    assert words in str(caught.value)
    assert exit_code(caught.value) == ExitCode.USAGE
    if words != "sample_period_s":
        assert caught.value.problems[0].line == line
        assert len(caught.value.problems) == 1


def test_no_such_file(tmp_path):
    with pytest.raises(DataFileError, match="no such file"):
        load_study_file(tmp_path / "none.yaml", STUDIES)


def test_set_takes_fields_symbols_and_yaml_values():
    assignments = ["Kp=3000", "ki_nm_rad = 1e3", "values=[450, 900]"]
    settings = with_assignments(STUDIES["figure9"].settings_model(), assignments)
    assert (settings.kp_nm_s_rad, settings.ki_nm_rad, settings.values) == (3000.0, 1000.0, (450.0, 900.0))
    assert settings.frequency_hz == 1.0


def test_set_finds_a_field_by_its_symbol_in_any_case_and_inside_a_section():
    class Rig(DataModel):
        inertia_kg_m2: float = 104.0

    class Bench(DataModel):
        kp: float = 300.0
        rig: Rig = Rig()

    settings = with_assignments(Bench(), ["Kp=500", "rig.inertia_kg_m2=90"])
    assert (settings.kp, settings.rig.inertia_kg_m2) == (500.0, 90.0)


def test_set_takes_precedence_over_a_file(load):
    _, settings = load(GOOD)
    changed = with_assignments(settings, ["Kp=4000"])
    assert changed.kp_nm_s_rad == 4000.0
    assert changed.rows == settings.rows
    assert changed.duration_s == 4.0


@pytest.mark.parametrize(("study", "assignment", "words"), [
    ("table7", "Kp", "must be name=value"),
    ("table7", "=3", "must be name=value"),
    ("table7", "Kp=", "must be name=value"),
    ("table7", "colour=3", "unknown key 'colour'"),
    ("table7", "Kp=fast", "must be a number"),
    ("table7", "Kp=.nan", "finite"),
    ("table7", "Kp=[1, 2", "--set Kp=[1, 2"),
    ("table7", "J=-5", "greater than 0"),
    ("table7", "B=5", "varies from run to run"),
    ("table6", "Kp=3000", "varies from run to run"),
    ("figure12", "Kp=3000", "varies from run to run"),
    ("table7", "array=[[1, 1], [2, 2]]", "not orthogonal"),
    ("table7", "Ts=0.1", "Ts²/J"),
    ("figure9", "T=1", "one whole period"),
    ("figure9", "values=[1]", "at least 2"),
    ("figure9", "values=[0.001, 900]", "one run can't be simulated"),
    ("figure11", "T=1", "two periods"),
    ("table7", "rig.B=3", "no section 'rig'"),
    ("table7", "duration_s=1e9", "samples"),
])
def test_a_bad_assignment_is_one_line_and_exit_2(study, assignment, words):
    with pytest.raises(UsageError) as caught:
        with_assignments(STUDIES[study].settings_model(), [assignment])
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert exit_code(caught.value) == ExitCode.USAGE
