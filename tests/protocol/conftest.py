import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))     # for fake_drive: tests are imported by path, not as a package


@pytest.fixture
def world():
    """Makes a fake drive with a guard, a log, a stop request and a bench over it."""
    from fake_drive import World

    return World
