import sys
import time
from functools import partial
from pkgutil import resolve_name

import pytest


@pytest.fixture
def fake_time(monkeypatch):
    """Fake time in every file of the driver that reads the clock; other code is not affected."""
    import drivers.canopen.drive  # noqa: F401  (all of its files are then loaded)
    from tests.drivers.scripted_drive import FakeTime

    fake = FakeTime()
    for name, module in list(sys.modules.items()):
        if name.split(".")[0] == "drivers" and getattr(module, "time", None) is time:
            monkeypatch.setattr(module, "time", fake)
    return fake


@pytest.fixture
def wire(fake_time):
    """Fake bus without any node."""
    from tests.drivers.scripted_drive import ScriptedBus

    return ScriptedBus(fake_time)


@pytest.fixture
def peer(wire):
    """Scripted drive on the fake bus."""
    from tests.drivers.scripted_drive import ScriptedDrive

    return ScriptedDrive(wire)


@pytest.fixture(scope="session")
def profile():
    from profiles.library import load_canopen_profile

    return load_canopen_profile("generic/cia402")


@pytest.fixture
def open_bench():
    """Make benches from a class and its arguments, and close them after the test."""
    from tests.drivers.drive_benches import opened

    with opened() as make:
        yield make


@pytest.fixture
def bench(open_bench):
    """CanopenDrive on the embedded simulator."""
    from tests.drivers.drive_benches import CanopenBench

    return open_bench(CanopenBench)


MAKERS = {
    "abb-fcan": "profile_benches.AbbBench", "canopen": "drive_benches.CanopenBench",
    "epos4": "profile_benches.Epos4Bench", "ethercat": "ethercat_bench.EthercatBench",
    "memory": "memory_bench.MemoryBench", "modbus": "modbus_bench.ModbusBench",
    "s120-canopen": "profile_benches.S120Bench",
}
"""Benches by their module in tests/drivers, which a test loads when it needs it."""


@pytest.fixture(params=[
    # One bench per bus by default. The vendors' profiles, which CI tests too, differ by their declarations only. So
    # does the drive in memory, which is also inside EtherCAT's bench.
    pytest.param(name, marks=() if name in ("canopen", "ethercat", "modbus") else pytest.mark.heavy)
    for name in sorted(MAKERS)
])
def make_bench(request, open_bench):
    """Make benches of one kind of drive (see drive_benches). A line above adds a further kind to the contract tests."""
    return partial(open_bench, resolve_name(f"tests.drivers.{MAKERS[request.param]}"))


@pytest.fixture
def run(make_bench):
    """Run on a rig without noise."""
    from tests.drivers.drive_benches import Run

    return Run(make_bench())
