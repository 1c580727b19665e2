"""The faults that can be scripted on CANopen: name, row of the fault table, what they do, what their value means."""

import re
from collections.abc import Sequence

from sim_bus import fault_drive as drive
from sim_bus import fault_frames as frames
from sim_bus.fault_hooks import Misbehaviour
from sim_bus.fault_kinds import Kind, factor, listing_of, make_from, parse_from, plain, seconds, share
from sim_bus.fault_script import Scripted

_OBJECT = re.compile(r"(?:0x)?([0-9A-Fa-f]{4})h?(?::([0-9]{1,3}))?")


def _code(text: str) -> int:
    if not re.fullmatch(r"(?:0x)?[0-9A-Fa-f]{4}h?", text):
        raise ValueError("an error code of four hexadecimal digits, such as 7305h")
    return int(text.removeprefix("0x").removesuffix("h"), 16)


def _frames(text: str) -> int:
    if not (text.isdecimal() and 1 <= int(text) <= 100):
        raise ValueError("a number of frames, 1 to 100")
    return int(text)


def _object(text: str) -> tuple[int, int]:
    found = _OBJECT.fullmatch(text)
    if found is None or int(found[2] or 0) > 255:
        raise ValueError("an object, such as 6072h or 1016h:1")
    return int(found[1], 16), int(found[2] or 0)


def _again(text: str) -> bool:
    if text not in ("once", "again"):
        raise ValueError("once or again")
    return text == "again"


def _written(text: str) -> tuple[int, int, int, int]:
    """6072h=100 or 1016h:1=0: object, value, and its size in bytes, as CiA 301 and 402 have it."""
    where, _, value = text.partition("=")
    index, sub = _object(where)
    if not re.fullmatch(r"[0-9]{1,10}|[0-9A-Fa-f]{1,8}h", value):
        raise ValueError("an object and what is written to it, such as 6072h=100")
    number = int(value[:-1], 16) if value.endswith("h") else int(value)
    size = 4 if index in _LONG or 0x1400 <= index < 0x1C00 else 1 if index in _SHORT else 2
    if number >> 8 * size:
        raise ValueError(f"a value of at most {size} bytes")
    return index, sub, number, size


_LONG, _SHORT = {0x1006, 0x1016, 0x6080, 0x6085, 0x60FF}, {0x100D, 0x6060}

KINDS: dict[str, Kind[Misbehaviour]] = {
    "bus-dead": Kind(12, "nothing gets through any more: adapter unplugged, cable cut", plain(frames.Dead)),
    "frame-loss": Kind(17, "this share of all frames is lost, either way",
                       lambda v: frames.Lossy(share(v)), "5%", "SHARE"),
    "duplicate-frames": Kind(18, "this share of the feedback comes twice",
                             lambda v: frames.Doubled(share(v)), "10%", "SHARE"),
    "reordered-frames": Kind(18, "this share of the feedback comes after that of the next cycle",
                             lambda v: frames.Reordered(share(v)), "10%", "SHARE"),
    "frozen-feedback": Kind(19, "the feedback repeats its last values", plain(frames.Frozen)),
    "feedback-lost": Kind(19, "no TPDO comes any more; the heartbeat goes on",
                          plain(lambda: frames.Without(0x180, 0x280))),
    "heartbeat-lost": Kind(20, "the drive's heartbeat ends", plain(lambda: frames.Without(0x700))),
    "node-reset": Kind(21, "the drive restarts (boot-up message); its torque is off, the shaft coasts",
                       plain(drive.Restart)),
    "foreign-nmt-stop": Kind(22, "a third party sends NMT stop", plain(lambda: drive.ForeignNmt(2))),
    "foreign-nmt-preop": Kind(22, "a third party sends NMT pre-operational", plain(lambda: drive.ForeignNmt(128))),
    "emcy": Kind(23, "an emergency message, with the drive still enabled",
                 lambda v: drive.Emcy(_code(v)), "7305h", "CODE"),
    "drive-fault": Kind(23, "emergency message and fault state, after the drive's own fault reaction",
                        lambda v: drive.DriveFault(_code(v)), "3210h", "CODE"),
    "sdo-abort": Kind(24, "the drive aborts every transfer of an object",
                      lambda v: frames.Aborted(*_object(v)), "6072h", "OBJECT"),
    "sdo-timeout": Kind(25, "the drive doesn't answer when asked for an object",
                        lambda v: frames.Unanswered(*_object(v)), "6072h", "OBJECT"),
    "second-master": Kind(26, "another host: from the start the drive is enabled already; later, foreign setpoints",
                          plain(frames.SecondMaster)),
    "duplicate-node": Kind(26, "a second drive answers under the same node ID", plain(frames.SecondNode)),
    "replayed-feedback": Kind(26, "so many frames of a recording, taken at rest, go before each of the drive's own",
                              lambda v: frames.Replayed(_frames(v)), "1", "FRAMES"),
    "foreign-heartbeat": Kind(56, "another node bears the host's number: its heartbeat comes so often",
                              lambda v: frames.ForeignHeartbeat(seconds(v)), "1s", "TIME"),
    "tool-writes": Kind(57, "a tool writes an object by SDO, once",
                        lambda v: frames.ToolWrites(*_written(v)), "1016h:1=0", "OBJECT=VALUE"),
    "setting-changed": Kind(58, "an object is changed at the drive's own panel",
                            lambda v: frames.SettingChanged(*_written(v)[:3]), "6007h=0", "OBJECT=VALUE"),
    "foreign-setpoints": Kind(59, "another master sends setpoints in RPDO4, or switches that on again and again",
                              lambda v: frames.ForeignSetpoints(_again(v)), "once", "once|again"),
    "sdo-master": Kind(60, "another master writes controlword and speed by SDO, in every cycle",
                       plain(frames.SdoMaster)),
    "wrong-identity": Kind(29, "1018h:1, the vendor, is another one",
                           plain(lambda: frames.Otherwise(0x1018, 1))),
    "fault-at-start": Kind(30, "the drive is in fault when the host comes",
                           lambda v: drive.DriveFault(_code(v)), "3210h", "CODE"),
    "stuck-state": Kind(31, "the controlword is ignored", plain(drive.Deaf)),
    "mode-not-followed": Kind(32, "6061h doesn't follow 6060h", plain(drive.ModeKept)),
    "mode-lost": Kind(82, "the drive goes over to mode 3 by itself, and stays there", plain(drive.ModeLost)),
    "sto": Kind(33, "safe torque off: the shaft coasts, and nothing enables the drive", plain(drive.SafeTorqueOff)),
    "internal-limit": Kind(33, "an internal limit leaves this share of the torque",
                           lambda v: drive.LimitedTorque(share(v)), "10%", "SHARE"),
    "load-lost": Kind(34, "the load comes off: this share of inertia and friction is left",
                      lambda v: drive.LoadLost(max(0.001, share(v))), "10%", "SHARE"),
    "encoder-inverted": Kind(36, "the reported speed has the wrong sign", plain(lambda: drive.Reported(speed=-1.0))),
    "write-not-kept": Kind(45, "a write to an object is answered and not kept",
                           lambda v: frames.NotKept(*_object(v)), "6080h", "OBJECT"),
    "reads-back-otherwise": Kind(45, "an object reads back as something else",
                                 lambda v: frames.Otherwise(*_object(v)), "6072h", "OBJECT"),
    "watchdog-not-armed": Kind(50, "the write to 1016h:1 is answered and not kept",
                               plain(lambda: frames.NotKept(0x1016, 1))),
    "torque-scale": Kind(0, "the reported torque is multiplied by this",
                         lambda v: drive.Reported(torque=factor(v)), "1.1", "FACTOR"),
}


def make(fault: Scripted) -> Misbehaviour:
    """What a scripted fault does. Raises FaultRefused for a name or a value that there isn't."""
    return make_from(KINDS, fault)


def parse_all(texts: Sequence[str]) -> tuple[Scripted, ...]:
    """All the faults of a command line, each checked. Raises FaultRefused."""
    return parse_from(KINDS, texts)


def listing() -> str:
    """Every fault with its row and value, for people."""
    return listing_of(KINDS)
