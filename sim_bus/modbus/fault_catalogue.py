"""The faults that can be scripted on Modbus: name, row of the fault table, what they do, what their value means."""

import re
from collections.abc import Iterable, Sequence

from sim_bus.fault_kinds import Kind, factor, listing_of, make_from, parse_from, plain, share
from sim_bus.fault_script import FaultRefused, Moment, Scripted
from sim_bus.modbus import fault_line as line
from sim_bus.modbus import fault_machine as machine
from sim_bus.modbus.fault_hooks import Misbehaviour
from sim_bus.modbus.wrong_maps import Wrong, parse

WRONGS = {
    "word-order": "word_order", "scale-10": "scale_10", "address-off-by-one": "address_off_by_one", "sign": "sign",
    "unsigned": "unsigned", "write-not-kept": "write_not_applied", "reads-back-otherwise": "reads_back_something_else",
}
"""Faults that are the drive's wiring (`sim_bus.modbus.wrong_maps`): so from the start, for good."""

ONLY_ON = {"wrong-transaction-id": ("tcp",), "reset": ("tcp",), "half-open": ("tcp",), "bad-crc": ("rtu", "embedded")}
"""Lines on which a fault can be, where that isn't all of tcp, rtu and embedded."""

_LINES = {
    "tcp": "tdhil simulate modbus --tcp HOST:PORT", "rtu": "tdhil simulate modbus --rtu",
    "embedded": "tdhil identify --simulate",
}


def _code(text: str) -> int:
    if text not in {"1", "2", "3", "4", "6"}:
        raise ValueError("an exception: 1 function, 2 address, 3 value, 4 failure, 6 busy")
    return int(text)


def _delay_s(text: str) -> float:
    found = re.fullmatch(r"(\d{1,4}(?:\.\d{1,6})?)(m?s)", text)
    if found is None:
        raise ValueError("a time, such as 200ms")
    return float(found[1]) / (1000.0 if found[2] == "ms" else 1.0)


def _celsius(text: str) -> float:
    if not 0.0 <= float(text) <= 300.0:
        raise ValueError("°C, from 0 to 300")
    return float(text)


def _name(text: str) -> Misbehaviour:
    if not re.fullmatch(r"[a-z][a-z0-9_]*", text):
        raise ValueError("a parameter as the profile calls it")
    return Misbehaviour()


def _wiring(summary: str, row: int = 44) -> Kind[Misbehaviour]:
    return Kind(row, summary, plain(Misbehaviour))


KINDS: dict[str, Kind[Misbehaviour]] = {
    "frozen-feedback": Kind(19, "speed and torque read as they last did; what is written goes through",
                            plain(line.Frozen)),
    "drive-fault": Kind(23, "fault state, after the drive's own fault reaction", plain(machine.drive_fault)),
    "fault-at-start": Kind(30, "the drive is in fault when the host comes", plain(machine.drive_fault)),
    "stuck-state": Kind(31, "the control word is ignored", plain(machine.stuck)),
    "mode-not-followed": Kind(32, "the drive stays with speed or torque as it is", plain(machine.mode_kept)),
    "mode-lost": Kind(88, "the drive goes over to regulating speed by itself, and stays there",
                      plain(machine.mode_lost)),
    "sto": Kind(33, "safe torque off: the shaft coasts, and nothing enables the drive",
                plain(machine.safe_torque_off)),
    "internal-limit": Kind(33, "an internal limit leaves this share of the torque",
                           lambda v: machine.limited_torque(share(v)), "10%", "SHARE"),
    "load-lost": Kind(34, "the load comes off: this share of inertia and friction is left",
                      lambda v: machine.load_lost(max(0.001, share(v))), "10%", "SHARE"),
    "hot": Kind(35, "motor and drive become so hot, °C", lambda v: machine.hot(_celsius(v)), "150", "CELSIUS"),
    "encoder-inverted": Kind(36, "the reported speed has the wrong sign", plain(lambda: machine.reported(speed=-1.0))),
    "exception": Kind(38, "every request is answered by this exception and not done: 1 to 4, 6 busy",
                      lambda v: line.Refusing(_code(v)), "4", "CODE"),
    "no-reply": Kind(39, "this share of the requests doesn't get through, and nothing comes back",
                     lambda v: line.NoReply(share(v)), "100%", "SHARE"),
    "late-reply": Kind(40, "every reply comes so late", lambda v: line.Late(_delay_s(v)), "1s", "TIME"),
    "wrong-transaction-id": Kind(41, "this share of the replies bears another transaction (TCP only)",
                                 lambda v: line.WrongTransaction(share(v)), "100%", "SHARE"),
    "bad-crc": Kind(42, "this share of the replies has a wrong CRC (not on TCP; embedded: such a reply is lost)",
                    lambda v: line.BadCrc(share(v)), "100%", "SHARE"),
    "short-reply": Kind(42, "this share of the replies is cut to half", lambda v: line.Short(share(v)), "100%",
                        "SHARE"),
    "reset": Kind(43, "the connection is reset, once (TCP only)", plain(lambda: line.Connection("reset"))),
    "half-open": Kind(43, "the connection is silent from then on, and stays open (TCP only)",
                      plain(lambda: line.Connection("half-open"))),
    "word-order": _wiring("32-bit numbers stand with their halves exchanged"),
    "scale-10": _wiring("every scaled register counts in tenths"),
    "address-off-by-one": _wiring("every register stands one address higher"),
    "sign": _wiring("what is reported of signed registers has the opposite sign"),
    "unsigned": _wiring("signed registers have no sign"),
    "write-not-kept": _wiring("parameters are written without an error, and keep what they had", 45),
    "reads-back-otherwise": Kind(45, "a parameter, as the profile calls it, reads as something else", _name,
                                 "torque_limit", "PARAMETER"),
    "watchdog-not-armed": Kind(50, "the watchdog's time is written without an error, and keeps what it was",
                               plain(machine.NotArmed)),
    "torque-scale": Kind(0, "the reported torque is multiplied by this",
                         lambda v: machine.reported(torque=factor(v)), "1.1", "FACTOR"),
}


def make(fault: Scripted) -> Misbehaviour:
    """What a scripted fault does; nothing where it is the wiring. Raises FaultRefused."""
    return make_from(KINDS, fault)


def parse_all(texts: Sequence[str], line_kind: str) -> tuple[Scripted, ...]:
    """All the faults of a command line, each checked, on ``tcp``, ``rtu`` or ``embedded``. Raises FaultRefused."""
    faults = parse_from(KINDS, texts)
    for fault in faults:
        where = f"--fault {fault.text}"
        lines = ONLY_ON.get(fault.name, tuple(_LINES))
        if line_kind not in lines:
            raise FaultRefused(f"there is no {fault.name} on this line", where=where,
                               next_step=f"Rehearse it with {' or '.join(_LINES[one] for one in lines)}")
        if fault.name in WRONGS and (fault.at != Moment() or "/" in fault.text):
            raise FaultRefused(f"{fault.name} is how the drive is wired: from the start, for good", where=where,
                               next_step="Leave the @ and the / out")
    return faults


def wrongs_of(script: Iterable[Scripted], parameters: Sequence[str]) -> tuple[Wrong, ...]:
    """The wiring that a script asks for. Raises FaultRefused for a parameter that the profile hasn't."""
    wrongs = []
    for fault in script:
        if fault.name not in WRONGS:
            continue
        kind = KINDS[fault.name]
        of = fault.value or kind.value
        if of and of not in parameters:
            raise FaultRefused(f"the profile has no parameter '{of[:40]}'", where=f"--fault {fault.text}",
                               next_step=f"It has: {', '.join(parameters)}")
        wrongs.append(parse(f"{WRONGS[fault.name]}:{of}" if of else WRONGS[fault.name]))
    return tuple(wrongs)


def listing() -> str:
    """Every fault with its row and value, for people."""
    return listing_of(KINDS)
