"""Log whose folder is renamed or removed during a run: no data are lost, and messages name an existing file."""

import os
import shutil
import sys
import tempfile
from pathlib import Path

import pytest

from tdhil.errors import LogBroken
from tdhil.session.log_files import LogPlace

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="where an open file is, Linux alone tells")


@pytest.fixture
def opened(tmp_path):
    folder = tmp_path / "bench"
    folder.mkdir()
    place = LogPlace(folder / "run.mcap")
    file = place.open(place.wanted)
    file.write(b"what was recorded")
    yield place, folder
    file.close()
    place._forget()


def test_a_device_is_written_to_directly():
    place = LogPlace(Path(os.devnull))
    with place.open(place.wanted) as file:
        assert file.write(b"what was recorded")
    assert (place.path, place.older, place.live) == (Path(os.devnull), None, False)


def test_a_log_that_is_not_moved_is_not_searched(opened):
    place, folder = opened
    place.follow()
    assert (place.path, place.moved) == (folder / "run.mcap", "")


def test_a_folder_that_is_renamed(opened, tmp_path):
    place, folder = opened
    folder.rename(tmp_path / "elsewhere")
    place.follow()
    assert place.path == tmp_path / "elsewhere" / "run.mcap"
    assert str(place.path) in place.moved
    assert place.path.read_bytes() == b"what was recorded"


def test_another_file_with_its_name_is_not_accepted(opened, tmp_path):
    place, folder = opened
    folder.rename(tmp_path / "elsewhere")
    folder.mkdir()
    (folder / "run.mcap").write_bytes(b"another run's")
    place.follow()
    assert place.path == tmp_path / "elsewhere" / "run.mcap"


@pytest.mark.parametrize("whole_folder", [False, True])
def test_a_file_that_is_removed_is_saved(opened, tmp_path, monkeypatch, whole_folder):
    place, folder = opened
    monkeypatch.chdir(tmp_path)
    if whole_folder:
        shutil.rmtree(folder)
    else:
        place.path.unlink()
    place.follow()
    assert place.path.parent == (tmp_path if whole_folder else folder)
    assert place.path.read_bytes() == b"what was recorded"
    assert "was removed during the run" in place.moved and str(place.path) in place.moved
    place.follow()                             # once


def test_a_file_that_is_removed_with_the_working_folder_is_saved(opened, tmp_path, monkeypatch):
    place, folder = opened
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    monkeypatch.chdir(folder)
    shutil.rmtree(folder)
    place.follow()
    monkeypatch.chdir(tmp_path)
    assert place.path.parent == tmp_path / "temporary"
    assert place.path.read_bytes() == b"what was recorded"


def test_without_any_folder_the_error_is_one_of_the_log(opened, tmp_path, monkeypatch):
    place, folder = opened
    monkeypatch.setattr(tempfile, "gettempdir", lambda: (_ for _ in ()).throw(FileNotFoundError(2, "no folder")))
    monkeypatch.chdir(folder)
    shutil.rmtree(folder)
    with pytest.raises(LogBroken, match="moved or removed"):
        place.follow()
    monkeypatch.chdir(tmp_path)


def test_a_log_that_can_be_neither_found_nor_saved_is_an_error(opened, monkeypatch):
    place, folder = opened
    shutil.rmtree(folder)
    monkeypatch.setattr(shutil, "copyfileobj", lambda *files: (_ for _ in ()).throw(OSError(28, "full")))
    with pytest.raises(LogBroken, match="moved or removed") as caught:
        place.follow()
    assert caught.value.exit_code == 3


@pytest.mark.heavy
def test_a_run_reports_where_its_log_is(tmp_path, monkeypatch, capsys):
    """The command line runs, and the folder is renamed while the shaft turns."""
    from tdhil.cli.main import main
    from tdhil.recording.log_reader import read_run
    from tdhil.session.run_session import RunSession

    folder = tmp_path / "bench"
    folder.mkdir()
    monkeypatch.chdir(tmp_path)
    plain = RunSession._confirm

    def confirm(session, *rest):
        plain(session, *rest)
        folder.rename(tmp_path / "elsewhere")

    monkeypatch.setattr(RunSession, "_confirm", confirm)
    log = str(folder / "run.mcap")
    code = main(["identify", "--simulate", "--seed", "1", "--fault", "emcy@speed+3s", "--log", log])
    said = capsys.readouterr()
    found = tmp_path / "elsewhere" / "run.mcap"
    assert str(found) in said.err.replace("\n", "")
    assert read_run(found).complete
    assert code == 6
