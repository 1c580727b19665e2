"""`tdhil study`: lists, files, output and refusals, mostly with two small studies made for the tests."""

import contextlib
import csv
import io
import json
import struct
import sys

import pytest
from pydantic import Field

from profiles.model import DataModel
from tdhil.cli import study as command
from tdhil.cli.main import main
from tdhil.errors import UsageError
from tdhil.studies.study import ResultTable, Statement, StudyOutcome

PNG = b"\x89PNG\r\n\x1a\n"


class Settings(DataModel):
    kp_nm_s_rad: float = Field(default=300.0, gt=0)
    tones_hz: tuple[float, ...] = (0.1, 1.0)
    seed: int = 1


class NoSeed(DataModel):
    kp_nm_s_rad: float = 300.0


class Made:
    """Study with known numbers."""

    def __init__(self, name="table1", settings_model=Settings, error=None):
        self.name, self.title, self.settings_model, self.error = name, f"A small study, {name}", settings_model, error

    def run(self, settings, progress):
        progress(0.5, "half of it")
        if self.error is not None:
            raise self.error
        rows = ((1, settings.kp_nm_s_rad / 3.0, "sine", None), (2, float("nan"), "step", 0.25))
        return StudyOutcome(
            self.name, self.title, (ResultTable("numbers", ("run", "inertia_kg_m2", "signal", "published"), rows),),
            (Statement("it holds", "yes", "yes & <no>", True), Statement("it does not", "yes", "no", False),
             Statement("who knows", "1 and 2", "both", None)),
            document={"runs": [{"inertia_kg_m2": settings.kp_nm_s_rad / 3.0}], "seed": getattr(settings, "seed", None)},
            simulated_s=10.0, draw=lambda figure: figure.add_subplot().plot([0.0, 1.0], [1.0, 2.0]),
        )


@pytest.fixture
def studies(monkeypatch):
    """Replace the real studies by two small ones."""
    known = {study.name: study for study in (Made(), Made("figure2", NoSeed))}
    monkeypatch.setattr(command, "all_studies", lambda: known)
    return known


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def tdhil(*arguments):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(["study", *map(str, arguments)])
        except SystemExit as end:
            code = end.code
    return code, out.getvalue(), err.getvalue()


# -- list and names ----------------------------------------------------------------------------------------------


def test_the_real_list():
    code, out, _ = tdhil("list")
    assert code == 0
    names = [line.split()[0] for line in out.splitlines() if line[:1].strip()]
    assert {"table6", "table7", "figure19", "figure20", "figure21", "figure22", "figure23"} <= set(names)
    numbers = [int(name.removeprefix("figure")) for name in names if name.startswith("figure")]
    assert numbers == sorted(numbers)
    assert names[0].startswith("table")
    assert max(map(len, out.splitlines())) <= 80


def test_list_as_json(studies):
    code, out, _ = tdhil("list", "--json")
    assert code == 0
    assert json.loads(out) == {
        "studies": [{"name": study.name, "title": study.title} for study in studies.values()]}


@pytest.mark.parametrize(("arguments", "said"), [
    (("tabel1",), "Did you mean 'table1'?"),
    (("figure99999",), "tdhil study list lists them"),
    ((), "no study is named"),
    (("list", "table1"), "'list' must be the only name"),
    (("paper", "table1"), "'paper' must be the only name"),
])
def test_an_unknown_name_ends_with_one_line_and_exit_2(studies, arguments, said):
    code, out, err = tdhil(*arguments)
    assert (code, out) == (2, "")
    assert said in err
    assert len(err.splitlines()) == 1


# -- written files -----------------------------------------------------------------------------------------------


def test_csv_settings_and_pictures_are_written(studies, tmp_path):
    pytest.importorskip("matplotlib")
    code, out, _ = tdhil("table1", "--out", tmp_path / "there")
    assert code == 0
    folder = tmp_path / "there" / "table1"
    assert {path.name for path in folder.iterdir()} == {"numbers.csv", "study.yaml", "table1.png", "table1.svg"}
    rows = list(csv.DictReader((folder / "numbers.csv").open()))
    assert float(rows[0]["inertia_kg_m2"]) == 100.0
    assert rows[0]["published"] == ""
    picture = (folder / "table1.png").read_bytes()
    assert picture.startswith(PNG)
    width, height = struct.unpack(">II", picture[16:24])
    assert width > 600
    assert height > 300
    assert "<svg" in (folder / "table1.svg").read_text()
    assert str(folder) in out.replace("\n", "")


def test_a_second_run_gives_the_same_files(studies, tmp_path):
    for folder in ("a", "b"):
        assert tdhil("table1", "--out", tmp_path / folder)[0] == 0
    for path in (tmp_path / "a" / "table1").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / "table1" / path.name).read_bytes(), path.name


def test_the_default_folder(studies, tmp_path):
    assert tdhil("table1")[0] == 0
    assert (tmp_path / "study" / "table1" / "numbers.csv").is_file()


def test_without_matplotlib_all_files_except_pictures_are_written(studies, tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    code, out, err = tdhil("table1", "figure2")
    assert code == 0
    assert {path.name for path in (tmp_path / "study" / "table1").iterdir()} == {"numbers.csv", "study.yaml"}
    assert err.count("[report]") == 1
    assert "it holds" in out


def test_the_output_fits_80_columns_and_names_each_statement(studies):
    code, out, err = tdhil("table1")
    assert code == 0
    assert max(len(line) for line in out.splitlines() if not line.startswith("files:")) <= 80
    for text in ("SIMULATED", "✓ it holds  [holds]", "✗ it does not  [does not hold]", "~ who knows  [open]", "100"):
        assert text in out
    assert "10 simulated seconds" in err


# -- json --------------------------------------------------------------------------------------------------------


def test_json_is_one_document_only(studies):
    code, out, err = tdhil("table1", "--json")
    assert code == 0
    document = json.loads(out)
    assert document["study"] == "table1"
    assert document["simulated"] is True
    assert document["runs"] == [{"inertia_kg_m2": 100.0}]
    assert document["settings"] == {"kp_nm_s_rad": 300.0, "tones_hz": [0.1, 1.0], "seed": 1}
    assert document["tables"]["numbers"][1] == {"run": 2, "inertia_kg_m2": None, "signal": "step", "published": 0.25}
    assert [statement["holds"] for statement in document["statements"]] == [True, False, None]
    assert "study table1" in err


def test_json_of_several(studies):
    code, out, _ = tdhil("table1", "figure2", "--json")
    assert code == 0
    assert [part["study"] for part in json.loads(out)["studies"]] == ["table1", "figure2"]


def test_json_of_an_error(studies):
    code, out, _ = tdhil("tabel1", "--json")
    assert code == 2
    document = json.loads(out)
    assert document["exit_code"] == 2
    assert "tabel1" in document["error"]["message"]


# -- settings ----------------------------------------------------------------------------------------------------


def test_set_changes_a_setting_by_name_or_symbol(studies):
    for name in ("kp_nm_s_rad", "Kp"):
        _, out, _ = tdhil("table1", "--set", f"{name}=600", "--set", "tones_hz=[0.2, 0.5]", "--json")
        document = json.loads(out)
        assert document["settings"]["kp_nm_s_rad"] == 600.0
        assert document["settings"]["tones_hz"] == [0.2, 0.5]
        assert document["runs"] == [{"inertia_kg_m2": 200.0}]


@pytest.mark.heavy
def test_a_written_study_file_can_be_changed_and_run(studies, tmp_path):
    assert tdhil("table1", "--set", "Kp=600")[0] == 0
    mine = tmp_path / "my.yaml"
    text = (tmp_path / "study" / "table1" / "study.yaml").read_text()
    mine.write_text(text.replace("kp_nm_s_rad: 600.0", "kp_nm_s_rad: 900.0"))
    code, out, _ = tdhil("--study", mine, "--json")
    assert code == 0
    assert json.loads(out)["settings"]["kp_nm_s_rad"] == 900.0
    assert json.loads(tdhil("table1", "--study", mine, "--json")[1]) == json.loads(out)


@pytest.mark.heavy
def test_the_seed(studies):
    assert json.loads(tdhil("table1", "--seed", 7, "--json")[1])["seed"] == 7
    code, out, _ = tdhil("table1", "figure2", "--seed", 7, "--json")
    assert code == 0
    assert [part["seed"] for part in json.loads(out)["studies"]] == [7, None]


@pytest.mark.parametrize(("arguments", "said"), [
    (("table1", "--set", "kq_nm_s_rad=3"), "did you mean 'kp_nm_s_rad'?"),
    (("table1", "--set", "Kp"), "must be name=value"),
    (("table1", "--set", "Kp=many"), "must be a number, not the text 'many'"),
    (("table1", "--set", "Kp=-1"), "must be greater than 0"),
    (("table1", "--set", "tones_hz=[0.1"), "--set tones_hz=[0.1"),
    (("table1", "figure2", "--set", "Kp=3"), "Name one study"),
    (("figure2", "--seed", "3"), "nothing in figure2 is random"),
    (("table1", "--study", "nowhere.yaml"), "nowhere.yaml: no such file"),
    (("table1", "--out", "a_file"), "--out a_file"),
])
def test_a_bad_setting_ends_with_one_line_and_exit_2(studies, tmp_path, arguments, said):
    (tmp_path / "a_file").write_text("")
    code, out, err = tdhil(*arguments)
    assert (code, out) == (2, "")
    assert said in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize(("text", "said"), [
    ("study: table1\nsettings:\n  kp_nm_s_rad: fast\n", "my.yaml:3: settings.kp_nm_s_rad: must be a number"),
    ("study: table1\nsettings:\n  kp: 3\n", "my.yaml:3: settings: unknown key 'kp'"),
    ("study: tabel1\n", "my.yaml:1: study: no study 'tabel1'"),
    ("study: figure2\n", "the file is for figure2"),
    ("settings: {}\n", "'study' is missing"),
    ("study: [\n", "my.yaml:"),
])
def test_a_bad_file_is_named_with_its_line(studies, tmp_path, text, said):
    (tmp_path / "my.yaml").write_text(text)
    code, out, err = tdhil("table1", "--study", "my.yaml")
    assert (code, out) == (2, "")
    assert said in err
    assert len(err.splitlines()) == 1


# -- the whole paper ---------------------------------------------------------------------------------------------


def test_paper_writes_one_report(studies, tmp_path):
    pytest.importorskip("jinja2")
    code, _, err = tdhil("paper", "--out", "report")
    assert code == 0
    page = (tmp_path / "report" / "index.html").read_text()
    for name in studies:
        assert f'id="{name}"' in page
        assert (tmp_path / "report" / name / "numbers.csv").is_file()
        assert f'href="{name}/numbers.csv"' in page
    assert "yes &amp; &lt;no&gt;" in page
    assert "2 statements hold, 2 do not, 2 are open" in page
    assert "report: report/index.html" in err


def test_paper_without_jinja2_is_written_as_markdown(studies, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "jinja2", None)
    code, out, _ = tdhil("paper", "--json")
    assert code == 0
    assert json.loads(out)["report"] == "study/index.md"
    page = (tmp_path / "study" / "index.md").read_text()
    assert "## table1: A small study, table1" in page
    assert "| 2 | nan | step | 0.25 |" in page
    assert "it does not (does not hold)" in page


def test_one_failed_study_does_not_prevent_the_report(studies, tmp_path):
    studies["figure2"].error = UsageError("the made error")
    code, out, err = tdhil("paper", "--json")
    assert code == 2
    documents = json.loads(out)["studies"]
    assert "error" not in documents[0]
    assert documents[1]["error"]["message"] == "the made error"
    assert "figure2: the made error" in err
    (index,) = (tmp_path / "study").glob("index.*")
    assert "No result: the made error" in index.read_text()


def test_ctrl_c_ends_with_130(studies):
    studies["table1"].error = KeyboardInterrupt()
    code, out, err = tdhil("table1")
    assert (code, out) == (130, "")
    assert "interrupted" in err


@pytest.mark.heavy
def test_on_a_terminal_a_bar_moves_and_is_removed(studies, monkeypatch):
    from rich.console import Console

    from tdhil.report import console

    shown = io.StringIO()
    monkeypatch.setattr(console, "stderr_console", lambda: Console(file=shown, force_terminal=True, width=80))
    code, out, _ = tdhil("table1", "figure2", "--json")
    assert code == 0
    assert len(json.loads(out)["studies"]) == 2
    assert "half of it" in shown.getvalue()


# -- one of the real ones ----------------------------------------------------------------------------------------


@pytest.mark.heavy
def test_a_field_study_over_the_bus(tmp_path):
    code, out, err = tdhil("figure23", "--set", "frequencies_hz=[0.5, 1.0]", "--set", "measured_s=5", "--json")
    assert code == 0, err
    document = json.loads(out)
    assert [run["frequency_hz"] for run in document["runs"]] == [0.5, 1.0]
    assert (tmp_path / "study" / "figure23" / "amplitudes.csv").is_file()
    assert not list(tmp_path.rglob("*.mcap"))
