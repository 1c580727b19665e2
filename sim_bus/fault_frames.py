"""Faults of the bus: frames that are lost, doubled, late, old, or somebody else's."""

from sim_bus.fault_hooks import Frame, Frames, Misbehaviour

SYNC = 0x080
_FIRST_TPDO, _SECOND_TPDO, _HEARTBEAT, _ANSWER, _REQUEST = 0x180, 0x280, 0x700, 0x580, 0x600
_SWITCH_ON_DISABLED = b"\x40\x02"
_AT_REST = b"\x37\x16"        # operation enabled, target reached, speed zero


class Dead(Misbehaviour):
    """Nothing gets through, either way: a cable that is cut, an adapter that is pulled."""

    def outgoing(self, can_id: int, data: bytes) -> Frames:
        return ()

    def incoming(self, can_id: int, data: bytes | bytearray) -> Frames:
        return ()


class Lossy(Misbehaviour):
    """A share of all frames is lost, either way."""

    def __init__(self, share: float) -> None:
        self._share = share

    def outgoing(self, can_id: int, data: bytes) -> Frames:
        return () if self.scene.rng.random() < self._share else ((can_id, data),)

    def incoming(self, can_id: int, data: bytes | bytearray) -> Frames:
        return () if self.scene.rng.random() < self._share else ((can_id, data),)


class Without(Misbehaviour):
    """The drive no longer sends frames of these kinds (the identifier less the node)."""

    def __init__(self, *kinds: int) -> None:
        self._kinds = kinds

    def outgoing(self, can_id: int, data: bytes) -> Frames:
        return () if can_id - self.scene.node.id in self._kinds else ((can_id, data),)


class Doubled(Misbehaviour):
    """A share of the TPDOs comes twice."""

    def __init__(self, share: float) -> None:
        self._share = share

    def outgoing(self, can_id: int, data: bytes) -> Frames:
        twice = can_id == _FIRST_TPDO + self.scene.node.id and self.scene.rng.random() < self._share
        return ((can_id, data),) * (1 + twice)


class Reordered(Misbehaviour):
    """A share of the first TPDO is held back until after that of the next SYNC."""

    def __init__(self, share: float) -> None:
        self._share = share
        self._held: list[Frame] = []

    def end(self) -> None:
        self._held.clear()

    def outgoing(self, can_id: int, data: bytes) -> Frames:
        if can_id != _FIRST_TPDO + self.scene.node.id:
            return ((can_id, data),)
        if self._held:
            held, self._held = self._held, []
            return ((can_id, data), *held)
        if self.scene.rng.random() < self._share:
            self._held.append((can_id, data))
            return ()
        return ((can_id, data),)


class Frozen(Misbehaviour):
    """The TPDOs go on coming, and say what they last said: a gateway that repeats its process image."""

    def __init__(self) -> None:
        self._kept: dict[int, bytes] = {}

    def outgoing(self, can_id: int, data: bytes) -> Frames:
        if can_id - self.scene.node.id not in (_FIRST_TPDO, _SECOND_TPDO):
            return ((can_id, data),)
        return ((can_id, self._kept.setdefault(can_id, data)),)


class Replayed(Misbehaviour):
    """Somebody plays a recording of this drive, enabled and at rest: old TPDOs go before each of the drive's own."""

    def __init__(self, before: int) -> None:
        self._before = before

    def outgoing(self, can_id: int, data: bytes) -> Frames:
        if can_id != _FIRST_TPDO + self.scene.node.id:
            return ((can_id, data),)
        old = _AT_REST + bytes(max(0, len(data) - 2))
        return (*((can_id, old),) * self._before, (can_id, data))


class SecondNode(Misbehaviour):
    """Another drive has the same node ID: it answers too, and shows itself switched off."""

    def begin(self) -> None:
        if self.scene.node.sync_seen:
            self.scene.put(_HEARTBEAT + self.scene.node.id, b"\0")     # it has just been switched on

    def outgoing(self, can_id: int, data: bytes) -> Frames:
        kind = can_id - self.scene.node.id
        if kind == _FIRST_TPDO:
            return (can_id, data), (can_id, _SWITCH_ON_DISABLED + bytes(max(0, len(data) - 2)))
        if kind in (_ANSWER, _HEARTBEAT):
            return (can_id, data), (can_id, data)
        return ((can_id, data),)


class SecondMaster(Misbehaviour):
    """Another host runs the drive: enabled before we come; later its own SYNC and setpoints beside ours."""

    def begin(self) -> None:
        node = self.scene.node
        if not node.sync_seen:
            for word in (0x06, 0x07, 0x0F):
                node.application.write_controlword(word)

    def incoming(self, can_id: int, data: bytes | bytearray) -> Frames:
        node = self.scene.node
        if can_id == SYNC and node.sync_seen:
            self.scene.put(SYNC, b"")
            self.scene.foreign(0x200 + node.id, bytes.fromhex("0f00") + bytes(6))
        return ((can_id, data),)


class ForeignHeartbeat(Misbehaviour):
    """Another node bears the number 127, the host's: its heartbeat comes every so often."""

    def __init__(self, every_s: float) -> None:
        self._every_us = round(1e6 * every_s)
        self._next_us = 0

    def incoming(self, can_id: int, data: bytes | bytearray) -> Frames:
        now_us = self.scene.node.time_us
        if now_us >= self._next_us:
            self._next_us = now_us + self._every_us
            self.scene.foreign(_HEARTBEAT + 127, b"\x05")
        return ((can_id, data),)


class ToolWrites(Misbehaviour):
    """A tool writes one object by SDO, once; everybody on the bus hears it."""

    def __init__(self, index: int, sub: int, value: int, size: int) -> None:
        self._request = bytes((0x23 | (4 - size) << 2,)) + index.to_bytes(2, "little") + bytes((sub,)) + (
            value.to_bytes(4, "little"))

    def begin(self) -> None:
        self.scene.foreign(_REQUEST + self.scene.node.id, self._request)


class SettingChanged(Misbehaviour):
    """One object gets another value from the drive's own panel: nothing of it is on the bus."""

    def __init__(self, index: int, sub: int, value: int) -> None:
        self._key, self._value = index << 8 | sub, value

    def begin(self) -> None:
        self.scene.node.store.write(self._key, self._value)


class ForeignSetpoints(Misbehaviour):
    """Another master sends enable operation and a speed of 500 counts in RPDO4, at each SYNC.

    ``again``: and it switches that RPDO on again, by SDO, whenever it finds it off.
    """

    def __init__(self, again: bool) -> None:
        self._again = again

    def begin(self) -> None:
        self.scene.node.store.write(0x1403 << 8 | 2, 1)        # synchronous: acts beside the host's

    def incoming(self, can_id: int, data: bytes | bytearray) -> Frames:
        node = self.scene.node
        if can_id == SYNC and node.sync_seen:
            if self._again and int(node.store.number(0x1403 << 8 | 1)) >> 31:
                switch_on = bytes.fromhex("23031401") + (0x500 + node.id).to_bytes(4, "little")
                self.scene.foreign(_REQUEST + node.id, switch_on)
            self.scene.foreign(0x500 + node.id, bytes.fromhex("0f00f4010000"))
        return ((can_id, data),)


class SdoMaster(Misbehaviour):
    """Another master writes enable operation and a speed of 500 counts by SDO, after each SYNC."""

    def incoming(self, can_id: int, data: bytes | bytearray) -> Frames:
        node = self.scene.node
        if can_id != SYNC or not node.sync_seen:
            return ((can_id, data),)
        wishes = [(_REQUEST + node.id, bytes.fromhex(one)) for one in ("23ff6000f4010000", "2b4060000f000000")]
        for wish in wishes:
            self.scene.put(*wish)
        return ((can_id, data), *wishes)


class Answers(Misbehaviour):
    """Base of those that meddle with SDO. ``index`` and ``sub`` name the object."""

    def __init__(self, index: int, sub: int) -> None:
        self._object = index.to_bytes(2, "little") + bytes((sub,))

    def _asked(self, can_id: int, data: bytes | bytearray, *commands: int) -> bool:
        """Is it the beginning of a transfer of the object (command specifier 1 download, 2 upload; CiA 301)?"""
        requested = can_id == _REQUEST + self.scene.node.id and len(data) == 8
        return requested and data[0] >> 5 in commands and bytes(data[1:4]) == self._object

    def _answer(self, first: int, rest: bytes = bytes(4)) -> None:
        self.scene.put(_ANSWER + self.scene.node.id, bytes((first,)) + self._object + rest)


class Aborted(Answers):
    """The drive aborts every transfer of the object: 08000020h, data can't be transferred or stored."""

    def incoming(self, can_id: int, data: bytes | bytearray) -> Frames:
        if not self._asked(can_id, data, 1, 2):
            return ((can_id, data),)
        self._answer(0x80, (0x08000020).to_bytes(4, "little"))
        return ()


class Unanswered(Answers):
    """The drive doesn't answer when it is asked for the object."""

    def incoming(self, can_id: int, data: bytes | bytearray) -> Frames:
        return () if self._asked(can_id, data, 1, 2) else ((can_id, data),)


class NotKept(Answers):
    """A write is answered as if it had been taken over; what stood there before goes on standing there."""

    def incoming(self, can_id: int, data: bytes | bytearray) -> Frames:
        if not self._asked(can_id, data, 1):
            return ((can_id, data),)
        self._answer(0x60)
        return ()


class Otherwise(Answers):
    """The object reads as something else: its lowest byte comes with one bit changed."""

    def outgoing(self, can_id: int, data: bytes) -> Frames:
        upload = can_id == _ANSWER + self.scene.node.id and data[0] >> 5 == 2 and data[0] & 2
        if upload and data[1:4] == self._object:
            data = data[:4] + bytes((data[4] ^ 0x04,)) + data[5:]
        return ((can_id, data),)
