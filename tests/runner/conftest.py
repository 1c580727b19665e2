import pytest


@pytest.fixture
def world():
    """Return a factory of fake drives, each with a guard, a log, a stop request and a bench."""
    from tests.runner.fake_drive import World

    return World
