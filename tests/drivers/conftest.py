import sys
import time

import pytest


@pytest.fixture
def fake_time(monkeypatch):
    """Fake time in every file of the driver that looks at the clock; nothing outside it notices."""
    import drivers.canopen.drive  # noqa: F401  (all of its files are then loaded)
    from tests.drivers.scripted_drive import FakeTime

    fake = FakeTime()
    for name, module in list(sys.modules.items()):
        if name.split(".")[0] == "drivers" and getattr(module, "time", None) is time:
            monkeypatch.setattr(module, "time", fake)
    return fake


@pytest.fixture
def wire(fake_time):
    """A fake bus with nobody on it."""
    from tests.drivers.scripted_drive import ScriptedBus

    return ScriptedBus(fake_time)


@pytest.fixture
def peer(wire):
    """A scripted drive on the fake bus."""
    from tests.drivers.scripted_drive import ScriptedDrive

    return ScriptedDrive(wire)


@pytest.fixture(scope="session")
def profile():
    from profiles.library import load_canopen_profile

    return load_canopen_profile("generic/cia402")


def _canopen():
    from tests.drivers.drive_benches import CanopenBench

    return CanopenBench


def _modbus():
    from tests.drivers.modbus_bench import ModbusBench

    return ModbusBench


def _epos4():
    from tests.drivers.profile_benches import Epos4Bench

    return Epos4Bench


def _s120():
    from tests.drivers.profile_benches import S120Bench

    return S120Bench


def _abb():
    from tests.drivers.profile_benches import AbbBench

    return AbbBench


def _memory():
    from tests.drivers.memory_bench import MemoryBench

    return MemoryBench


def _ethercat():
    from tests.drivers.ethercat_bench import EthercatBench

    return EthercatBench


MAKERS = {
    "abb-fcan": _abb, "canopen": _canopen, "epos4": _epos4, "ethercat": _ethercat, "memory": _memory,
    "modbus": _modbus, "s120-canopen": _s120,
}


@pytest.fixture(params=[
    # One of each bus at once; the vendors' profiles, which CI tries as well, differ from them by what they declare. So
    # does the drive in memory: EtherCAT's has the same inside.
    pytest.param(name, marks=() if name in ("canopen", "ethercat", "modbus") else pytest.mark.heavy)
    for name in sorted(MAKERS)
])
def make_bench(request):
    """Makes benches of one kind of drive (see drive_benches); a further kind joins the contract by its line above."""
    made = []

    def make(*args, **options):
        made.append(MAKERS[request.param]()(*args, **options))
        return made[-1]

    yield make
    for bench in made:
        bench.close()


@pytest.fixture
def run(make_bench):
    """A run on a quiet rig."""
    from tests.drivers.drive_benches import Run

    return Run(make_bench())
