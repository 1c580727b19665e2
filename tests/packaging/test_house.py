"""Architecture: import contracts hold, the start is fast, and the tree contains no paths of one computer."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HEAVY = ("numpy", "scipy", "can", "canopen", "rich", "pydantic", "google.protobuf", "mcap", "pymodbus", "yaml")
HOME = re.compile(rb"(?<![\w.~$}/*])/(?:home|Users|root|work)/[\w.]+")
SKIPPED = {"__pycache__", "build", "dist", "site", "node_modules"}


def run(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True, timeout=600)


@pytest.mark.heavy
@pytest.mark.skipif(importlib.util.find_spec("importlinter") is None,
                    reason="import-linter is not installed (pip install '.[lint]'); .ci/run checks the contracts too")
def test_import_contracts_hold():
    check = "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports(cache_dir=None))"
    done = run("-c", check)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 broken" in done.stdout


def test_no_test_imports_a_benchmark():
    line = re.compile(r"^\s*(?:from|import)\s+benchmarks\b", re.MULTILINE)
    found = [path for path in (ROOT / "tests").rglob("*.py") if line.search(path.read_text(encoding="utf-8"))]
    assert found == []


def test_help_lists_the_commands():
    done = run("-m", "tdhil", "--help")
    assert done.returncode == 0
    assert {"identify", "replay", "profiles", "scan", "doctor", "simulate"} <= set(done.stdout.split())
    assert "no emergency stop" in " ".join(done.stdout.split())


def test_help_imports_nothing_heavy():
    script = (
        "import sys\n"
        "from tdhil.cli.main import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        f"print('loaded:', *[name for name in {HEAVY!r} if name in sys.modules])\n"
    )
    done = run("-c", script)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1].split() == ["loaded:"]


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("command", ["identify", "replay", "profiles", "scan", "doctor", "simulate"])
def test_help_of_a_command_is_quick(command):
    done = run("-X", "importtime", "-m", "tdhil", command, "--help")
    assert done.returncode == 0
    imported = {line.rsplit("|", 1)[-1].strip() for line in done.stderr.splitlines() if line.startswith("import time:")}
    assert "argparse" in imported
    assert imported.isdisjoint({"scipy", "canopen", "mcap", "matplotlib"})


def test_the_data_of_a_run_in_a_log_are_read_without_the_virtual_string():
    done = run("-c", "import sys\nfrom tdhil.runner import precondition_warnings, speed_warnings, stage_warnings\n"
                     "print([name for name in sys.modules if name.startswith('tdhil.soft_torque.')])")
    assert done.stdout == "[]\n", done.stderr


@pytest.mark.heavy
def test_identify_needs_no_service_fleet_or_tuning(tmp_path):
    house = tmp_path / "house"
    for room in ("tdhil", "drivers", "sim_bus", "profiles"):
        shutil.copytree(ROOT / room, house / room, ignore=shutil.ignore_patterns("__pycache__"))
    for room in ("service", "fleet", "soft_torque", "speed_loop"):
        shutil.rmtree(house / "tdhil" / room)
    done = subprocess.run(
        [sys.executable, "-m", "tdhil", "identify", "--simulate", "--seed", "7", "--max-time", "150",
         "--report", "report.html", "--json"],
        cwd=house, env=os.environ | {"PYTHONPATH": str(house)}, capture_output=True, text=True, timeout=600,
    )
    assert done.returncode == 0, done.stderr
    interval = json.loads(done.stdout)["inertia_kg_m2"]
    assert interval["low"] < 104.0 < interval["high"]
    assert (house / "report.html").is_file()


def test_no_home_path_is_in_the_tree():
    found = []
    for folder, folders, names in os.walk(ROOT):
        folders[:] = [name for name in folders
                      if name not in SKIPPED and (not name.startswith(".") or name == ".ci")
                      and not name.endswith(".egg-info")]
        for name in names:
            path = Path(folder) / name
            if path.suffix in {".mcap", ".pyc"} or name == ".git" or not path.is_file():
                continue
            found += [f"{path.relative_to(ROOT)}: {hit.decode()}" for hit in HOME.findall(path.read_bytes())]
    assert found == []
