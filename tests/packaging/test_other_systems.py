"""Imports need no module that Windows or macOS lacks: such modules are imported at their use only.

The tests mask these modules on this system. They include no run on those systems.
"""

from __future__ import annotations

import subprocess
import sys

import pytest

from tdhil.session.log_files import LogPlace, is_live

_SCRIPT = """
import importlib, os, pkgutil, select, signal, socket, sys

OURS = ("profiles", "drivers", "sim_bus", "tdhil")


def walk():
    for name in OURS:
        package = importlib.import_module(name)
        yield name
        for one in pkgutil.walk_packages(package.__path__, name + "."):
            if not one.name.endswith("__main__"):
                importlib.import_module(one.name)
                yield one.name


first = list(walk())                      # so that what others import is loaded, and only our own imports are tried
for name in [name for name in sys.modules if name.split(".")[0] in OURS]:
    del sys.modules[name]
for name in ("fcntl", "termios", "tty", "pty", "grp", "pwd", "resource", "syslog"):
    sys.modules[name] = None              # as on Windows: ImportError
for module, names in (
    (signal, ("SIGHUP", "SIGQUIT", "SIGUSR1", "SIGUSR2", "SIGKILL", "SIGSTOP", "SIGCONT", "SIGALRM", "setitimer",
              "pthread_sigmask")),
    (os, ("fork", "getuid", "geteuid", "getgid", "getgroups", "openpty", "sched_setscheduler", "sched_getaffinity",
          "sched_param", "SCHED_FIFO", "SCHED_OTHER", "SCHED_RESET_ON_FORK", "uname", "statvfs", "O_NONBLOCK",
          "O_NOCTTY", "O_DIRECTORY", "O_CLOEXEC", "nice", "getloadavg", "killpg")),
    (socket, ("AF_UNIX", "AF_CAN", "CAN_RAW", "AF_NETLINK", "SO_REUSEPORT", "SO_TIMESTAMP")),
    (select, ("poll", "epoll")),
):
    for name in names:
        if hasattr(module, name):
            delattr(module, name)
assert list(walk()) == first
print(len(first))
"""


@pytest.mark.heavy
def test_everything_is_imported_without_posix_modules():
    done = subprocess.run([sys.executable, "-c", _SCRIPT], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 200


@pytest.fixture
def no_posix(monkeypatch):
    for name in ("fcntl", "termios", "tty", "resource", "grp"):
        monkeypatch.setitem(sys.modules, name, None)


def test_a_log_finds_its_place_without_locks(no_posix, tmp_path, monkeypatch):
    for _ in range(2):
        place = LogPlace(tmp_path / "run.mcap")
        place.open(place.wanted).close()
    assert place.older is not None
    assert len(list(tmp_path.iterdir())) == 2

    def in_use(self, target):      # Windows renames no open file
        raise PermissionError(13, "in use")

    monkeypatch.setattr("pathlib.Path.rename", in_use)
    assert is_live(tmp_path / "run.mcap")
    other = LogPlace(tmp_path / "run.mcap")
    other.open(other.wanted).close()
    assert other.live
    assert other.path != tmp_path / "run.mcap"


def test_a_simulated_serial_line_is_refused_with_a_reason(no_posix):
    from profiles.errors import TdhilError
    from sim_bus.modbus.lines import RtuListener

    with pytest.raises(TdhilError, match=r"--rtu: this system has no serial lines.*Use --tcp"):
        RtuListener(None, baud=19200, parity="E", stop_bits=1)


def test_missing_signals_of_a_system_are_omitted(monkeypatch):
    import signal

    from tdhil.session.stop_signals import stop_on_signals

    for name in ("SIGHUP", "SIGQUIT"):
        monkeypatch.delattr(signal, name, raising=False)
    with stop_on_signals() as request:
        assert request is not None


def test_the_hint_installs_from_the_source_of_this_installation(monkeypatch, tmp_path):
    from tdhil import version
    from tdhil.report.page import install_command

    assert "-m pip install -e " in install_command()
    assert "[report]" in install_command()
    monkeypatch.setattr(version, "__file__", str(tmp_path / "site-packages" / "tdhil" / "version.py"))
    command = install_command()
    assert "matplotlib" in command
    assert "jinja2" in command
    assert "tdhil[report]" not in command
