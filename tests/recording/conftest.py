import pytest


@pytest.fixture(scope="session")
def whole(tmp_path_factory):
    """Completed run of 1000 cycles (4 s)."""
    from tests.recording.log_runs import make_run

    path = tmp_path_factory.mktemp("record") / "run.mcap"
    make_run(path)
    return path
