"""Files are the truth: written whole or not at all, the index made again from them, the audit unchanged."""

from __future__ import annotations

import errno
import os
import random
import sqlite3
import threading
from pathlib import Path

import pytest

from tdhil.service.states import NotThere, State, Status, now, way_to
from tdhil.service.store import Audit, Index, Request, Store, summary_of, write_json, write_whole
from tdhil.service.wire import lives, take_life


@pytest.fixture
def store(tmp_path) -> Store:
    found = Store(tmp_path / "data")
    found.prepare()
    return found


def a_run(store: Store, rig: str = "a", end: State | None = State.REFUSED) -> str:
    run = store.new_id()
    status = store.begin(Request(run, rig, "rig.yaml", "0" * 64, {"seed": 7}, "local", now(), True, "never"))
    if end is not None:
        store.save(way_to(status, end, now()))
    return run


def test_how_a_run_ended_is_told_on_a_full_disk(store, monkeypatch):
    """In the room that was kept for it; and where there is room again, in its file."""
    run = a_run(store, end=None)
    store.reserve(run)
    folder, status = store.place(run), store.status(run)
    with monkeypatch.context() as patched:
        patched.setattr("tdhil.service.store.write_json", full)
        for state in (State.PREFLIGHT, State.REFUSED):
            status = status.to(state, now())
            store.save(status)
            assert store.status(run) == status
        assert {one.stat().st_size for one in folder.glob(".*state*")} == {2**16}
        other = a_run_without_room(store)
        with pytest.raises(OSError, match="No space"):
            store.save(other)
    (folder / ".state.json").write_bytes(b'{"id": "torn')            # by a loss of power
    assert store.status(run).state is State.REQUESTED
    store.save(status)
    store.release(run)
    assert store.status(run) == status
    assert sorted(one.name for one in folder.iterdir()) == ["request.json", "state.json"]


def full(path: Path, plain: object) -> None:
    raise OSError(28, "No space left on device")


def a_run_without_room(store: Store) -> Status:
    return Status.begun(store.new_id(), "a", now())


def test_a_run_comes_back_as_it_was_written(store):
    run = a_run(store)
    assert store.ids() == [run]
    assert (store.request(run).options, store.status(run).state) == ({"seed": 7}, State.REFUSED)
    assert store.result(run) is None
    write_json(store.place(run) / "result.json", {"verdict": "valid", "inertia_kg_m2": {"value": 104.0}})
    assert store.summary(run).inertia_kg_m2 == 104.0


@pytest.mark.parametrize("name", [
    "", ".", "..", "../x", "20260101-000000-abcdef/../..", "20260101-000000-abcdef\0", "<script>", "/etc", "a" * 5000,
    "20260101-000000-abcdeg", "20260101-000000-abcdef\n",
])
def test_a_name_that_is_no_id_names_no_folder(store, name):
    with pytest.raises(NotThere):
        store.place(name)


def test_a_file_that_was_cut_is_an_interrupted_run_not_a_crash(store):
    run = a_run(store, end=None)
    (store.place(run) / "state.json").write_bytes(b'{"id": "')
    assert store.status(run).state is State.INTERRUPTED


def test_a_write_that_fails_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "state.json"
    write_whole(path, b"old")

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_whole(path, b"new")
    assert path.read_bytes() == b"old"
    assert [one.name for one in tmp_path.iterdir()] == ["state.json"]


# -- the index


def rows(index: Index) -> list[object]:
    return index.find(limit=1000)


def test_a_deleted_index_is_made_again_the_same(store):
    index = Index(store)
    for rig, end in (("a", State.REFUSED), ("b", State.FAILED), ("a", State.STOPPED)):
        index.put(store.summary(a_run(store, rig, end)))
    before = rows(index)
    assert len(before) == 3
    assert [one.rig for one in index.find(rig="b")] == ["b"]
    assert [one.state for one in index.find(state="stopped")] == ["stopped"]
    (store.folder / "index.sqlite").unlink()
    assert rows(index) == before
    (store.folder / "index.sqlite").write_bytes(b"")       # cut off
    assert rows(index) == before
    assert index.rebuild() == 3
    assert rows(index) == before == list(store.summaries())


def test_it_has_a_rollback_journal(store):
    Index(store).rebuild()
    with sqlite3.connect(store.folder / "index.sqlite") as base:
        assert base.execute("pragma journal_mode").fetchone() == ("delete",)
    base.close()


def test_a_summary_without_a_result_has_no_number(store):
    run = a_run(store)
    assert summary_of(store.request(run), store.status(run), {"verdict": "x", "inertia_kg_m2": None}).low_kg_m2 is None


# -- the audit


@pytest.fixture
def audit(store) -> Audit:
    found = Audit(store.folder / "audit")
    for number in range(12):
        found.note("local", "asked", run=f"run {number}", rig="a", options={"note": "ü <script>"})
    return found


def only_file(audit: Audit) -> Path:
    (path,) = audit._folder.glob("*.jsonl")
    return path


def test_an_untouched_chain_holds_and_goes_on(store, audit):
    assert audit.verify() is None
    again = Audit(store.folder / "audit")
    again.note("local", "stopped")
    assert again.verify() is None
    assert [entry.number for entry in again.entries()] == list(range(1, 14))


def test_one_changed_byte_anywhere_is_found(audit):
    path = only_file(audit)
    data = path.read_bytes()
    for place in random.Random(5).sample(range(len(data)), 150):
        changed = bytearray(data)
        changed[place] ^= 1 << random.Random(place).randrange(8)
        path.write_bytes(changed)
        assert audit.verify() is not None, place
    path.write_bytes(data)
    assert audit.verify() is None


@pytest.mark.parametrize("change", [
    lambda lines: lines[1:], lambda lines: lines[:-2], lambda lines: lines[:4] + lines[5:],
    lambda lines: [*lines, lines[-1]], lambda lines: [lines[1], lines[0], *lines[2:]],
    lambda lines: [*lines[:-1], lines[-1].replace(b'": ', b'":', 1)], lambda lines: [],
])
def test_lines_taken_out_put_in_or_moved_are_found(audit, change):
    path = only_file(audit)
    path.write_bytes(b"".join(change(path.read_bytes().splitlines(keepends=True))))
    assert audit.verify() is not None


def test_killed_between_line_and_head_it_still_holds(store, audit):
    head = (store.folder / "audit" / "head.json").read_bytes()
    audit.note("local", "asked")
    (store.folder / "audit" / "head.json").write_bytes(head)
    again = Audit(store.folder / "audit")
    assert again.verify() is None
    again.note("local", "asked")
    assert again.verify() is None


def test_many_threads_make_one_chain(store):
    audit = Audit(store.folder / "audit")
    threads = [threading.Thread(target=lambda: [audit.note("local", "x") for _ in range(5)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert audit.verify() is None
    assert len(list(audit.entries())) == 20


def test_a_run_of_which_nothing_can_be_known_is_not_given_up_for_dead(tmp_path, monkeypatch):
    """No descriptor is left in the web's process, say."""
    assert not lives(tmp_path)
    os.close(take_life(tmp_path))
    assert not lives(tmp_path)

    def none_left(*_arguments, **_options):
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(os, "open", none_left)
    assert lives(tmp_path)
