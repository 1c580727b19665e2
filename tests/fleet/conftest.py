import random

import pytest


@pytest.fixture(scope="session")
def few(tmp_path_factory):
    """Return three runs of one rig in a folder with other files."""
    from tests.fleet.simulated_logs import rig_plants, write_rig

    folder = tmp_path_factory.mktemp("fleet") / "logs"
    folder.mkdir()
    logs = list(write_rig(folder, rig_plants(1)[0], 3, 5, periods=2))
    (folder / "below").mkdir()
    whole = logs[0].read_bytes()
    (folder / "below" / "cut.mcap").write_bytes(whole[:len(whole) * 3 // 4])
    (folder / "empty.mcap").touch()
    (folder / "corrupt.mcap").write_bytes(whole[:8] + random.Random(1).randbytes(5000))
    (folder / "other.mcap").write_bytes(b"not a log")
    (folder / "shaft.csv").write_text("time_s,speed_rad_s,torque_nm\n0,1,2\n")
    return folder
