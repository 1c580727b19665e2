"""Tests in real time are run again if this computer paused during them, and no other tests are."""

import subprocess
import sys
from pathlib import Path

import pytest

CASES = """
import sys, time
from pathlib import Path
import pytest

@pytest.fixture
def number():
    calls = Path(__file__).with_name("calls.txt")
    with calls.open("a") as file:
        file.write("x")
    yield len(calls.read_text())

def stand_still():
    sys.setswitchinterval(60.0)            # no other thread comes to its turn
    end_s = time.monotonic() + 1.0
    while time.monotonic() < end_s:
        pass
    sys.setswitchinterval(0.005)

@pytest.mark.real_time
def test_one(number):
    WHAT
"""


@pytest.mark.heavy
@pytest.mark.parametrize(("what", "still_s", "calls", "passes"), [
    ("number > 1 or stand_still(); assert number > 1", 0.5, 2, True),
    ("stand_still(); assert False", 0.5, 4, False),
    ("stand_still(); assert False", 1e9, 1, False),        # no pause of the computer
])
def test_a_failure_counts_if_this_computer_did_not_pause(tmp_path, what, still_s, calls, passes):
    conftest = (Path(__file__).parents[1] / "conftest.py").read_text()
    assert "\nSTOOD_STILL_S = 0.5\n" in conftest
    (tmp_path / "conftest.py").write_text(conftest.replace("STOOD_STILL_S = 0.5", f"STOOD_STILL_S = {still_s}"))
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers =\n    real_time\n    heavy\n    long\n")
    (tmp_path / "test_one.py").write_text(CASES.replace("WHAT", what))
    done = subprocess.run([sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", tmp_path], cwd=tmp_path,
                          capture_output=True, text=True, timeout=300)
    assert (done.returncode == 0) is passes, done.stdout
    assert ("1 passed" if passes else "1 failed") in done.stdout
    assert (tmp_path / "calls.txt").read_text() == calls * "x"
    assert (f"{calls - 1} warning" in done.stdout) is (calls > 1), done.stdout
