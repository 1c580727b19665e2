"""socketcand hub without tdhil clients, in a thread of the test."""

import contextlib
import threading

from sim_bus.canopen.socketcand import Hub


@contextlib.contextmanager
def open_hub():
    """Yield the hub, polled until the end of the block; ``port`` is its port."""
    hub, ended = Hub(), threading.Event()

    def poll():
        while not ended.is_set():
            hub.poll(0.05)

    thread = threading.Thread(target=poll, daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        ended.set()
        thread.join()
        hub.close()
