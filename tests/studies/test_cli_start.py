"""Start of `tdhil study`: its help is quick, and `tdhil --help` names the command."""

import subprocess
import sys

import pytest


def run(*words):
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, timeout=600)


def test_help_lists_study():
    done = run("-m", "tdhil", "--help")
    assert done.returncode == 0
    assert "study" in done.stdout.split()


def test_help_of_study_imports_nothing_heavy():
    done = run("-X", "importtime", "-m", "tdhil", "study", "--help")
    assert done.returncode == 0
    imported = {line.rsplit("|", 1)[-1].strip() for line in done.stderr.splitlines() if line.startswith("import time:")}
    assert imported.isdisjoint({"numpy", "scipy", "can", "canopen", "matplotlib", "jinja2", "rich", "pydantic"})
    assert "--set" in done.stdout


@pytest.mark.heavy
def test_a_list_needs_neither_bus_nor_pictures():
    done = run("-X", "importtime", "-m", "tdhil", "study", "list")
    assert done.returncode == 0
    imported = {line.rsplit("|", 1)[-1].strip() for line in done.stderr.splitlines() if line.startswith("import time:")}
    assert imported.isdisjoint({"can", "canopen", "matplotlib"})
