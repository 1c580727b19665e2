import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))     # for log_runs: tests are imported by path, not as a package


@pytest.fixture(scope="session")
def whole(tmp_path_factory):
    """A finished run of 1000 cycles (4 s)."""
    from log_runs import make_run

    path = tmp_path_factory.mktemp("record") / "run.mcap"
    make_run(path)
    return path
