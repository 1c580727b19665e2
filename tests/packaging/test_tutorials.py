"""Tutorials: the commands of the pages are run in order, exactly as printed.

The runs have 50 cycles per second here, a fifth of the usual rate of the drive, to save computing time.
The pages name fixed ports. Each page therefore has its own network, so that no other service uses these ports.
"""

from __future__ import annotations

import contextlib
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.own_network import own_network
from tests.path.path_runs import clean_environment

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "tutorials"
PAGES = sorted(path.name for path in FOLDER.glob("*.md") if path.name != "README.md")
BLOCK = re.compile(r"^(?:<!-- (run[^\n]*) -->\n)?```sh\n(.*?)^```$", re.DOTALL | re.MULTILINE)
PORT = re.compile(r"127\.0\.0\.1:(\d+)|\bport=(\d+)")
PATIENCE_S = 300.0
IN_OTHERS = "read-a-result.md"
"""Tutorial whose two commands, a simulated run and a replay as JSON, are those of the pages on a first run."""


@dataclass(frozen=True)
class Step:
    """Block of a page: run it and expect an exit code, or run it in parallel until ``ready`` is printed."""

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
    """Make a folder with a `tdhil` that runs each identification at 50 Hz."""
    program = folder / "bin" / "tdhil"
    program.parent.mkdir()
    program.write_text(f"""#!/bin/sh
if [ "$1" = identify ]; then set -- "$@" --rate 50; fi
exec '{Path(sys.executable).parent / "tdhil"}' "$@"
""")
    program.chmod(0o755)
    return program.parent


@contextlib.contextmanager
def beside(step: Step, folder: Path, environment: dict[str, str], enter: tuple[str, ...]) -> Iterator[None]:
    """Run a program of the second terminal. ``enter``: command prefix that selects the network of the page."""
    said = folder / "second-terminal.txt"
    with said.open("w") as file:
        child = subprocess.Popen([*enter, "bash", "-euo", "pipefail", "-c", f"exec {step.text}"], cwd=folder,
                                 env=environment, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT)
    try:
        until = time.monotonic() + PATIENCE_S
        while step.ready not in said.read_text() and child.poll() is None and time.monotonic() < until:
            time.sleep(0.1)
        assert step.ready in said.read_text(), said.read_text()
        yield
    finally:
        child.terminate()
        child.wait(PATIENCE_S)


def taken_ports(page: str) -> list[int]:
    """Return the ports of a page that another program on this computer uses."""
    found = {int(one or other) for one, other in PORT.findall((FOLDER / page).read_text(encoding="utf-8"))}
    taken = []
    for port in sorted(found):
        with socket.socket() as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                trial.bind(("127.0.0.1", port))
            except OSError:
                taken.append(port)
    return taken


def test_in_its_own_network_every_port_is_free():
    """A server on this computer holds the port of the service. A program in the other network can still use it."""
    with socket.socket() as server, own_network() as enter:
        server.bind(("127.0.0.1", 0))
        server.listen()
        port = server.getsockname()[1]
        if not enter:
            pytest.skip("this system allows no network namespace")
        trial = (f"import socket; s = socket.create_server(('127.0.0.1', {port})); "
                 f"c = socket.create_connection(('127.0.0.1', {port}), 10); s.accept()[0].send(b'x'); print(c.recv(1))")
        done = subprocess.run([*enter, sys.executable, "-c", trial], capture_output=True, text=True, timeout=60.0)
        assert (done.returncode, done.stdout) == (0, "b'x'\n"), done.stderr


def test_the_ports_of_the_pages_are_found():
    found = {page: sorted({int(one or other) for one, other in PORT.findall((FOLDER / page).read_text("utf-8"))})
             for page in PAGES}
    assert {page: ports for page, ports in found.items() if ports} == {
        "first-run-on-a-drive.md": [29536], "service-in-ten-minutes.md": [8420]}


def test_there_are_tutorials_with_commands():
    assert len(PAGES) == 4
    assert all(steps(page) for page in PAGES)


@pytest.mark.heavy
@pytest.mark.parametrize("page", [
    pytest.param(page, marks=pytest.mark.long if page == IN_OTHERS else ()) for page in PAGES
])
def test_a_tutorial_runs_as_printed(page, tmp_path):
    pytest.importorskip("matplotlib", reason="matplotlib is not installed (pip install '.[report]')")
    pytest.importorskip("uvicorn", reason="uvicorn is not installed (pip install '.[service]')")
    environment = clean_environment()
    programs = (slower(tmp_path), Path(sys.executable).parent, environment.get("PATH", os.defpath))
    environment["PATH"] = os.pathsep.join(map(str, programs))
    with contextlib.ExitStack() as second_terminal:
        enter = second_terminal.enter_context(own_network())
        taken = [] if enter else taken_ports(page)
        assert not taken, f"another program has port {taken}, and this system allows no network namespace"
        for step in steps(page):
            if step.ready is not None:
                second_terminal.enter_context(beside(step, tmp_path, environment, enter))
                continue
            done = subprocess.run([*enter, "bash", "-euo", "pipefail", "-c", step.text], cwd=tmp_path, env=environment,
                                  stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=PATIENCE_S)
            assert done.returncode == step.code, f"{step.text}\n{done.stdout}\n{done.stderr}"
