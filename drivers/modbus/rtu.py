"""Modbus over a serial line (RTU): one master, frames separated by length, CRC and silence.

pymodbus makes the frames and computes the CRC. Its synchronous client is not used: it drops a reply with a wrong CRC
silently, accepts a reply of any function, and does not wait for a late one (`FramerRTU.decode`,
`FramerBase.handleFrame`, 3.16).

RTU has no transaction id. So after a missing reply tdhil listens to the line before the next request, and accepts the
next reply only if no second one follows it.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import os
from pathlib import Path
from typing import Any, Literal

from pymodbus.framer import FramerRTU
from pymodbus.pdu import DecodePDU

from drivers.clock import Clock
from drivers.errors import PreflightRefused
from drivers.modbus.link import Reply
from drivers.modbus.pdu import BadReply, LinkLost, NoisyReply, NoReply, answers, reply_length
from profiles import MessageCode

# ---------------------------------------------------------------------------------------------------------------------
# Reason why a serial device could not be opened, and the command that repairs it.


_CANDIDATES = ("ttyUSB*", "ttyACM*", "ttyAMA*", "ttyS[0-3]")


def refusal(device: str, error: OSError | ValueError) -> PreflightRefused:
    """Convert an error of pyserial to an error with a next step."""
    code = getattr(error, "errno", None)
    if code is None and error.__context__ is not None and error.__context__.args:
        code = error.__context__.args[0]        # termios.error, which pyserial wraps without its number
    if code == errno.ENOENT:
        what, step = "the device does not exist", f"Plug the adapter in. {_there()}"
    elif code in (errno.EACCES, errno.EPERM):
        what, step = "permission denied", permission_command(device)
    elif code in (errno.EBUSY, errno.EAGAIN):
        what, step = "another program uses it", f"End that program. Find it with: fuser {device}"
    elif code in (errno.ENOTTY, errno.EISDIR):
        what, step = "it is not a serial device", _there()
    else:
        what, step = str(error), "Check device, baud rate and parity"
    return PreflightRefused(f"can't open the serial line: {what}", where=device, next_step=step,
                            entry=MessageCode.SERIAL_LINE_REFUSED)


def permission_command(device: str) -> str:
    """Return the command that adds this user to the device's group."""
    group = "dialout"
    try:
        import grp

        group = grp.getgrgid(Path(device).stat().st_gid).gr_name
    except (ImportError, OSError, KeyError):
        pass
    if group == "root":
        return f"Only root may use it. Until the next restart: sudo chmod a+rw {device}"
    return f"sudo usermod -a -G {group} {os.environ.get('USER', '$USER')}, then log out and in again"


def _there() -> str:
    found = sorted(str(path) for pattern in _CANDIDATES for path in Path("/dev").glob(pattern))
    return f"Serial devices found: {', '.join(found)}" if found else "No serial device was found"


# ---------------------------------------------------------------------------------------------------------------------

CHARACTER_BITS = 11
SILENT_CHARACTERS = 3.5
LEAST_SILENCE_S = 0.00175
"""Least silence between frames, s, above 19,200 baud (Modbus over serial line V1.02, section 2.5.1.1)."""
QUIET_S = 0.02
"""A line without data for this time, s, has finished; adapters deliver data in blocks."""
LISTEN_SHARE, LONGEST_LISTEN_S = 0.5, 0.25
"""Wait for a late reply before the next request: share of its time-out, and upper limit, s."""
SLICE_S = 0.005
UNIT_AND_CRC = 3


class RtuLink:
    """A serial device; opens it at once. Raises PreflightRefused if that fails."""

    def __init__(
        self, device: str, clock: Clock, *, baud: int = 19200, parity: Literal["N", "E", "O"] = "E",
        stop_bits: Literal[1, 2] = 1,
    ) -> None:
        self.clock = clock
        self.description = f"{device}, {baud} baud 8{parity}{stop_bits}"
        self.late = 0
        self._framer = FramerRTU(DecodePDU(False))
        self._silence_s = max(SILENT_CHARACTERS * CHARACTER_BITS / baud, LEAST_SILENCE_S)
        self._quiet_from_s = 0.0
        self._listen_s = 0.0        # listening time before the next request, s; 0: in step
        self._owed = False          # a reply is outstanding that may yet come
        self._usual_s = 0.0         # longest time of a valid reply
        self._lost = ""
        try:
            serial: Any = importlib.import_module("serial")
        except ImportError as error:
            raise PreflightRefused(
                "serial lines need pyserial, which isn't installed", where=device, next_step="pip install pyserial",
                entry=MessageCode.SERIAL_LINE_REFUSED,
            ) from error
        try:
            self._port: Any = serial.Serial(
                device, baudrate=baud, parity=parity, stopbits=stop_bits, timeout=SLICE_S, write_timeout=1.0,
                exclusive=True if os.name == "posix" else None,
            )
        except (OSError, ValueError) as error:
            raise refusal(device, error) from error

    def transact(self, unit: int, pdu: bytes, timeout_s: float) -> Reply:
        """Send one request and return its reply. A late reply is dropped before the next request, and counted."""
        if self._lost:
            raise self._gone(self._lost)
        self._come_into_step()
        self.clock.wait_until(self._quiet_from_s)
        sent_s = self.clock.now_s()
        deadline_s = sent_s + timeout_s
        try:
            self._port.write(self._framer.encode(pdu, unit, 0))
        except Exception as error:      # any type of error, from pyserial or the driver below it
            raise self._gone(str(error)) from error
        try:
            reply = self._await(unit, pdu, deadline_s)
            received_s = self.clock.now_s()
            if self._owed:
                reply, received_s = self._doubt(reply, received_s, unit, pdu)
        except (NoReply, BadReply) as error:
            self._owed = isinstance(error, NoReply)
            # A complete damaged reply leaves nothing outstanding: the line is in step once it is quiet.
            whole = isinstance(error, NoisyReply)
            self._listen_s = QUIET_S if whole else min(max(LISTEN_SHARE * timeout_s, QUIET_S), LONGEST_LISTEN_S)
            raise
        finally:
            self._quiet_from_s = self.clock.now_s() + self._silence_s
        self._usual_s = max(self._usual_s, received_s - sent_s)
        return Reply(reply, sent_s, received_s)

    def close(self) -> None:
        """Close the device and discard unsent data."""
        with contextlib.suppress(Exception):
            self._port.reset_output_buffer()
        with contextlib.suppress(Exception):
            self._port.close()
        self._lost = self._lost or "it is closed"

    # -- frames ----------------------------------------------------------------------------------------------

    def _await(self, unit: int, pdu: bytes, deadline_s: float) -> bytes:
        """Return the reply PDU. Raises NoReply, BadReply and LinkLost."""
        frame = b""
        while True:
            wanted = self._length(frame)
            if wanted is not None and len(frame) >= wanted:
                whole = frame[:wanted]
                if not self._framer.check_CRC(whole[:-2], int.from_bytes(whole[-2:], "big")):
                    bad = self._bad(f"a reply with a wrong CRC: {_shown(frame)}")
                    raise NoisyReply(bad.what, where=bad.where, next_step=bad.next_step)
                reply = frame[1 : wanted - 2]
                if frame[0] == unit and answers(pdu, reply) and len(frame) == wanted:
                    return reply
                if not self._owed:
                    raise self._bad(f"a reply of unit {frame[0]}, function {reply[0]} to unit {unit}, {pdu[0]}")
                # Valid, but to the earlier request whose time has passed.
                self._owed = False
                self.late += 1
                frame = frame[wanted:]
                continue
            if len(frame) >= 2 and wanted is None and len(frame) > 2:
                raise self._bad(f"the received bytes are not a reply: {_shown(frame)}")
            if self.clock.now_s() >= deadline_s:
                if frame:
                    raise self._bad(f"a short reply: {_shown(frame)}")
                raise NoReply(
                    "no reply in time", where=self.description,
                    next_step="Check unit number, baud rate, parity and the two wires' polarity",
                )
            frame += self._read()

    def _doubt(self, reply: bytes, received_s: float, unit: int, pdu: bytes) -> tuple[bytes, float]:
        """Wait for a second reply while one is outstanding. If one follows, it is the right one."""
        until_s = received_s + max(self._usual_s, QUIET_S)
        try:
            second = self._await(unit, pdu, until_s)
        except NoReply:
            second = b""
        if not second:
            self._owed = False
            return reply, received_s
        self._owed = False
        self.late += 1
        return second, self.clock.now_s()

    def _come_into_step(self) -> None:
        """Discard late data, and wait for a reply that may still come.

        On a line that is never quiet the wait ends too: a request that may collide is better than a stop that is never
        sent.
        """
        try:
            late = bool(self._port.in_waiting)
        except Exception as error:      # any type of error, as in `transact`
            raise self._gone(str(error)) from error
        if not late and not self._listen_s:
            return
        until_s = self.clock.now_s() + self._listen_s
        give_up_s = until_s + LONGEST_LISTEN_S
        heard_s = self.clock.now_s() if late else None
        while (heard_s is not None or self.clock.now_s() < until_s) and self.clock.now_s() < give_up_s:
            if self._read():
                late, heard_s = True, self.clock.now_s()
            elif heard_s is not None and self.clock.now_s() - heard_s >= QUIET_S:
                break
        self.late += late
        self._owed = self._owed and not late
        self._listen_s = 0.0

    def _length(self, frame: bytes) -> int | None:
        length = reply_length(frame[1:])
        return None if length is None else length + UNIT_AND_CRC

    # -- the device ------------------------------------------------------------------------------------------

    def _read(self) -> bytes:
        """Return the data received within one time slice."""
        try:
            return bytes(self._port.read(max(1, int(self._port.in_waiting))))
        except Exception as error:      # any type of error, as in `transact`
            raise self._gone(str(error)) from error

    def _gone(self, what: str) -> LinkLost:
        self._lost = what
        return LinkLost(
            f"the serial line is lost: {what}",
            where=self.description,
            next_step="Is the adapter plugged in? The drive's own watchdog stops the shaft. Then start again",
        )

    def _bad(self, what: str) -> BadReply:
        step = "Check baud rate, parity, shielding and termination, and that no second master is on the line"
        return BadReply(what, where=self.description, next_step=step)


def _shown(frame: bytes) -> str:
    """Return the start of a frame for a message."""
    return f"{frame[:16].hex(' ')}{' …' if len(frame) > 16 else ''}"
