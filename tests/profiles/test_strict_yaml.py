"""Strict loader: pitfalls of YAML 1.1, all problems at once with their lines, and only DataFileError."""

from pathlib import Path
from typing import Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import Field

from profiles.errors import DataFileError
from profiles.yaml_loader import MAX_BYTES, MAX_PROBLEMS, DataModel, load_model, load_with_lines, parse_model


class Part(DataModel):
    torque_nm: float = Field(gt=0, description="N·m")
    count: int = 1
    flag: bool = False
    word: str = "x"
    pair: tuple[int, ...] = ()
    kind: Literal["none", "string"] = "none"


class Whole(DataModel):
    part: Part | None = None
    parts: tuple[Part, ...] = ()
    options: dict[str, str | int | float | bool] = Field(default={})
    a: float | None = None
    n: int | None = None
    b: bool | None = None
    s: str | None = None


def refused(text: str) -> list[tuple[int, str]]:
    with pytest.raises(DataFileError) as caught:
        parse_model(text, "f.yaml", Whole)
    return [(problem.line, problem.message) for problem in caught.value.problems]


def test_a_file_of_another_kind_is_one_problem() -> None:
    """An example is a result document, which also has a drive and a profile."""
    foreign = "".join(f"key{number}: 1\n" for number in range(8))
    known = "a, b, n, options, part, parts, s"
    text = "a file of another kind: 8 of its {} keys are unknown; known here: " + known
    assert refused(foreign) == [(0, text.format(8))]
    assert refused(f"{foreign}a: 1\nb: 1\n") == [(0, text.format(10))]
    assert len(refused(f"{foreign}a: 1\nb: true\nn: 1\n")) == 8
    assert len(refused("key1: 1\nkey2: 1\n")) == 2
    for other in ("5", "true", "[1, 2]", "text"):
        assert "must be a section" in refused(other)[0][1]


def test_no_boolean_is_advised_for_a_number() -> None:
    assert refused("a: yes") == [(1, "a: must be a number, not the text 'yes'")]


@pytest.mark.parametrize(
    ("text", "key", "value"),
    [
        ("a: 1e3", "a", 1000.0),
        ("a: 1E-3", "a", 0.001),
        ("a: .5", "a", 0.5),
        ("a: 5.", "a", 5.0),
        ("a: -7", "a", -7.0),
        ("a: +0.25", "a", 0.25),
        ("n: 0x1F", "n", 31),
        ("n: 0o17", "n", 15),
        ("n: 0", "n", 0),
        ("n: ~", "n", None),
        ("n:", "n", None),
        ("b: TRUE", "b", True),
        ("s: on", "s", "on"),
        ("s: no", "s", "no"),
        ("s: 12:30", "s", "12:30"),
        ("s: 2024-05-01", "s", "2024-05-01"),
        ("s: 1_000", "s", "1_000"),
        ("s: 0b11", "s", "0b11"),
        ("s: '010'", "s", "010"),
        ('s: "true"', "s", "true"),
        ("s: =", "s", "="),
        ("\ufeffs: µ", "s", "µ"),
        ("s: |\n  two\n  lines\n", "s", "two\nlines\n"),
    ],
)
def test_what_is_read(text: str, key: str, value: object) -> None:
    found = getattr(parse_model(text, "f.yaml", Whole), key)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.heavy(but_first=14)
@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("\na: 010", 2, "write 10 or 0o10"),
        ("a: -08", 1, "write -8"),
        ("a: 1_000", 1, "write 1000"),
        ("a: 12:30", 1, "without ':'"),
        ("a: 1,5", 1, "a decimal point"),
        ("a: 5 Nm", 1, "write the number alone: this key has no unit"),
        ("a: '5'", 1, "write 5 without quotes"),
        ("a: .nan", 1, "finite"),
        ("a: -.Inf", 1, "finite"),
        ("a: 1e999", 1, "too large"),
        ("a: " + "9" * 5000, 1, "characters"),
        ("n: 1e3", 1, "must be a whole number, not 1000.0; write 1000"),
        ("n: 1.5", 1, "must be a whole number, not 1.5"),
        ("n: true", 1, "must be a whole number, not true"),
        ("b: on", 1, "write true"),
        ("b: No", 1, "write false"),
        ("b: 1", 1, "write true or false"),
        ("s: 12", 1, "put it in quotes"),
        ("s: 1\n\ns: 2", 3, "lines 1 and 3"),
        ("a: &x 1", 1, "anchor"),
        ("a: 1\nn: *x", 2, "alias"),
        ("a: 1\npart:\n  <<: {torque_nm: 1}", 3, "merge key"),
        ("a: !!float 1", 1, "tag"),
        ("a: !mine 1", 1, "tag"),
        ("a: ! 1", 1, "tag"),
        ("a: !!python/object/apply:os.system ['true']", 1, "tag"),
        ("a: 1\n12: 1", 2, "put it in quotes"),
        ("a: 1\ntrue: 1", 2, "put it in quotes"),
        ("? [a, b]\n: 1", 1, "a key must be text"),
        ("a: 1\n\tn: 2", 2, "tab"),
        ("part:\n\ttorque_nm: 2", 2, "tab"),
        ("a:\n  - 1\n n: 2", 3, "indentation"),
        ("a: b: c", 1, "a ': ' stands inside a text; put the text in quotes"),
        ("a: 1\n# c\ntorque_nm 400  # limit\n\nb: 2", 3, "'torque_nm 400' has no ': ' after the key. "
         "Write torque_nm: 400, with a space after the colon"),
        ("a: 1\ntorque_nm:400\nb: 2", 2, "Write torque_nm: 400, with a space after the colon"),
        ("part:\n  torque_nm:400\n\n  b: 2", 2, "'torque_nm:400' has no ': ' after the key"),
        ("part:\n  a: 1\nb: 2\n  c: 3", 4, "the indentation is wrong here or in the line above. "
         "All keys of a section start in the same column"),
        ("a: 1\r\u2028torque_nm 400\r\nb: 2", 3, "'torque_nm 400' has no ': '"),
        ("a: it is\n  this: 2", 2, "the indentation is wrong here"),
        ("a: [1", 1, "bracket"),
        ("a: 1\nb", 2, "'b' has no ': ' after the key. Write b: …,"),
        ("a: @x", 1, "quotes"),
        ("a: 1\n---\na: 2", 2, "second document"),
        ("%YAML 1.1\n---\na: 1", 1, "directives"),
        ("a: 1\nn: \x07", 2, "U+0007"),
        ('s: "\\ud800"', 1, "surrogate"),
        ('s: "\\UFFFFFFFF"', 1, "not YAML"),
        ("", 0, "empty"),
        ("# nothing\n", 0, "empty"),
        ("null", 0, "empty"),
        ("[1, 2]", 1, "section"),
        ("just words", 1, "section"),
        ("[" * 5000, 1, "deep"),
        ("options:\n" + "".join(f"  k{i}: [1,1,1,1]\n" for i in range(5000)), 4001, "entries"),
        ("part: {torque: 1}", 1, "did you mean 'torque_nm'?"),
        ("part:\n\n  count: 1", 1, "'torque_nm' is missing (N·m)"),
        ("part:\n  torque_nm: -1", 2, "must be greater than 0, not -1"),
        ("part:\n  torque_nm: 1\n  kind: sting", 3, "did you mean 'string'?"),
        ("part:\n  torque_nm: 1\n  pair: 3", 3, "a list"),
        ("parts:\n  - torque_nm: 1\n  - torque_nm:", 3, "parts[1].torque_nm: has no value"),
        ("options:\n  x: [1]", 2, "must be text or a whole number or a number or true or false, not a list"),
    ],
)
def test_what_is_refused(text: str, line: int, words: str) -> None:
    found = refused(text)
    assert any(at == line and words in message for at, message in found), found
    assert all("\n" not in message for _, message in found)


def test_all_problems_at_once_in_the_order_of_the_file() -> None:
    found = refused("part:\n  torque_nm: 010\n  cuont: 1\n  flag: yes\n  flag: no\nn: 1.5\nzzz: 1\n")
    assert [line for line, _ in found] == [2, 3, 4, 5, 6, 7]


def test_many_problems_are_cut_short() -> None:
    found = refused("part:\n" + "".join(f"  x{i}: 1\n" for i in range(500)))
    assert len(found) == MAX_PROBLEMS + 1
    assert "451 more" in found[-1][1]


def test_nested_aliases_stop_at_the_first_alias() -> None:
    text = "a: &a [x, x]\n" + "".join(f"{n}: &{n} [*{p}, *{p}]\n" for p, n in zip("abcdefg", "bcdefgh", strict=True))
    assert any("alias" in message for _, message in refused(text))


@pytest.mark.parametrize(
    ("content", "line", "words"),
    [
        (b"", 0, "empty"),
        (b"a: 1\ns: \xe4\n", 2, "UTF-8"),
        (b"#" * (MAX_BYTES + 1), 0, "larger than"),
        ("s: µ".encode("utf-16"), 1, "UTF-8"),
    ],
)
def test_files_that_are_no_text(tmp_path: Path, content: bytes, line: int, words: str) -> None:
    path = tmp_path / "f.yaml"
    path.write_bytes(content)
    with pytest.raises(DataFileError) as caught:
        load_model(path, Whole)
    (problem,) = caught.value.problems
    assert (problem.line, problem.file) == (line, str(path))
    assert words in problem.message


def test_missing_files(tmp_path: Path) -> None:
    with pytest.raises(DataFileError, match=r"none\.yaml: no such file"):
        load_model(tmp_path / "none.yaml", Whole)
    with pytest.raises(DataFileError, match="is a directory"):
        load_model(tmp_path, Whole)
    with pytest.raises(DataFileError, match="can't be read"):
        load_model(tmp_path / "a\0b", Whole)


def test_lines_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "f.yaml"
    path.write_text("a: 1\n\npart:\n  count: 2\n  torque_nm: 3\n")
    loaded = load_with_lines(path, Whole)
    assert loaded.lines[("part", "torque_nm")] == 5
    assert loaded.value.part == Part(torque_nm=3.0, count=2)


PIECES = st.sampled_from(
    ["part", "torque_nm", "options", ":", ": ", "\n", "\n  ", "- ", "[", "]", "{", "}", ",", "&a", "*a", "!!", "!x",
     "|", ">", "'", '"', "#", "?", "%YAML", "---", "...", "\\", "010", "1e3", "on", "<<", "~", "\t", ".nan", "0x"]
)


@pytest.mark.heavy
@settings(max_examples=300, deadline=None)
@given(st.one_of(st.text(max_size=80), st.lists(PIECES, max_size=30).map("".join)))
def test_any_text_gives_a_model_or_a_data_file_error(text: str) -> None:
    try:
        assert isinstance(parse_model(text, "f.yaml", Whole), Whole)
    except DataFileError as error:
        assert error.problems
        assert all("\n" not in problem.message and len(problem.message) < 500 for problem in error.problems)


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=80))
def test_any_bytes_give_a_model_or_a_data_file_error(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_bytes(content)
    try:
        load_model(path, Whole)
    except DataFileError as error:
        assert error.problems


@settings(max_examples=200, deadline=None)
@given(st.floats(allow_nan=False, allow_infinity=False), st.integers(-(2**63), 2**63))
def test_every_number_that_python_writes_reads_back(number: float, count: int) -> None:
    found = parse_model(f"a: {number!r}\nn: {count}", "f.yaml", Whole)
    assert (found.a, found.n) == (number, count)
