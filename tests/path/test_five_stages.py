"""Five stages over a virtual bus in one process, and in two processes through the socketcand hub."""

import pytest

from tdhil.recording.log_reader import read_samples
from tests.path.five_stages import SEED, FiveStages, interrupted, over_a_peer
from tests.path.path_runs import QUICK, Shaft, identify


def embedded(folder, *arguments):
    trace = folder / "shaft.csv"
    done = identify(folder, "--simulate", "--seed", SEED, "--trace", trace, *arguments)
    return done, Shaft.read(trace)


class TestFiveStages(FiveStages):
    @pytest.fixture(params=[
        "virtual", *(pytest.param(more, marks=pytest.mark.heavy) for more in ("virtual-replayed", "socketcand"))
    ])
    def bus(self, request):
        self.replayed = request.param != "virtual"
        return over_a_peer if request.param == "socketcand" else embedded

    @pytest.fixture
    def interrupted_bus(self):
        return interrupted

    @pytest.mark.heavy
    def test_ctrl_c_in_the_torque_stage_stops_the_shaft(self, interrupted_bus, tmp_path):
        super().test_ctrl_c_in_the_torque_stage_stops_the_shaft(interrupted_bus, tmp_path)


WHERE_AND_WHEN = dict.fromkeys(("log", "date", "connection"), "")
"""Parts of a document that differ between a run and its repetition."""


@pytest.mark.heavy
def test_both_buses_give_the_same_result_and_the_same_samples(tmp_path):
    """With stepped time and a seed, bus and process have no effect."""
    found = []
    for run in (embedded, over_a_peer):
        folder = tmp_path / run.__name__
        folder.mkdir()
        done, _ = run(folder, *QUICK, "--mode", "speed", "--excitation", "sine", "--frequency", 1, "--periods", 12)
        found.append((done.document | WHERE_AND_WHEN, list(read_samples(done.log))))
    assert found[0] == found[1]
