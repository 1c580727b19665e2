"""Files as the primary data: complete writes, an index that can be rebuilt from them, and an unchanged audit."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import random
import sqlite3
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest

from tdhil.cli.main import main
from tdhil.errors import UsageError
from tdhil.service import console as console_module
from tdhil.service import store as store_module
from tdhil.service.audit import KEY_FILE, Audit, ChainHead
from tdhil.service.run_channel import lives, take_life
from tdhil.service.run_state import NotThere, State, Status, now, way_to
from tdhil.service.store import Index, Store, StoredRequest, summary_of, write_json, write_whole


@pytest.fixture
def store(tmp_path) -> Store:
    found = Store(tmp_path / "data")
    found.prepare()
    return found


def a_run(store: Store, rig: str = "a", end: State | None = State.REFUSED) -> str:
    run = store.new_id()
    status = store.begin(StoredRequest(run, rig, "rig.yaml", "0" * 64, {"seed": 7}, "local", now(), True, "never"))
    if end is not None:
        store.save(way_to(status, end, now()))
    return run


def test_the_end_of_a_run_is_recorded_on_a_full_disk(store, monkeypatch):
    """The end is written into reserved space, and later into its file once there is space."""
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


def test_a_run_is_read_as_written(store):
    run = a_run(store)
    assert store.ids() == [run]
    assert (store.request(run).options, store.status(run).state) == ({"seed": 7}, State.REFUSED)
    assert store.result(run) is None
    write_json(store.place(run) / "result.json", {"verdict": "valid", "inertia_kg_m2": {"value": 104.0}})
    assert store.summary(run).inertia_kg_m2 == 104.0


def test_ids_sort_by_the_time_they_were_made_at(store):
    made = []
    for _ in range(20):
        made.append(store.new_id())
        time.sleep(2e-6)        # an id holds whole microseconds
    assert store.ids() == made[::-1]


@pytest.mark.parametrize("name", [
    "", ".", "..", "../x", "20260101-000000-abcdef/../..", "20260101-000000-abcdef\0", "<script>", "/etc", "a" * 5000,
    "20260101-000000-abcdeg", "20260101-000000-abcdef\n",
])
def test_an_invalid_id_names_no_folder(store, name):
    with pytest.raises(NotThere):
        store.place(name)


def test_a_truncated_file_is_an_interrupted_run(store):
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


def test_the_key_of_a_deleted_run_finds_it_for_its_user_and_rig_alone(store):
    write_json(store.folder / "deleted_keys.json", {"runs": [["old", "a", "k", "anna"], ["new", "a", "k", "anna"]]})
    assert store.deleted_with_key("a", "k", "anna") == "new"
    assert store.deleted_with_key("a", "k", "otto") is store.deleted_with_key("b", "k", "anna") is None


def test_a_deleted_index_is_rebuilt_identically(store):
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


@pytest.mark.parametrize(("text", "expected"), [
    ("", 2), ("ÖLMÜHLE", 1), ("hans b", 1), ("after repair hans", 1), ("hans after-market", 0), ("100%", 0),
    ("'; drop", 0),
])
def test_a_search_finds_each_word_in_any_text_of_a_run(store, text, expected):
    """Index and files agree, in upper and lower case. SQL and its wildcards are plain text."""
    index = Index(store)
    options = {"operator": "Hans", "note": "after repair, Ölmühle"}
    for rig, said in (("b", options), ("a", {})):
        request = replace(store.request(a_run(store, rig)), options=said)
        index.put(summary_of(request, store.status(request.id), None))
    every = index.find()
    assert len(index.find(text=text)) == expected
    assert index.find(text=text) == [one for one in every if one.contains(text)]


def test_a_rehearsal_is_marked_in_the_list_of_runs(store):
    """A fault of the simulated drive changes the result, so the list and its users need the mark."""
    request = replace(store.request(a_run(store)), options={"fault": ["torque-scale=1.1"]})
    assert summary_of(request, store.status(request.id), None).rehearsal
    index = Index(store)
    index.put(summary_of(request, store.status(request.id), None))
    assert [one.rehearsal for one in index.find()] == [True]


def test_a_rebuild_holds_its_lock_for_one_batch_only(store, monkeypatch):
    """The files are read without the lock, so another reader waits for at most one batch."""
    monkeypatch.setattr(store_module, "BATCH", 2)
    for _ in range(5):
        a_run(store)
    index, read, seen = Index(store), store.summary, []
    assert index.rebuild() == 5

    def reading(run):
        seen.append(len(index.find(limit=1000)))           # would never return if the lock were held
        assert not index.wait_until_made(0.0)
        return read(run)

    monkeypatch.setattr(store, "summary", reading)
    assert index.rebuild() == 5 and seen == [5] * 5        # the former index
    seen.clear()
    (store.folder / "index.sqlite").unlink()
    assert index.rebuild() == 5 and seen == [0, 0, 2, 2, 4]
    assert index.wait_until_made(0.0)


def test_changes_during_a_rebuild_are_not_overwritten(store, monkeypatch):
    runs = [a_run(store) for _ in range(3)]
    index, read = Index(store), store.summary
    index.rebuild()
    for name in ("request.json", "state.json"):
        (store.place(runs[2]) / name).unlink()

    def reading(run):
        found = read(run)
        if run == runs[0]:
            index.put(replace(found, note="newer"))
        if run == runs[1]:
            index.remove(run)
        return found

    monkeypatch.setattr(store, "summary", reading)
    index.rebuild()
    assert {one.id: one.note for one in index.find(limit=9) if one.id != runs[2]} == {runs[0]: "newer"}
    store.delete(runs[2])
    monkeypatch.setattr(store, "summary", read)
    assert index.rebuild() == 2 and {one.id for one in index.find()} == set(runs[:2])


def test_a_file_that_is_no_index_is_replaced_by_a_rebuild(store):
    run = a_run(store)
    (store.folder / "index.sqlite").write_bytes(b"no database" * 1000)
    index = Index(store)
    assert index.rebuild() == 1 and [one.id for one in index.find()] == [run]


def test_the_index_has_a_rollback_journal(store):
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


def test_an_unchanged_chain_is_valid_and_continues(store, audit):
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
def test_removed_added_or_moved_lines_are_found(audit, change):
    path = only_file(audit)
    path.write_bytes(b"".join(change(path.read_bytes().splitlines(keepends=True))))
    assert audit.verify() is not None


def test_after_a_kill_between_line_and_head_it_is_still_valid(store, audit):
    head = (store.folder / "audit" / "head.json").read_bytes()
    audit.note("local", "asked")
    (store.folder / "audit" / "head.json").write_bytes(head)
    again = Audit(store.folder / "audit")
    assert again.verify() is None
    again.note("local", "asked")
    assert again.verify() is None


def test_many_threads_write_one_chain(store):
    audit = Audit(store.folder / "audit")
    threads = [threading.Thread(target=lambda: [audit.note("local", "x") for _ in range(5)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert audit.verify() is None
    assert len(list(audit.entries())) == 20


def test_a_run_of_unknown_state_is_not_declared_dead(tmp_path, monkeypatch):
    """An example is a web process without free descriptors."""
    assert not lives(tmp_path)
    os.close(take_life(tmp_path))
    assert not lives(tmp_path)

    def none_left(*_arguments, **_options):
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(os, "open", none_left)
    assert lives(tmp_path)


# -- the key of the audit, and a head that is kept elsewhere


def lines_of(audit: Audit) -> list[bytes]:
    return only_file(audit).read_bytes().splitlines(keepends=True)


def fabricated(last: bytes, number: int, before: str) -> bytes:
    """Return a forged line with a plain hash, made without the key."""
    plain = {**json.loads(last), "number": number, "before": before, "who": "anna"}
    plain.pop("hash", None)
    digest = hashlib.sha256(json.dumps(plain, ensure_ascii=False, sort_keys=True).encode()).hexdigest()
    return json.dumps({**plain, "hash": digest}, ensure_ascii=False).encode() + b"\n"


def cut_off_with_a_new_head(audit: Audit) -> None:
    *kept, _ = lines_of(audit)
    only_file(audit).write_bytes(b"".join(kept))
    last = json.loads(kept[-1])
    write_json(audit._folder / "head.json", {"number": last["number"], "hash": last["hash"]})


def cut_off_with_an_old_head(audit: Audit) -> None:
    old = (audit._folder / "head.json").read_bytes()
    audit.note("local", "stop asked")
    only_file(audit).write_bytes(b"".join(lines_of(audit)[:-1]))
    (audit._folder / "head.json").write_bytes(old)


def one_more_line_without_a_head(audit: Audit) -> None:
    last = lines_of(audit)[-1]
    with only_file(audit).open("ab") as file:
        file.write(fabricated(last, 13, json.loads(last)["hash"]))


def one_more_line_with_a_head(audit: Audit) -> None:
    one_more_line_without_a_head(audit)
    write_json(audit._folder / "head.json", {"number": 13, "hash": json.loads(lines_of(audit)[-1])["hash"]})


def all_of_it_deleted(audit: Audit) -> None:
    for path in audit._folder.iterdir():
        path.unlink()


def the_key_deleted(audit: Audit) -> None:
    (audit._folder.parent / KEY_FILE).unlink()


def the_key_another(audit: Audit) -> None:
    path = audit._folder.parent / KEY_FILE
    write_json(path, {**json.loads(path.read_bytes()), "key": "ab" * 32})


def an_old_head_alone(audit: Audit) -> None:
    old = (audit._folder / "head.json").read_bytes()
    for _ in range(2):
        audit.note("local", "stop asked")
    (audit._folder / "head.json").write_bytes(old)


def a_head_without_its_seal(audit: Audit) -> None:
    path = audit._folder / "head.json"
    write_json(path, {**json.loads(path.read_bytes()), "mac": "0" * 64})


@pytest.mark.heavy
@pytest.mark.parametrize("attack", [
    cut_off_with_a_new_head, cut_off_with_an_old_head, one_more_line_without_a_head, one_more_line_with_a_head,
    all_of_it_deleted, the_key_deleted, the_key_another, an_old_head_alone, a_head_without_its_seal,
])
@pytest.mark.parametrize("goes_on", [False, True])
def test_a_change_of_the_chain_without_its_key_is_found_permanently(audit, attack, goes_on):
    """Later lines of the service do not make a broken chain valid again."""
    attack(audit)
    again = Audit(audit._folder)
    assert again.verify() is not None
    if goes_on:
        with contextlib.suppress(OSError):
            for _ in range(3):
                again.note("local", "asked")
        if attack in (an_old_head_alone, a_head_without_its_seal):
            assert again.verify() is None      # its lines are unchanged, and it has a head again
        else:
            assert again.verify() is not None
            assert Audit(audit._folder).verify() is not None


def test_the_key_is_private_and_made_once(store, audit):
    path = store.folder / KEY_FILE
    assert path.stat().st_mode & 0o777 == 0o600
    key = json.loads(path.read_bytes())["key"]
    Audit(store.folder / "audit").note("local", "asked")
    assert json.loads(path.read_bytes())["key"] == key
    assert key not in "".join(one.read_text() for one in (store.folder / "audit").iterdir())


def test_after_a_kill_between_head_and_anchor_it_is_still_valid(store, audit):
    kept = (store.folder / KEY_FILE).read_bytes()
    audit.note("local", "asked")
    (store.folder / KEY_FILE).write_bytes(kept)
    again = Audit(store.folder / "audit")
    assert again.verify() is None
    again.note("local", "asked")
    assert again.verify() is None
    assert [entry.number for entry in again.entries()] == list(range(1, 15))


def test_a_kept_head_finds_another_chain_with_another_key(store, audit):
    kept = audit.head()
    assert (kept.number, ChainHead.of(str(kept))) == (12, kept)
    audit.note("local", "asked")
    assert audit.verify(kept) is None
    all_of_it_deleted(audit)
    the_key_deleted(audit)
    other = Audit(store.folder / "audit")
    assert other.verify() is None                      # the chain itself does not show it …
    for _ in range(14):
        other.note("local", "asked")
    assert other.verify() is None
    assert "line 12 differs from the exported head" in other.verify(kept).why      # … but the exported head does
    with pytest.raises(UsageError):
        ChainHead.of("12")


def test_a_chain_without_a_key_is_accepted_and_sealed_from_then_on(store):
    folder, before, lines = store.folder / "audit", "0" * 64, []
    for number in range(1, 4):
        plain = {"number": number, "at": now(), "who": "local", "what": "asked", "run": None, "rig": None,
                 "details": {}}
        lines.append(fabricated(json.dumps(plain).encode(), number, before))
        before = json.loads(lines[-1])["hash"]
    (folder / f"{now()[:7]}.jsonl").write_bytes(b"".join(lines))
    write_json(folder / "head.json", {"number": 3, "hash": before})
    audit = Audit(folder)
    assert "the key of the chain can't be read" in audit.verify().why
    audit.begin()
    assert audit.verify() is None
    assert [(one.who, one.what, one.details) for one in audit.entries()][3:] == [
        ("service", "audit key made", {"lines_before": 3})]
    audit.begin()                                      # once
    audit.note("local", "asked")
    assert Audit(folder).verify() is None
    for place in (0, 3, 4):
        changed = lines_of(audit)
        changed[place] = changed[place].replace(b'"asked"', b'"Asked"').replace(b'"service"', b'"Service"')
        path = only_file(audit)
        data = path.read_bytes()
        path.write_bytes(b"".join(changed))
        assert Audit(folder).verify().line == place + 1
        path.write_bytes(data)


def test_the_key_exists_before_the_first_line(store):
    audit = Audit(store.folder / "audit")
    audit.begin()
    assert (store.folder / KEY_FILE).exists()
    assert list(audit.entries()) == []
    assert audit.verify() is None
    assert Audit(store.folder / "audit").made() == audit.made()


def test_a_key_that_cannot_be_read_is_not_replaced(audit):
    path = audit._folder.parent / KEY_FILE
    path.write_text("{}")
    again = Audit(audit._folder)
    with pytest.raises(OSError, match="key can't be read"):
        again.note("local", "asked")
    assert path.read_text() == "{}"
    assert "key of the chain can't be read" in again.verify().why
    assert again.head() is None


def test_the_audit_on_the_terminal(audit, capsys, tmp_path):
    def check(*more: str) -> int:
        return main(["serve", "audit", "--data", str(tmp_path / "data"), *more])

    assert check() == 0
    head = capsys.readouterr().out.strip()
    assert head == str(audit.head())
    audit.note("local", "asked")
    assert check("--head", head) == 0
    assert "13 lines" in capsys.readouterr().err
    assert check("--head", f"12:{'0' * 64}") != 0
    assert "differs from the exported head" in capsys.readouterr().err
    only_file(audit).write_bytes(b"")
    assert check() != 0
    assert "chain is broken" in capsys.readouterr().err


@pytest.mark.parametrize(("options", "marks"), [({}, ", SIMULATED"), (
    {"fault": ["sto@hold"]}, ", SIMULATED, FAULT REHEARSAL")])
def test_the_console_at_the_rig_marks_runs_that_wait_for_their_code(tmp_path, monkeypatch, options, marks):
    store, said = Store(tmp_path), []
    store.prepare()
    run = store.new_id()
    store.begin(StoredRequest(run, "a", "a.yaml", "0" * 64, options, "local", now(), True, "attended"))
    monkeypatch.setattr(console_module, "ask", lambda *_: {"code": "123456", "left_s": 60.0})
    console_module.Console(store, said.append).show(run, replace(store.status(run), simulated=True))
    assert f"Rig a{marks}. Requested by local, run {run}" in said[0]
