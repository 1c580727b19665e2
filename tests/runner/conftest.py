import pytest


@pytest.fixture
def world():
    """Makes a fake drive with a guard, a log, a stop request and a bench over it."""
    from tests.runner.fake_drive import World

    return World
