"""Peers of other vendors: their requirements, and the skip without them.

The npm packages (all MIT) are fetched on request only, into a chosen folder::

    npm install --prefix DIR canopen@6.2.1 @foxglove/ws-protocol@0.8.0 ws@8
    TDHIL_NPM_CANOPEN=DIR TDHIL_NPM_FOXGLOVE=DIR python -m pytest tests/peers

Without node or that folder the tests are skipped with a reason; TDHIL_REQUIRE_PEERS=1 turns that into a failure.
"""

import os
import shutil
from pathlib import Path

import pytest

PACKAGES = {"TDHIL_NPM_CANOPEN": ("canopen",), "TDHIL_NPM_FOXGLOVE": ("@foxglove/ws-protocol", "ws")}
HOW = ("run them with: npm install --prefix DIR canopen@6.2.1 @foxglove/ws-protocol@0.8.0 ws@8 && "
       "TDHIL_NPM_CANOPEN=DIR TDHIL_NPM_FOXGLOVE=DIR python -m pytest tests/peers")


def what_is_missing(variable):
    """Return why the packages of this variable cannot be used, or None if they can."""
    if shutil.which("node") is None:
        return "node is not on PATH"
    folder = os.environ.get(variable)
    if not folder:
        return f"{variable} names no folder with the npm package {PACKAGES[variable][0]} in it"
    for package in PACKAGES[variable]:
        if not (Path(folder).expanduser() / "node_modules" / package / "package.json").is_file():
            return f"no node_modules/{package} in {folder}"
    return None


def program_of(variable):
    missing = what_is_missing(variable)
    if missing is not None:
        if os.environ.get("TDHIL_REQUIRE_PEERS") == "1":
            pytest.fail(f"{missing}, and TDHIL_REQUIRE_PEERS=1 forbids to skip", pytrace=False)
        pytest.skip(f"{missing}; {HOW}")
    folder = Path(os.environ[variable]).expanduser().resolve()
    return lambda name: (("node", Path(__file__).with_name(name)), {variable: str(folder)})


@pytest.fixture
def node_program():
    """Return the command that runs one of our JavaScript files with the package available."""
    return program_of("TDHIL_NPM_CANOPEN")


@pytest.fixture
def foxglove_program():
    return program_of("TDHIL_NPM_FOXGLOVE")


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(no_bus_of_the_user):
    pass


def pytest_terminal_summary(terminalreporter):
    """Print the reason of the skip, since a quiet run hides it."""
    skipped = [report for report in terminalreporter.stats.get("skipped", ()) if HOW in str(report.longrepr)]
    if skipped:
        missing = ", ".join(filter(None, map(what_is_missing, PACKAGES)))
        terminalreporter.write_line(f"peers: {len(skipped)} tests SKIPPED, {missing}; {HOW}", yellow=True, bold=True)
