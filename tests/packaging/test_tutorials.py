"""The tutorials can be followed to the letter: their commands are taken out of the pages and run, in order.

A run of theirs has 50 cycles a second here, a fifth of the drive's usual rate, and of what there is to compute.
"""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.path.path_runs import clean_environment

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "tutorials"
PAGES = sorted(path.name for path in FOLDER.glob("*.md") if path.name != "README.md")
BLOCK = re.compile(r"^(?:<!-- (run[^\n]*) -->\n)?```sh\n(.*?)^```$", re.DOTALL | re.MULTILINE)
PATIENCE_S = 300.0
IN_OTHERS = "read-a-result.md"
"""Its two commands, a simulated run and a replay as JSON, are those of the pages on a first run."""


@dataclass(frozen=True)
class Step:
    """A block of a page: run it and expect an exit code, or beside the others until ``ready`` is printed."""

    text: str
    code: int = 0
    ready: str | None = None


def steps(page: str) -> list[Step]:
    found = []
    for mark, text in BLOCK.findall((FOLDER / page).read_text(encoding="utf-8")):
        if beside := re.fullmatch(r"run beside: wait for (.+)", mark):
            found.append(Step(text, ready=beside[1]))
        else:
            code = re.fullmatch(r"run(?:: exit (\d+))?", mark)
            assert code, f"{page}: the block has no mark of how to run it: {text}"
            found.append(Step(text, int(code[1] or 0)))
    return found


def slower(folder: Path) -> Path:
    """Make a folder with a `tdhil` that runs at 50 Hz whatever it identifies."""
    program = folder / "bin" / "tdhil"
    program.parent.mkdir()
    program.write_text(f"""#!/bin/sh
if [ "$1" = identify ]; then set -- "$@" --rate 50; fi
exec '{Path(sys.executable).parent / "tdhil"}' "$@"
""")
    program.chmod(0o755)
    return program.parent


@contextlib.contextmanager
def beside(step: Step, folder: Path, environment: dict[str, str]) -> Iterator[None]:
    """A program of the second terminal."""
    said = folder / "second-terminal.txt"
    with said.open("w") as file:
        child = subprocess.Popen(["bash", "-euo", "pipefail", "-c", f"exec {step.text}"], cwd=folder, env=environment,
                                 stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT)
    try:
        until = time.monotonic() + PATIENCE_S
        while step.ready not in said.read_text() and child.poll() is None and time.monotonic() < until:
            time.sleep(0.1)
        assert step.ready in said.read_text(), said.read_text()
        yield
    finally:
        child.terminate()
        child.wait(60.0)


def test_there_are_tutorials_with_commands():
    assert len(PAGES) == 4
    assert all(steps(page) for page in PAGES)


@pytest.mark.heavy
@pytest.mark.one_worker("tutorials")             # two of them use the same port
@pytest.mark.parametrize("page", [
    pytest.param(page, marks=pytest.mark.long if page == IN_OTHERS else ()) for page in PAGES
])
def test_a_tutorial_can_be_followed_to_the_letter(page, tmp_path):
    pytest.importorskip("matplotlib", reason="matplotlib is not installed (pip install '.[report]')")
    pytest.importorskip("uvicorn", reason="uvicorn is not installed (pip install '.[service]')")
    environment = clean_environment()
    programs = (slower(tmp_path), Path(sys.executable).parent, environment.get("PATH", os.defpath))
    environment["PATH"] = os.pathsep.join(map(str, programs))
    with contextlib.ExitStack() as second_terminal:
        for step in steps(page):
            if step.ready is not None:
                second_terminal.enter_context(beside(step, tmp_path, environment))
                continue
            done = subprocess.run(["bash", "-euo", "pipefail", "-c", step.text], cwd=tmp_path, env=environment,
                                  stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=PATIENCE_S)
            assert done.returncode == step.code, f"{step.text}\n{done.stdout}\n{done.stderr}"
