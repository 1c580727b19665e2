"""The corpus again, with all that was ever found, and a short fresh round of each parser; the long one is
`python benchmarks/fuzz.py`."""

import logging
import random
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.errors import TdhilError
from tests.fuzz import mutate
from tests.fuzz.parsers import CSV_WORDS, PARSERS, YAML_WORDS, check_refusal, try_one

ROOT = Path(__file__).parents[2]
FRESH = {"can": 40, "eds": 40, "mcap": 40, "profile": 40}
FILES = [(name, path) for name, parser in PARSERS.items() for path in sorted(parser.folder.iterdir())]
YAML = [name for name, parser in PARSERS.items() if parser.suffix == ".yaml"]
FEW = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(autouse=True)
def quiet():
    logging.disable()
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.parametrize(("name", "path"), FILES, ids=lambda part: getattr(part, "name", part))
def test_the_corpus(name, path, tmp_path):
    parser = PARSERS[name]
    told = try_one(parser, path.read_bytes(), tmp_path / f"input{parser.suffix}")
    if path.name.startswith("valid") and name != "modbus":
        assert told == ("taken" if name != "can" or path.stem in CALM else "refused")


CALM = {"valid_nothing", "valid_late", "valid_segment", "valid_abort", "valid_short"}


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("name", PARSERS)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_fresh_round(name, tmp_path):
    parser, corpus = PARSERS[name], PARSERS[name].corpus()
    path = tmp_path / f"input{parser.suffix}"
    told = {try_one(parser, mutate.mutated(random.Random(f"tests {number}"), corpus, parser.mutations), path)
            for number in range(FRESH.get(name, 120))}
    assert "refused" in told


@pytest.mark.heavy
@pytest.mark.parametrize("name", YAML)
@FEW
@given(text=st.lists(st.one_of(st.text(max_size=12), st.sampled_from(
    [word.decode("utf-8", "replace") for word in YAML_WORDS] + ["\n", "\n  ", "study: coverage", "bus: canopen"])),
    max_size=12).map("".join))
def test_any_text_as_yaml(name, tmp_path, text):
    try_one(PARSERS[name], text.encode("utf-8", "replace"), tmp_path / "input.yaml")


@FEW
@given(words=st.lists(st.one_of(st.binary(max_size=12), st.sampled_from([*CSV_WORDS, b"\n", b"1", b"2.5"])),
                      max_size=60))
def test_any_bytes_as_csv(tmp_path, words):
    try_one(PARSERS["csv"], b"".join(words), tmp_path / "input.csv")


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(script=st.lists(st.tuples(st.integers(0, 255), st.integers(0, 255), st.integers(0, 11), st.integers(0, 8),
                                 st.binary(min_size=8, max_size=8)), max_size=30))
def test_any_frames_on_the_bus(tmp_path, script):
    data = b"".join(bytes(record[:4]) + record[4] for record in script)
    try_one(PARSERS["can"], data, tmp_path / "input.bin")


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(script=st.binary(max_size=300))
def test_any_reply_on_modbus(tmp_path, script):
    try_one(PARSERS["modbus"], script, tmp_path / "input.bin")


@pytest.mark.parametrize("name", YAML)
@pytest.mark.parametrize("tag", ["!!python/object/apply:pathlib.Path.touch", "!!python/object/new:os.system",
                                 "!!python/name:os.system", "!!python/module:os", "!touch"])
def test_data_contain_no_executed_code(name, tag, tmp_path):
    path, marker = tmp_path / "input.yaml", tmp_path / "marker"
    path.write_text(f"study: {tag} [touch {marker}]\nbus: {tag} ['{marker}']\n{tag} a: 1\n")
    with pytest.raises(TdhilError) as error:
        PARSERS[name].parse(path)
    check_refusal(error.value, path)
    assert not marker.exists()


GROWING = """
import resource, sys
from pathlib import Path
from drivers.errors import TdhilError
from tdhil.config.rig import load_rig

limit = 2 * 2**30
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
doubling = "a0: &a0 [x, x]\\n" + "".join(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}]\\n" for k in range(1, 40))
path, before = Path(sys.argv[1]), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for text in (doubling, "[" * 50_000, "{a: " * 20_000, "- " * 50_000, "x" * 5_000_000, "a: 1\\n" * 10_000):
    path.write_text(text)
    try:
        load_rig(path)
    except TdhilError as error:
        print(len(str(error)))
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


@pytest.mark.heavy
def test_growing_or_nested_text_needs_little_memory(tmp_path):
    """The inputs have doubling aliases, endless brackets, or large size. All YAML is read by one loader."""
    done = subprocess.run([sys.executable, "-c", GROWING, tmp_path / "rig.yaml"], capture_output=True, text=True,
                          cwd=ROOT, timeout=600)
    assert done.returncode == 0, done.stderr
    *lengths, grown_kb = map(int, done.stdout.split())
    assert len(lengths) == 6
    assert max(lengths) < 10_000
    assert grown_kb < 100_000


def test_the_harness_finds_faults(tmp_path):
    def wrong(path):
        raise ValueError("a mistake of ours")

    def two_lines(path):
        raise TdhilError("first line\nsecond line", where="here")

    def nowhere(path):
        raise TdhilError("something is wrong")

    for parse, expected in ((wrong, ValueError), (two_lines, AssertionError), (nowhere, AssertionError)):
        with pytest.raises(expected):
            try_one(replace(PARSERS["csv"], parse=parse), b"", tmp_path / "x")


def test_the_same_seed_makes_the_same_inputs():
    corpus = PARSERS["mcap"].corpus()
    made = [[mutate.mutated(random.Random(f"1 {k}"), corpus, PARSERS["mcap"].mutations) for k in range(20)]
            for _ in range(2)]
    assert made[0] == made[1]
    assert len(set(made[0])) > 15


@pytest.mark.heavy
def test_the_named_command(tmp_path):
    done = subprocess.run(
        [sys.executable, ROOT / "benchmarks" / "fuzz.py", "--parser", "csv", "--inputs", "30", "--findings",
         tmp_path / "findings"], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "30 inputs" in done.stdout
    assert not (tmp_path / "findings").exists()
