"""`tdhil recover`: findings in complete, truncated, damaged and unreadable files, and the written copy."""

import json
import os
import random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from tdhil.cli.main import main
from tdhil.errors import LogError
from tdhil.recording.log_format import RECOVERED
from tdhil.recording.log_reader import read_frames, read_run, read_samples
from tdhil.recording.mcap_container import MAGIC
from tdhil.recording.salvage import examine, write_copy
from tests.recording.log_runs import CONFIGURATION, STAGES, make_run, same

SOME = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(scope="module")
def data(whole):
    return whole.read_bytes()


def recover(capsys, *arguments):
    code = main(["recover", "--json", *map(str, arguments)])
    return code, json.loads(capsys.readouterr().out)


def everything(path):
    return list(read_samples(path)), list(read_frames(path)), read_run(path, salvage=True)


def test_a_whole_log(whole, tmp_path, capsys):
    code, said = recover(capsys, whole, "-o", tmp_path / "copy.mcap")
    assert code == 0
    assert said["whole"] is said["simulated"] is True
    assert (said["samples"], said["lost"], said["gaps"], said["under_way"]) == (1000, [], [], None)
    assert [stage["name"] for stage in said["stages"]] == [stage.name for stage in STAGES]
    assert said["result"] == {"present": True, "verdict": "valid"}
    samples, frames, run = everything(whole)
    copied_samples, copied_frames, copy = everything(tmp_path / "copy.mcap")
    assert (samples, frames, run.events) == (copied_samples, copied_frames, copy.events)
    assert same(run.recording, copy.recording)
    assert copy.complete


def test_a_log_cut_short(data, tmp_path, capsys):
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(data[:len(data) // 2])
    code, said = recover(capsys, broken, "-o", tmp_path / "copy.mcap")
    assert code == 3
    assert (said["whole"], said["result"]["present"], said["under_way"]) == (False, False, "setup")
    assert said["lost"] == ["byte " + said["lost"][0].split()[1] + " the file ends in the middle of a record: it was "
                            "not closed"]
    assert 100 < said["samples"] < 900
    with (tmp_path / "copy.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)         # mcap's reader, by the index that was missing
        assert len(list(reader.iter_messages(topics=["/sample"]))) == said["samples"]
    run = read_run(tmp_path / "copy.mcap")
    assert not run.complete                                    # the file is complete, the run is not
    assert not run.recording.complete
    assert [event.kind for event in run.events] == [RECOVERED]
    assert "not closed" in run.problems[0]
    assert run.configuration == CONFIGURATION
    code, again = recover(capsys, tmp_path / "copy.mcap", "-o", tmp_path / "again.mcap")
    assert (code, again["samples"]) == (3, said["samples"])
    assert len(read_run(tmp_path / "again.mcap").events) == 1


def test_in_words(data, tmp_path, capsys):
    (tmp_path / "broken.mcap").write_bytes(data[:20_000] + bytes(3000) + data[23_000:-100])
    assert main(["recover", str(tmp_path / "broken.mcap")]) == 3
    said = capsys.readouterr().out
    for words in ("SIMULATED", "partial;", "speed    degraded", "result: valid", "lost:", "skipped", "gaps between",
                  "recover -o whole.mcap"):
        assert words in said


@pytest.mark.heavy
@SOME
@given(seed=st.integers(0, 2**32), share=st.floats(0.01, 1.0), flips=st.integers(0, 6))
def test_a_copy_contains_exactly_the_readable_data(data, tmp_path, seed, share, flips):
    rng, damaged = random.Random(seed), bytearray(data[:int(share * len(data))])
    for _ in range(flips):
        damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
    broken, target = tmp_path / "broken.mcap", tmp_path / "copy.mcap"
    broken.write_bytes(damaged)
    try:
        found = examine(broken)
    except LogError as error:
        assert error.exit_code == 10
        assert len(damaged) < 5000 * (flips + 2)       # each chunk is damaged or truncated
        return
    write_copy(broken, target, found)
    with target.open("rb") as file:
        list(make_reader(file, validate_crcs=True).iter_messages(log_time_order=False))
    run = read_run(target)
    assert same(run.recording, found.run.recording)
    assert run.complete == found.whole
    assert (run.stages, repr(run.result)) == (found.run.stages, repr(found.run.result))
    if broken.read_bytes().startswith(MAGIC):
        assert list(read_samples(target)) == list(read_samples(broken))
        assert list(read_frames(target)) == list(read_frames(broken))


@pytest.mark.parametrize("hit", [4, 20, 40, 3000])
def test_a_damaged_head_is_no_obstacle(data, tmp_path, capsys, hit):
    """The chunk that declares the channels may be lost too; it contains no sample."""
    (tmp_path / "broken.mcap").write_bytes(bytes(hit) + data[hit:])
    code, said = recover(capsys, tmp_path / "broken.mcap")
    assert (code, said["samples"] > 900) == (3, True)
    assert "does not begin like MCAP" in said["lost"][0]


@pytest.mark.parametrize("content", [b"", b"time_s,speed_rad_s\n1,2\n", MAGIC, MAGIC + bytes(5000)])
def test_nothing_recoverable(content, tmp_path, capsys):
    (tmp_path / "broken.mcap").write_bytes(content)
    code, said = recover(capsys, tmp_path / "broken.mcap", "-o", tmp_path / "copy.mcap")
    assert (code, said["exit_code"]) == (10, 10)
    assert said["error"]["message"].startswith(str(tmp_path / "broken.mcap"))
    assert not (tmp_path / "copy.mcap").exists()


def test_the_log_itself_is_never_overwritten(data, tmp_path, capsys):
    log, link, hard = (tmp_path / name for name in ("run.mcap", "link.mcap", "hard.mcap"))
    log.write_bytes(data)
    link.symlink_to(log)
    os.link(log, hard)
    for target in (log, link, hard, tmp_path / "." / "run.mcap"):
        code, said = recover(capsys, log, "-o", target)
        assert code == 2
        assert "over the log itself" in said["error"]["message"]
    assert log.read_bytes() == data


def test_an_older_file_is_kept_and_a_bad_place_is_refused(data, tmp_path, capsys):
    (tmp_path / "run.mcap").write_bytes(data)
    (tmp_path / "copy.mcap").write_bytes(b"older")
    assert recover(capsys, tmp_path / "run.mcap", "-o", tmp_path / "copy.mcap")[0] == 0
    assert b"older" in [path.read_bytes() for path in tmp_path.iterdir()]
    code, said = recover(capsys, tmp_path / "run.mcap", "-o", tmp_path / "none" / "copy.mcap")
    assert code == 2
    assert "can't be opened" in said["error"]["message"]
    assert recover(capsys, tmp_path / "missing.mcap")[0] == 2
    assert not list(tmp_path.glob("*.part"))


def test_a_failed_copy_leaves_nothing_behind(whole, tmp_path, monkeypatch):
    from tdhil.recording import salvage

    def full(self, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(salvage.Container, "_put", full)
    with pytest.raises(LogError, match="No space left"):
        write_copy(whole, tmp_path / "copy.mcap", examine(whole))
    assert list(tmp_path.iterdir()) == []


def test_a_killed_run_of_a_known_length(tmp_path):
    make_run(tmp_path / "run.mcap", 200)
    found = examine(tmp_path / "run.mcap")
    assert found.whole
    assert found.gaps == ()


def test_with_a_damaged_name_and_first_chunk_the_rest_is_recovered(data, tmp_path, capsys):
    """Neither the writer nor the meaning of the channels can be read."""
    damaged = bytearray(data)
    damaged[data.index(b"tdhil 0.")] ^= 4
    damaged[data.index(b"zstd") + 200] ^= 1
    (tmp_path / "broken.mcap").write_bytes(damaged)
    code, said = recover(capsys, tmp_path / "broken.mcap")
    assert (code, said["samples"] > 900) == (3, True)
