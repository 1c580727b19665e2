import pytest

SEEDS = list(range(24))


@pytest.fixture(scope="session")
def default_run():
    """Return the default plan on the field-like rig for 24 seeds: rig, motion, plan, true motion."""
    from tests.estimation.planned_motions import planned
    from tests.estimation.shaft_bench import Rig, turn_shaft

    motion, plan = planned()
    rig = Rig()
    return rig, motion, plan, turn_shaft(rig, motion, SEEDS)


@pytest.fixture(scope="session")
def one_recording(default_run):
    from tests.estimation.shaft_bench import recordings

    rig, motion, _, shaft = default_run
    return recordings(rig, motion, shaft, SEEDS[:1])[0]
