"""One owner per drive: among processes, and after any end of the owner."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers import PreflightRefused
from tdhil.cli.main import main
from tdhil.config import resolve
from tdhil.errors import ExitCode, exit_code
from tdhil.session import DriveHeld, address_of, connection_of, drive_lock, hold, holder_of

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no such locks there")

HOLDER = """
import sys, time
from tdhil.session import hold
with hold(sys.argv[1]):
    print("held", flush=True)
    sys.stdin.read()
"""


USED: set[str] = set()


@pytest.fixture(autouse=True)
def leave_no_files() -> Iterator[None]:
    yield
    while USED:
        drive_lock._path(USED.pop()).unlink(missing_ok=True)


@pytest.fixture
def port() -> Iterator[int]:
    """Return a reserved port without a server."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        yield taken.getsockname()[1]


@contextlib.contextmanager
def another_process(address: str) -> Iterator[subprocess.Popen[bytes]]:
    with subprocess.Popen([sys.executable, "-c", HOLDER, address], stdin=subprocess.PIPE,
                          stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"held\n"
        try:
            yield process
        finally:
            process.kill()


def address(port: int, host: str = "127.0.0.1", **more: object) -> str:
    found = given(host=host, port=port, drive="modbus", **more)
    assert found is not None
    return found


def given(**asked: object) -> str | None:
    options, connection = connection_of(asked, None, resolve(asked, None))
    found = address_of(connection, options)
    USED.update({found} - {None})
    return found


def test_a_second_process_is_refused_with_the_owner_and_a_killed_owner_releases_it(port):
    at = address(port)
    assert holder_of(at) is None
    with another_process(at) as process:
        with pytest.raises(DriveHeld) as refused, hold(at):
            pass
        found = holder_of(at)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        assert holder_of(at) is None
        with hold(at):
            assert holder_of(at).pid == os.getpid()
    assert found == refused.value.holder
    assert found.pid == process.pid
    assert found.since.startswith("20")
    assert f"held by process {process.pid} (-c" in str(refused.value)
    assert exit_code(refused.value) is ExitCode.REFUSED


@pytest.mark.skipif(sys.platform != "linux", reason="no names in the kernel there")
def test_a_lock_whose_file_was_removed_holds_all_the_same(port):
    at = address(port)
    with another_process(at) as process:
        drive_lock._path(at).unlink()
        with pytest.raises(DriveHeld, match="the drive is held"), hold(at):
            pass
        process.kill()
        process.wait()
        with hold(at):
            pass


def test_identify_is_refused_while_stop_is_not(port, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    where = ("--host", "localhost", "--port", str(port))
    with another_process(address(port)) as process:
        assert main(["identify", *where, "--yes"]) == ExitCode.REFUSED
        assert f"the drive is held by process {process.pid} (" in capsys.readouterr().err
        # It takes no lock, and fails only because there is no drive.
        assert main(["stop", *where]) == ExitCode.STOP_NOT_CONFIRMED
        assert "held by" not in capsys.readouterr().err


def test_one_process_has_it_once(port):
    with hold(address(port)), pytest.raises(DriveHeld, match=f"process {os.getpid()}"), hold(address(port)):
        pass
    with hold(address(port)):
        pass


def test_another_unit_node_or_bus_is_another_drive(port):
    bus = f"none{port}"                # different in every run of the tests, since locks are global
    with hold(address(port)), hold(address(port, unit=7)), hold(given(interface="socketcan", channel=bus, node=3)):
        with hold(given(interface="socketcan", channel=bus, node=4)):
            pass
        with pytest.raises(DriveHeld), hold(given(interface="socketcan", channel=bus, node=3)):
            pass


def test_one_drive_has_one_address(port, tmp_path):
    assert address(port, host="localhost") == address(port)
    device, link = tmp_path / "ttyUSB0", tmp_path / "by-id"
    device.touch()
    link.symlink_to(device)
    assert given(serial=str(link)) == given(serial=str(device))
    assert "unit 1" in given(serial=str(device))


@pytest.mark.parametrize("asked", [
    {"simulate": True, "interface": "socketcan", "channel": "can0"}, {}, {"interface": "virtual", "channel": "shared"},
])
def test_a_drive_within_the_process_needs_no_lock(asked):
    assert given(**asked) is None
    with hold(None), hold(None):
        pass


@pytest.mark.parametrize("text", ["", "[" * 3000, '{"pid": "x"}', '{"pid": 1e999, "command": 1, "since": 2}', "{}"])
def test_a_lock_file_without_an_owner_still_holds(port, text):
    at = address(port)
    with hold(at):
        drive_lock._path(at).write_text(text)
        with pytest.raises(DriveHeld, match="command line unknown"), hold(at):
            pass


def test_no_lock_is_no_motion(port, monkeypatch, tmp_path):
    monkeypatch.setattr(drive_lock, "FOLDERS", ())
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "missing"))
    with pytest.raises(Exception, match="can't be locked against other programs") as refused, hold(address(port)):
        pass
    assert exit_code(refused.value) is ExitCode.REFUSED


# -- the file of the lock


def files_open() -> int:
    return sum(1 for _ in Path("/proc/self/fd").iterdir())


def test_the_owner_of_a_drive_is_reported_by_command_until_its_end(port, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/some/where/tdhil", "identify", "--note", "two words"])
    at = address(port)
    with hold(at):
        assert holder_of(at).command == "tdhil identify --note 'two words'"
    assert drive_lock._path(at).read_bytes() == b""


def test_all_owners_on_this_computer_are_listed(port, monkeypatch, tmp_path):
    tmp_path.chmod(0o1777)
    monkeypatch.setattr(drive_lock, "FOLDERS", (str(tmp_path),))
    assert drive_lock.holders() == []
    with hold(address(port)), hold(address(port, unit=7)):
        pass
    assert drive_lock.holders() == []
    with hold(address(port)), hold(address(port, unit=7)):
        assert [one.pid for one in drive_lock.holders()] == [os.getpid()] * 2


@pytest.mark.skipif(sys.platform != "linux", reason="counts open files in /proc")
def test_the_file_is_for_every_user_with_any_mask_and_is_opened_once(port, monkeypatch, tmp_path):
    tmp_path.chmod(0o1777)
    monkeypatch.setattr(drive_lock, "FOLDERS", (str(tmp_path),))
    at, before, mask = address(port), files_open(), os.umask(0o077)
    try:
        with hold(at):
            assert drive_lock._path(at).stat().st_mode & 0o777 == 0o666
            assert files_open() <= before + 2          # the file, and the name in the kernel
        assert files_open() == before
    finally:
        os.umask(mask)


def test_a_vanishing_file_or_a_system_without_locks_refuses_motion(port, monkeypatch):
    import fcntl

    at, real = address(port), os.open

    def comes_and_goes(path, flags, mode=0o777, **more):
        if path != drive_lock._path(at):
            return real(path, flags, mode, **more)
        raise FileExistsError(path) if flags & os.O_CREAT else FileNotFoundError(path)

    with monkeypatch.context() as changed:
        changed.setattr(os, "open", comes_and_goes)
        with pytest.raises(PreflightRefused, match="another process creates and removes the file"), hold(at):
            pass

    def no_locks(descriptor, what):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    with pytest.raises(PreflightRefused, match="No locks available"), hold(at):
        pass


def test_a_system_without_such_locks_reports_no_owner(port, monkeypatch):
    at = address(port)
    with hold(at):
        monkeypatch.setattr(sys, "platform", "win32")
        assert holder_of(at) is None
        with hold(at):
            pass
        monkeypatch.undo()
        assert holder_of(at) is not None
