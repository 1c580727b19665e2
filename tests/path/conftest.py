import fcntl
import os
import pickle

import pytest


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(no_bus_of_the_user):
    pass


@pytest.fixture(scope="session")
def short_run(tmp_path_factory):
    """Return one short simulated run for all workers of pytest-xdist: a `Finished` with its log. Tests only read it."""
    from tests.path.path_runs import SHORT, identify

    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    folder = folder / "short_run"
    folder.mkdir(exist_ok=True)
    kept = folder / "finished.pickle"
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)         # the first worker makes it, the others wait
        if not kept.exists():
            kept.write_bytes(pickle.dumps(identify(folder, *SHORT)))
    return pickle.loads(kept.read_bytes())
