"""Bounds the time for which python-can's ``send`` may block: an adapter that takes no frames must not stop the loop.

python-can documents that ``send`` without a timeout may block without end. Read in python-can 4.6:

```text
   interface                            without a timeout                          here
   ----------------------------------   ----------------------------------------   ------------------------------------
   slcan, robotell                      serial write and flush block without end   both end after `SEND_S`
   serial, seeedstudio                  serial write blocks without end            it ends after `SEND_S`
   socketcand                           TCP send blocks while its buffer is full   it ends after `SEND_S`
   gs_usb                               USB write ends after 1 s (pyusb)           as it is
   socketcan, pcan, kvaser, ixxat ...   raises at once if the queue is full        as it is
```

A timeout is not given to the others: kvaser and ixxat would then wait for each frame to be on the bus. After a send
that was ended, a part of a frame may be in the adapter. So nothing more is sent, and the drive's own watchdog stops the
shaft.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import can

SEND_S = 0.1
"""Longest time for one frame, s of wall time, as for one answer in motion (`drivers.cia402.polling.ANSWER_S`)."""
FLUSH_PAUSE_S = 0.0002
"""Time between two looks at a serial port's buffer, s: less than one frame takes at 1 Mbit/s."""
_PORTS = ("serialPortOrig", "ser", "_ser")
"""Attributes with the serial port: slcan and robotell, seeedstudio, serial."""
_SOCKET = "_SocketCanDaemonBus__socket"


def bound_send(bus: can.BusABC) -> dict[str, float]:
    """Bound the time of ``bus.send``. Return the arguments that each call needs; empty if it is not bounded here."""
    connection = getattr(bus, _SOCKET, None)
    if connection is not None:
        connection.settimeout(SEND_S)      # a read waits for data first, so this bounds the send alone
        return {"timeout": SEND_S}
    port = next((found for name in _PORTS if (found := getattr(bus, name, None)) is not None), None)
    if port is None:
        return {}
    port.write_timeout = SEND_S
    if hasattr(type(port), "out_waiting"):
        port.flush = lambda: _flush(port)
    return {"timeout": SEND_S}


def _flush(port: Any) -> None:
    """Wait until the port's buffer is empty. Raises TimeoutError after `SEND_S`; the port's own flush has no end."""
    end_s = time.monotonic() + SEND_S
    while port.out_waiting:
        if time.monotonic() > end_s:
            raise TimeoutError(f"{port.out_waiting} bytes were not sent within {SEND_S:g} s")
        time.sleep(FLUSH_PAUSE_S)
