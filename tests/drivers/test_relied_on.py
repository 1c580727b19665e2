"""Settings that tdhil reads and never writes (scales, filters, required values) are read back in motion, in turn."""

import pytest

from drivers.errors import CommunicationLost
from tests.drivers.drive_benches import CanopenBench, Run
from tests.drivers.ethercat_bench import EthercatBench
from tests.drivers.profile_benches import Epos4Bench, S120Bench

TURN_S = 60.0
"""Longest time until each setting has been read back, s."""


@pytest.fixture
def make(open_bench):
    def make(kind):
        run = Run(open_bench(kind))
        run.ready()
        run.enable()
        return run

    return make


def change(run, index, sub):
    """Change one bit of an object, as a tool at another connector does. Return the former bytes."""
    store = run.bench.simulated.simulator.node.store
    key = index << 8 | sub
    store.live.pop(key, None)
    store.values[key] = store.values[key] + 1


def lost(run):
    with pytest.raises(CommunicationLost) as caught:
        run.go(TURN_S)
    return caught.value


@pytest.mark.parametrize(("kind", "index", "sub", "title"), [
    (Epos4Bench, 0x60A9, 0, "the unit of speed"),
    pytest.param(Epos4Bench, 0x6076, 0, "the rated torque", marks=pytest.mark.heavy),
    pytest.param(Epos4Bench, 0x3001, 5, "Torque constant", marks=pytest.mark.heavy),
    (Epos4Bench, 0x608F, 1, "the scale of the position"),
    (S120Bench, 0x6094, 1, "6094h:1"),
    pytest.param(S120Bench, 0x2198, 0, "p0408", marks=pytest.mark.heavy),
    pytest.param(S120Bench, 0x27D3, 0, "the rated torque", marks=pytest.mark.heavy),
])
def test_a_setting_that_tdhil_relies_on_ends_the_run_when_it_changes(make, kind, index, sub, title):
    run = make(kind)
    run.go(1.0)
    change(run, index, sub)
    error = lost(run)
    assert title in error.what and "was read before motion" in error.what
    assert f"{index:04X}h" in error.where


def test_it_is_never_written(make):
    run = make(Epos4Bench)
    run.bench.heard()
    change(run, 0x60A9, 0)
    lost(run)
    written = [data[1:4] for identifier, data in run.bench.heard() if identifier == 0x601 and data[0] & 0xE0 == 0x20]
    assert bytes.fromhex("a96000") not in written


def test_on_ethercat_too(make):
    run = make(EthercatBench)
    run.bench.slave.drive.data[0x6076, 0] = (2_000_000).to_bytes(4, "little")
    assert "the rated torque was changed" in lost(run).what


def test_a_fault_reaction_that_the_watchdog_uses(open_bench):
    run = Run(open_bench(EthercatBench))
    profile = run.drive._profile
    watchdog = profile.watchdog.model_copy(update={"reaction": "fault_reaction"})
    run.drive._profile = profile.model_copy(update={"watchdog": watchdog})
    assert run.ready().safe_action == "fault_reaction"
    run.enable()
    run.bench.slave.drive.data[0x605E, 0] = bytes(2)
    assert "the fault reaction was changed" in lost(run).what


def test_no_further_request_is_sent_for_them(make):
    """The host sends one request every 0.5 s, as without them. Watchdog and quick stop keep their share."""
    run = make(Epos4Bench)
    run.bench.heard()
    run.go(30.0)
    asked = [data[1:4].hex() for identifier, data in run.bench.heard() if identifier == 0x601]
    assert 58 <= len(asked) <= 62
    assert {"a96000", "766000"} <= set(asked)
    assert 3 * sum(one in ("161001", "076000", "5a6000") for one in asked) >= len(asked) - 3


@pytest.mark.heavy
def test_a_gain_that_is_only_shown_may_change(make):
    """Preflight reads the gains of the speed loop for `tdhil tune speed`. No run depends on them."""
    run = make(CanopenBench)
    change(run, 0x5FFD, 1)
    run.go(TURN_S)
