"""Timing of the line, compared with the rates of serial lines with drives."""

import struct

import pytest

from sim_bus.modbus.embedded import LineTiming
from tests.sim_bus.modbus_host import Host, drive

TURN_AROUND_S = 0.010
READ = struct.pack(">BHH", 3, 16, 4)


def rate_hz(timing: LineTiming, registers: int, written: int = 0) -> float:
    """Return cycles per second with one read of this number of registers, and optionally one write."""
    period_s = transaction_s(timing, 5, 2 + 2 * registers)
    if written:
        period_s += transaction_s(timing, 6 + 2 * written, 5)
    return 1 / period_s


def transaction_s(timing: LineTiming, request: int, reply: int) -> float:
    """Return the time of two PDUs and the silence after the reply."""
    return timing.acts_after_s(request, 0.0) + timing.way_s(reply, 0.0) + timing.silence_s


@pytest.mark.parametrize(("baud", "slow", "fast"), [(19200, 35, 42), (115200, 63, 66), (9600, 21, 27)])
def test_reads_a_second(baud: int, slow: float, fast: float) -> None:
    timing = LineTiming.rtu(baud, TURN_AROUND_S)
    assert 0.975 * slow <= rate_hz(timing, 6) < rate_hz(timing, 2) <= 1.025 * fast


@pytest.mark.parametrize(("baud", "slow", "fast"), [(19200, 18, 20), (115200, 32, 32), (9600, 11, 13)])
def test_cycles_a_second_with_a_write_in_each(baud: int, slow: float, fast: float) -> None:
    timing = LineTiming.rtu(baud, TURN_AROUND_S)
    assert 0.975 * slow <= rate_hz(timing, 4, 3) <= rate_hz(timing, 2, 2) <= 1.025 * fast


@pytest.mark.parametrize("baud", [19200, 115200])
def test_the_embedded_drive_carries_that_rate(baud: int) -> None:
    timing = LineTiming.rtu(baud, TURN_AROUND_S)
    host = Host(drive(timing=timing))
    for _ in range(100):
        host.ask(READ)
    assert 100 / host.now_s == pytest.approx(rate_hz(timing, 4), rel=0.01)


def test_a_transaction_by_hand() -> None:
    """The transaction at 19,200 baud has 8 characters, 3.5 of silence, 10 ms, and 13 characters, each of 11 bits."""
    simulated = drive(timing=LineTiming.rtu(19200, TURN_AROUND_S))
    reply, complete_s = simulated.serve(1, READ, 1.0)
    assert reply is not None and len(reply) == 10
    assert simulated.time_s == pytest.approx(1.0 + 11.5 * 11 / 19200 + 0.010)
    assert complete_s == pytest.approx(1.0 + 24.5 * 11 / 19200 + 0.010)
    _, next_s = simulated.serve(1, READ, complete_s)                # begins 3.5 characters later
    assert next_s == pytest.approx(complete_s + 28 * 11 / 19200 + 0.010)


def test_another_unit_gets_no_reply_and_a_broadcast_is_executed() -> None:
    simulated = drive()
    assert simulated.serve(2, READ, 0.0)[0] is None
    assert simulated.serve(0, struct.pack(">BHH", 6, 38, 77), 0.1)[0] is None
    assert Host(simulated).read(38) == (77,)


def test_a_network_has_latency_and_seeded_jitter() -> None:
    timing = LineTiming.tcp(0.002, 0.0005, 0.0004)

    def ends(seed: int) -> list[float]:
        simulated = drive(timing=timing, seed=seed)
        return [simulated.serve(1, READ, 0.01 * n)[1] - 0.01 * n for n in range(200)]

    took = ends(1)
    assert took == ends(1) != ends(2)
    assert 0.003 <= min(took) < 0.0031 and 0.0037 < max(took) <= 0.0038


def test_the_profile_names_the_line() -> None:
    simulated = drive()
    assert simulated.timing.latency_s > 0 and simulated.timing.turn_around_s == 0.002
    line = simulated.machine._profile.line.model_copy(update={"transports": ("rtu",)})
    assert LineTiming.of(line) == LineTiming.rtu(115200, 0.002)
