"""Socket between web server and run: no client delays another one."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from tdhil.service.run_channel import SOCKET, ChannelListener, ask
from tests.service.conftest import HANGS_S, wait_for


@pytest.fixture
def listener(tmp_path: Path) -> Iterator[ChannelListener]:
    with ChannelListener(tmp_path, lambda asked: {"heard": asked.get("number")}) as found:
        yield found


@pytest.fixture
def folder(tmp_path: Path, listener: ChannelListener) -> Path:
    return tmp_path


def threads() -> int:
    return sum(one.name == "control" for one in threading.enumerate())


def silent(folder: Path) -> socket.socket:
    """Connect a client that sends nothing."""
    found = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    found.connect(str(folder / SOCKET))
    return found


def test_an_existing_thread_replies_to_a_request(folder, listener, monkeypatch):
    begun: list[str] = []
    monkeypatch.setattr(listener, "_begin", lambda: begun.append("a thread"))
    for number in range(20):
        wait_for("a spare thread", lambda: listener._idle == ChannelListener.SPARE)
        assert ask(folder, {"number": number}, timeout_s=HANGS_S) == {"heard": number}
    assert begun == []


def test_silent_clients_delay_no_other_client_and_their_threads_end(folder):
    before = threads()                     # including those of other tests
    silent_ones = [silent(folder) for _ in range(10)]
    for number in range(5):
        assert ask(folder, {"number": number}, timeout_s=HANGS_S) == {"heard": number}
    assert threads() >= before + 10 - ChannelListener.SPARE + 1
    for one in silent_ones:
        one.close()
    wait_for("their end", lambda: threads() <= before)
    assert ask(folder, {"number": 7}, timeout_s=HANGS_S) == {"heard": 7}
