"""Peers that are none of ours: what they need, and what happens where it is missing.

The npm package `canopen` (MIT) is fetched only when somebody asks for it, into a folder of his choice::

    npm install --prefix DIR canopen@6.2.1
    TDHIL_NPM_CANOPEN=DIR python -m pytest tests/peers

Without node or that folder the tests are skipped and say so; TDHIL_REQUIRE_PEERS=1 turns that into a failure.
"""

import os
import shutil
from pathlib import Path

import pytest

HOW = ("run them with: npm install --prefix DIR canopen@6.2.1 && TDHIL_NPM_CANOPEN=DIR python -m pytest tests/peers")


def what_is_missing():
    """Why the package can't be used, or None if it can."""
    if shutil.which("node") is None:
        return "node is not on PATH"
    folder = os.environ.get("TDHIL_NPM_CANOPEN")
    if not folder:
        return "TDHIL_NPM_CANOPEN names no folder with the npm package canopen in it"
    if not (Path(folder).expanduser() / "node_modules" / "canopen" / "package.json").is_file():
        return f"no node_modules/canopen in {folder}"
    return None


@pytest.fixture
def node_program():
    """The command that runs one of our JavaScript files with the package at hand."""
    missing = what_is_missing()
    if missing is not None:
        if os.environ.get("TDHIL_REQUIRE_PEERS") == "1":
            pytest.fail(f"{missing}, and TDHIL_REQUIRE_PEERS=1 forbids to skip", pytrace=False)
        pytest.skip(f"{missing}; {HOW}")
    folder = Path(os.environ["TDHIL_NPM_CANOPEN"]).expanduser().resolve()
    return lambda name: (("node", Path(__file__).with_name(name)), {"TDHIL_NPM_CANOPEN": str(folder)})


@pytest.fixture(autouse=True)
def no_bus_of_the_user(monkeypatch, tmp_path):
    for name in [name for name in os.environ if name.startswith("CAN_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)


def pytest_terminal_summary(terminalreporter):
    """A quiet run hides the reasons of skipped tests; this one must be seen."""
    skipped = [report for report in terminalreporter.stats.get("skipped", ()) if HOW in str(report.longrepr)]
    if skipped:
        terminalreporter.write_line(
            f"peers: {len(skipped)} tests SKIPPED, {what_is_missing()}; {HOW}", yellow=True, bold=True
        )
