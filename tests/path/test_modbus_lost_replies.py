"""A run whose line loses the replies only: the host's quick stop brakes the shaft; its requests feed the watchdog.

The profiles write the control word in another request than the one before it, whose reply is missing.
"""

import pytest

from tests.path.path_runs import Shaft, identify


@pytest.mark.heavy
@pytest.mark.parametrize("name", ["yaskawa/ga700", "danfoss/fc302"])
def test_the_shaft_stops_before_the_host_is_silent(name, tmp_path):
    trace = tmp_path / "shaft.csv"
    done = identify(tmp_path, "--simulate", "--profile", name, "--seed", 2, "--trace", trace,
                    "--fault", "bad-crc@speed+12s")
    assert done.code == 8, done.err
    shaft = Shaft.read(trace)
    (lost_s,), silent_s = shaft.events("fault: bad-crc"), min(shaft.events("host silent"))
    assert shaft.speed_at(lost_s) > 2.0
    assert abs(shaft.speed_at(silent_s - 0.5)) < 0.05, "the drive's watchdog stopped the shaft, not the host"
    assert "tdhil continues to send the quick stop" in " ".join(done.err.split())
