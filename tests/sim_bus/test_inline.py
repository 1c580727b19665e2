"""Drive in the host's thread: it sends the same frames as over python-can's virtual bus, at once.

The reference is `EmbeddedSimulator` with its thread. A numbered request (6FEh) marks the end of its replies
to a frame.
"""

import random
import struct
import threading
from pathlib import Path

import can
import pytest

from profiles.library import load_canopen_profile
from profiles.simulator_marker import CYCLE_ANSWER, CYCLE_ASKED, CYCLE_ID
from sim_bus.canopen import simulator
from sim_bus.canopen.faults import parse_all
from sim_bus.canopen.inline import InlineSimulator
from sim_bus.canopen.simulator import EmbeddedSimulator

Said = list[tuple[int, bytes]]
TURNING = (
    (0x601, "2306100010270000"), (0x601, "2b17100064000000"), (0x601, "23161001f4017f00"), (0x601, "2f60600009000000"),
    (0x000, "0101"), (0x77F, "05"), *((0x601, f"2b4060000{word}000000") for word in "67f"),
    (0x601, "23ff6000f4010000"),
)


def frame(can_id: int, data: bytes = b"", **more: bool) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False, **more)


def session(seed: int) -> list[can.Message]:
    """Return the frames of a host that turns the shaft and then sends random frames, also invalid ones."""
    rng = random.Random(seed)
    frames = [frame(can_id, bytes.fromhex(data)) for can_id, data in TURNING]
    for _ in range(400):
        kind = rng.random()
        if kind < 0.6:
            frames.append(frame(0x080))
        elif kind < 0.7:
            frames.append(frame(0x201, struct.pack("<Hhi", rng.choice((6, 7, 15, 2)), rng.randrange(-99, 99), 500)))
        elif kind < 0.8:
            frames.append(frame(0x77F, b"\x05"))
        elif kind < 0.9:
            frames.append(frame(0x601, bytes((rng.choice((0x40, 0x23, 0x2F, 0x60, 0xFF)),)) + rng.randbytes(7)))
        elif kind < 0.95:
            frames.append(frame(0x701, b"", is_remote_frame=True))
        elif kind < 0.97:
            frames.append(frame(0x000, bytes((rng.choice((1, 1, 1, 1, 1, 2, 128, 129, 130, 7)), 1))))
        else:
            frames.append(frame(rng.randrange(0x800), rng.randbytes(rng.randrange(9))))
    return [one for one in frames if one.arbitration_id != CYCLE_ID]


def over_the_virtual_bus(frames: list[can.Message], **options: object) -> list[Said]:
    """Return the replies to each frame."""
    answers = []
    simulated = EmbeddedSimulator(seed=5, **options)  # type: ignore[arg-type]
    with can.Bus(interface="virtual", channel=simulated.channel) as bus, simulated:
        for number, one in enumerate([frame(0x7FF), *frames]):
            bus.send(one)
            bus.send(frame(CYCLE_ID, CYCLE_ASKED + bytes((number % 256,))))
            said: Said = []
            while (message := bus.recv(20.0)) is not None:
                if (message.arbitration_id, bytes(message.data)) == (CYCLE_ID, CYCLE_ANSWER + bytes((number % 256,))):
                    break
                said.append((message.arbitration_id, bytes(message.data)))
            assert message is not None
            answers.append(said)
    return answers


def drained(bus: can.BusABC) -> Said:
    said = []
    while (message := bus.recv(0.0)) is not None:
        said.append((message.arbitration_id, bytes(message.data)))
    return said


def inline(frames: list[can.Message], **options: object) -> list[Said]:
    answers = []
    with InlineSimulator(seed=5, **options) as simulated:  # type: ignore[arg-type]
        for one in [frame(0x7FF), *frames]:
            simulated.bus.send(one)
            answers.append(drained(simulated.bus))
    return answers


@pytest.mark.heavy(but_first=3)
@pytest.mark.parametrize(("faults", "worn"), [
    ((), None), ((), "kollmorgen/akd"), ((), "maxon/epos4"), (("frame-loss=20%", "duplicate-frames=20%"), None),
    (("replayed-feedback@1s=1/1s", "emcy@1500ms=7305h"), None), (("bus-dead@1s",), None),
    (("reordered-frames=30%", "foreign-heartbeat=100ms"), None),
])
def test_it_sends_the_same_frames_as_over_the_virtual_bus(
    faults: tuple[str, ...], worn: str | None, tmp_path: Path
) -> None:
    """The frames and the traces are equal."""
    profile = load_canopen_profile(worn) if worn else None
    frames = session(len(faults))
    paths = tmp_path / "virtual.csv", tmp_path / "inline.csv"
    virtual, here = (
        talk(frames, profile=profile, faults=parse_all(faults), trace=path)
        for talk, path in zip((over_the_virtual_bus, inline), paths, strict=True)
    )
    assert here == virtual
    assert here[0][0] == (0x701, b"\0") or faults           # boot-up
    assert sum(map(len, here)) > 40
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_no_thread_is_needed() -> None:
    before = threading.active_count()
    with InlineSimulator() as simulated:
        simulated.bus.send(frame(0x601, b"\x40\x00\x10\x00\0\0\0\0"))
        assert threading.active_count() == before
        assert [can_id for can_id, _ in drained(simulated.bus)] == [0x701, 0x581]
        assert simulated.bus.recv(0.001) is None


def test_every_station_receives_frames_of_the_others_and_of_the_drive() -> None:
    with InlineSimulator() as simulated:
        other = simulated.station()
        simulated.bus.send(frame(0x601, b"\x40\x00\x10\x00\0\0\0\0"))
        assert [can_id for can_id, _ in drained(simulated.bus)] == [0x701, 0x581]
        assert [can_id for can_id, _ in drained(other)] == [0x601, 0x581]
        other.shutdown()
        simulated.bus.send(frame(0x601, b"\x40\x00\x10\x00\0\0\0\0"))
        for act in (lambda: other.send(frame(0x080)), lambda: other.recv(0.0)):
            with pytest.raises(can.CanOperationError, match="closed"):
                act()


def test_a_later_change_of_a_sent_message_has_no_effect() -> None:
    """A later change of it reaches neither the drive, which keeps it until the SYNC, nor a station."""
    with InlineSimulator() as simulated:
        host, other = simulated.bus, simulated.station()
        for can_id, data in TURNING:
            host.send(frame(can_id, bytes.fromhex(data)))
        drained(other)
        for transmission in (0x22, 0x01):       # of RPDO1: synchronous
            host.send(frame(0x601, struct.pack("<BHBI", 0x2F, 0x1400, 2, transmission & 1)))
        drained(other)
        setpoint = frame(0x201, struct.pack("<Hhi", 0x0F, 0, 700))
        host.send(setpoint)
        setpoint.data[:] = bytes(8)
        assert drained(other)[-1] == (0x201, struct.pack("<Hhi", 0x0F, 0, 700))
        host.send(frame(0x080))
        assert simulated.simulator.node.application.controlword == 0x0F


def test_filters_are_kept() -> None:
    with InlineSimulator() as simulated:
        simulated.bus.set_filters([{"can_id": 0x580, "can_mask": 0x780, "extended": False}])
        simulated.bus.send(frame(0x601, b"\x40\x00\x10\x00\0\0\0\0"))
        heard = simulated.bus.recv(5.0)         # past the boot-up message
        assert heard is not None and heard.arbitration_id == 0x581


def fails(error: BaseException):  # type: ignore[no-untyped-def]
    def fail(*_: object) -> None:
        raise error

    return fail


def test_a_failure_is_raised_at_the_end_and_leaves_silence(tmp_path: Path) -> None:
    """`send` does not raise, as with the thread, since the host would assume a fault of its adapter."""
    simulated = InlineSimulator(trace=tmp_path / "shaft.csv")
    with pytest.raises(RuntimeError) as failure, simulated:
        simulated.simulator.node.on_frame = fails(ZeroDivisionError())  # type: ignore[method-assign]
        simulated.bus.send(frame(0x080))
        drained(simulated.bus)
        simulated.bus.send(frame(CYCLE_ID, CYCLE_ASKED + b"\x01"))
        assert drained(simulated.bus) == []
    assert isinstance(failure.value.__cause__, ZeroDivisionError)
    assert "power on" in (tmp_path / "shaft.csv").read_text()


def test_an_error_of_the_host_takes_precedence() -> None:
    with pytest.raises(KeyError), InlineSimulator() as simulated:
        simulated.simulator.node.on_frame = fails(ZeroDivisionError())  # type: ignore[method-assign]
        simulated.bus.send(frame(0x080))
        raise KeyError


def test_a_drive_that_does_not_start() -> None:
    broken = InlineSimulator()
    broken.simulator.node.boot = fails(ZeroDivisionError())  # type: ignore[method-assign]
    with pytest.raises(RuntimeError), broken:
        pass


def test_an_interrupt_within_a_step_is_raised() -> None:
    """After it, no frames are accepted, and the incomplete step is not finished."""
    simulated = InlineSimulator(faults=parse_all(["sto@hold"])).open()
    for can_id, data in TURNING:
        simulated.bus.send(frame(can_id, bytes.fromhex(data)))
    simulated.bus.send(frame(0x080))
    application = simulated.simulator.node.application
    application.step = fails(KeyboardInterrupt())  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        simulated.bus.send(frame(0x080))
    with pytest.raises(can.CanOperationError, match="interrupted"):
        simulated.bus.send(frame(0x080))
    simulated.close()


def test_a_pause_has_no_effect_in_stepped_time_and_counts_in_real_time(monkeypatch: pytest.MonkeyPatch) -> None:
    class Clock:
        now_s = 100.0

        def monotonic(self) -> float:
            return self.now_s

    clock = Clock()
    monkeypatch.setattr(simulator, "time", clock)
    with InlineSimulator() as simulated:
        host = simulated.bus
        for can_id, data in TURNING:
            host.send(frame(can_id, bytes.fromhex(data)))
        host.send(frame(0x080))
        clock.now_s += 60.0
        host.send(frame(0x080))
        assert simulated.simulator.time_s == pytest.approx(0.02)
        host.send(frame(0x601, b"\x2f\xfe\x5f\x02\0\0\0\0"))
        clock.now_s += 0.1
        drained(host)
        host.send(frame(0x701))
        assert simulated.simulator.time_s == pytest.approx(0.12, abs=0.003)
        assert [can_id for can_id, _ in drained(host)] == [0x701]      # the heartbeat during this time
        clock.now_s += 3.0                                             # longer than the host's heartbeat may be missing
        host.send(frame(0x701))
        assert 0x081 in [can_id for can_id, _ in drained(host)]
