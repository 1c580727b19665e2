"""Every `--word` in a text of the source is a flag of a command: no text keeps the name of a flag that changed."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROOMS = ("tdhil", "drivers", "sim_bus", "profiles")
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z0-9]*(?:-[a-z0-9]+)*(?![\w-])")
OF_OTHERS = {"--upgrade": "of pip", "--y": "an abbreviation, which no command takes"}


def flags_of(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Yield the flags of a command and of the commands below it."""
    yield from parser._option_string_actions
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for one in action.choices.values():
                yield from flags_of(one)


@pytest.mark.heavy(each_share=True)
def test_every_flag_that_a_text_names_is_declared():
    from sim_bus.command import add_kinds
    from tdhil.cli.main import build_full_parser

    simulator = argparse.ArgumentParser()
    add_kinds(simulator)
    declared = {*flags_of(build_full_parser()), *flags_of(simulator)}
    texts = {path: path.read_text(encoding="utf-8") for room in ROOMS for path in sorted((ROOT / room).rglob("*"))
             if path.suffix in (".py", ".yaml")}
    found = {(path.relative_to(ROOT).as_posix(), flag) for path, text in texts.items() for flag in FLAG.findall(text)}
    assert {one for one in found if one[1] not in declared | OF_OTHERS.keys()} == set()
    assert OF_OTHERS.keys() <= {flag for _, flag in found}
    assert len(declared) > 150


@pytest.mark.parametrize(("text", "flags"), [
    ("add --accept-wider-limit speed", ["--accept-wider-limit"]), ("`--yes`.", ["--yes"]), ("--motion-{name}", []),
    ("the run --accept-… takes", []), ("a -- b, x--y, ---", []),
])
def test_rule_for_flags(text, flags):
    assert FLAG.findall(text) == flags
