"""Content of the wheel, built with the installed hatchling, without a network."""

from __future__ import annotations

import configparser
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.one_worker      # its fixture is expensive

ROOT = Path(__file__).parents[2]
PACKAGES = ("tdhil", "drivers", "sim_bus", "profiles")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> zipfile.ZipFile:
    """Build the wheel of a copy of the tree, since the build backend reads .gitignore and may write beside it."""
    source, out = tmp_path_factory.mktemp("source") / "tdhil", tmp_path_factory.mktemp("dist")
    source.mkdir()
    for name in (".gitignore", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    junk = shutil.ignore_patterns("__pycache__", ".*_cache", "*.egg-info")
    for name in (*PACKAGES, "tests", "examples", "deploy", "docs", "benchmarks"):
        shutil.copytree(ROOT / name, source / name, ignore=junk)
    (source / "tdhil" / "forgotten.mcap").touch()
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), str(source)]
    done = subprocess.run(build, capture_output=True, text=True, timeout=300, env=os.environ | {"PIP_NO_INDEX": "1"})
    assert done.returncode == 0, done.stdout + done.stderr
    (path,) = out.glob("tdhil-*.whl")
    return zipfile.ZipFile(path)


@pytest.fixture(scope="module")
def names(wheel) -> set[str]:
    return set(wheel.namelist())


@pytest.mark.heavy
def test_pure_python_for_every_platform(wheel):
    assert wheel.filename is not None
    assert wheel.filename.endswith("-py3-none-any.whl")


def test_four_packages_and_nothing_else_at_the_top(names):
    tops = {name.split("/")[0] for name in names}
    (info,) = [top for top in tops if top.endswith(".dist-info")]
    assert tops - {info} == set(PACKAGES)
    assert f"{info}/licenses/LICENSE" in names


@pytest.mark.parametrize("package", PACKAGES)
def test_every_module_and_every_data_file_is_included(package, names):
    wanted = {str(path.relative_to(ROOT)) for path in (ROOT / package).rglob("*")
              if path.suffix in {".py", ".yaml", ".eds", ".typed", ".po"} and "__pycache__" not in path.parts}
    assert f"{package}/__init__.py" in wanted
    assert f"{package}/py.typed" in wanted
    assert wanted - names == set()


def test_profiles_come_with_their_eds(names):
    assert {"profiles/generic/cia402.yaml", "profiles/generic/cia402.eds"} <= names


def test_documentation_and_examples_are_included(names):
    wanted = {"tdhil/_docs/README.md"}
    wanted |= {f"tdhil/_docs/{path.relative_to(ROOT).as_posix()}" for path in (ROOT / "docs").rglob("*.md")}
    wanted |= {f"tdhil/_docs/{folder}/{path.name}" for folder in ("examples", "deploy")
               for path in (ROOT / folder).iterdir()}
    assert wanted - names == set()


def test_no_development_files_are_included(names):
    assert [name for name in names if name.endswith((".mcap", ".pyc")) or "tests" in name.split("/")] == []


def test_entry_point(wheel, names):
    (path,) = [name for name in names if name.endswith(".dist-info/entry_points.txt")]
    parser = configparser.ConfigParser()
    parser.read_string(wheel.read(path).decode())
    assert dict(parser["console_scripts"]) == {"tdhil": "tdhil.__main__:console"}


@pytest.mark.heavy
def test_it_runs_from_the_wheel_alone(wheel, tmp_path):
    wheel.extractall(tmp_path)
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import tdhil; "
        f"assert tdhil.__file__.startswith({str(tmp_path)!r}), tdhil.__file__; "
        "from profiles.library import load_profile; from sim_bus.objects import generic_eds; "
        "from tdhil.cli.docs import docs_folder; "
        "print(load_profile('generic/cia402').name, generic_eds(), docs_folder())"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [
        "generic/cia402", str(tmp_path / "profiles" / "generic" / "cia402.eds"), str(tmp_path / "tdhil" / "_docs")
    ]
