"""Rows 12 to 16: faults of the host's adapter, made by a test bus between driver and simulator.

The watchdog of the simulated drive must stop the shaft once no frame reaches it.
"""

import can
import pytest

from sim_bus.canopen.inline import InlineSimulator
from tests.faults.adapter import Adapter
from tests.faults.rehearsal import at

BUS_OFF, CONTROLLER, TX_PASSIVE = 0x40, 0x04, 0x20      # linux/can/error.h
WATCHDOG_S = 0.6


@pytest.fixture
def adapter(rehearse, monkeypatch):
    """Return the bus that the simulator gives to the host."""
    made = []
    plain = InlineSimulator.station

    def station(simulator):
        made.append(Adapter(plain(simulator)))
        return made[-1]

    monkeypatch.setattr(InlineSimulator, "station", station)
    return lambda: made[0]


def run_with(rehearse, monkeypatch, after_s, act, *arguments):
    """Run with a fault that never occurs: the simulator continues after the host only if a fault is scripted."""
    acted = at(monkeypatch, "speed", after_s, act)
    return rehearse("--fault", "bus-dead@9999s", *arguments), acted


def assert_left_to_the_watchdog(run, acted, seen, row, *words):
    run.assert_ended(8, *words)
    standstill_s = run.assert_stopped(acted[0], WATCHDOG_S)
    assert run.shaft.events("host heartbeat lost")
    assert run.shaft.state[-1] == "quick stop active"
    assert "NOT confirmed" in run.done.document["stop"]
    seen(row, run.message, standstill_s, run.assert_log_whole(), run.done.code)


@pytest.mark.heavy
def test_row_12_adapter_unplugged(rehearse, adapter, monkeypatch, seen):
    def act(sample):
        adapter().error = can.CanOperationError("adapter is gone")

    run, acted = run_with(rehearse, monkeypatch, 15.0, act)
    assert_left_to_the_watchdog(run, acted, seen, 12, "adapter is gone", "Check adapter and cable", "watchdog")


@pytest.mark.heavy
def test_row_13_bus_off(rehearse, adapter, monkeypatch, seen):
    """The adapter may recover, but the run transmits no more frames."""
    def act(sample):
        adapter().error_frame(BUS_OFF)
        adapter().sent.clear()

    run, acted = run_with(rehearse, monkeypatch, 15.0, act)
    assert adapter().sent == []
    assert_left_to_the_watchdog(run, acted, seen, 13, "bus-off", "termination", "watchdog")


@pytest.mark.heavy
def test_row_14_error_passive(rehearse, adapter, monkeypatch, seen):
    def act(sample):
        adapter().error_frame(CONTROLLER, TX_PASSIVE)

    run, _ = run_with(rehearse, monkeypatch, 15.0, act, "--max-time", 45)
    stages = dict(run.done.outcomes)
    assert stages["speed"] == "degraded"
    assert stages["torque"] == "ok"
    assert "error-passive. Check bit rate" in run.done.err.replace("\n", " ").replace("  ", " ")
    run.shaft.assert_at_rest()
    seen(14, "the run goes on; warned, and the stage is degraded: the adapter was error-passive", None,
         run.assert_log_whole(), run.done.code)


@pytest.mark.heavy
def test_row_15_transmit_queue_full(rehearse, adapter, monkeypatch, seen):
    def act(sample):
        bus = adapter()
        bus.full = True
        bus.tried.clear()

    run, acted = run_with(rehearse, monkeypatch, 15.0, act)
    assert len(adapter().tried) == 1                  # and stays full
    assert_left_to_the_watchdog(run, acted, seen, 15, "No buffer space", "watchdog")


@pytest.mark.heavy
def test_row_16_a_bus_that_comes_back_with_queued_setpoints(rehearse, adapter, monkeypatch, seen):
    """The queue takes some frames before it is full. They are transmitted after the drive has begun its own stop."""
    late = []

    def full(message):
        bus = adapter()
        if len(bus.queued or ()) >= 10:
            bus.full = True

    def act(sample):
        bus = adapter()
        bus.queued, bus.on_frame = [], full
        tried = len(bus.tried)

        def shut_down(plain=bus.shutdown):
            # The run is over and the drive has stopped the shaft. Now the queue of the kernel is transmitted.
            assert len(bus.tried) - tried <= 12
            late.extend(bus.deliver())
            plain()

        bus.shutdown = shut_down

    run, acted = run_with(rehearse, monkeypatch, 15.0, act)
    run.assert_ended(8)
    assert {message.arbitration_id for message in late} >= {0x201, 0x080}
    (lost_s,) = run.shaft.events("host heartbeat lost")
    assert lost_s - acted[0] <= WATCHDOG_S
    standstill_s = run.assert_stopped(acted[0], WATCHDOG_S)
    enabled = [t for t, state in zip(run.shaft.time_s, run.shaft.state, strict=True) if state == "operation enabled"]
    assert max(enabled) <= lost_s                    # stale controlwords did not enable the drive
    seen(16, f"{len(late)} queued frames reached the drive late: it stays in its own quick stop", standstill_s,
         run.assert_log_whole(), run.done.code)
