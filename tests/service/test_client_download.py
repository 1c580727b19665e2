"""Download by the client of the service: a file is complete, or there is none."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from drivers import CommunicationLost
from tdhil.errors import UsageError
from tdhil.service.client import Client


@contextmanager
def server(body: bytes, announced: int) -> Iterator[str]:
    """Serve one reply that announces a length and may end before it. Yield its address."""
    listening = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        connection, _ = listening.accept()
        with connection:
            connection.recv(65536)
            connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n" % announced + body)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield f"http://127.0.0.1:{listening.getsockname()[1]}"
    finally:
        thread.join()
        listening.close()


def test_a_whole_file_is_kept(tmp_path):
    target = tmp_path / "run.mcap"
    with server(b"x" * 1000, 1000) as address:
        assert Client(address).download("1", "log.mcap", target) == target
    assert target.stat().st_size == 1000
    with pytest.raises(UsageError, match="not overwritten"):
        Client(address).download("1", "log.mcap", target)


@pytest.mark.parametrize("received", [0, 100, 999])
def test_a_part_of_a_file_is_no_file(tmp_path, received):
    """A service that is restarted: 100 of 1000 bytes were returned as the whole log."""
    target = tmp_path / "run.mcap"
    with server(b"x" * received, 1000) as address, pytest.raises(CommunicationLost, match="only a part of"):
        Client(address).download("1", "log.mcap", target)
    assert not target.exists()
