"""Five stages on a real SocketCAN interface: the same tests as over the other buses (tests/path).

candump records the whole run. Its log, read by independent code, and the raw frames in run.mcap must be the same: every
frame, its data, and the order of the frames of each sender. Between two senders, the log has the order of reception by
the host, and the bus the order of transmission. In stepped time the times of the log are control time, with one period
between SYNCs. test_silence compares times of the wall clock.
"""

from __future__ import annotations

from functools import partial
from itertools import accumulate, pairwise
from pathlib import Path

import pytest

from tdhil.recording.log_reader import read_frames
from tests.path.five_stages import FiveStages, interrupted, over_a_peer
from tests.vcan.candump_log import DRIVES, HOSTS, SYNC, TPDO1, watching

RATE_HZ = 50.0         # a guest needs milliseconds per cycle; the plant time is the same at any rate
MOSTLY = 0.99


def assert_log_is_what_was_on_the_bus(log: Path, seen: list) -> None:
    logged = list(read_frames(log))
    assert {frame.identifier for frame in seen} <= HOSTS | DRIVES
    assert not any(frame.remote for frame in seen)

    ours = [(frame.identifier, frame.data) for frame in logged if frame.outgoing]
    assert ours == [(frame.identifier, frame.data) for frame in seen if frame.identifier in HOSTS]

    theirs = [(frame.identifier, frame.data) for frame in logged if not frame.outgoing]
    on_the_bus = [(frame.identifier, frame.data) for frame in seen if frame.identifier in DRIVES]
    # The drive also sent frames before the start and after the end of the host.
    begin = next(k for k, frame in enumerate(on_the_bus) if frame == theirs[0])
    assert on_the_bus[begin : begin + len(theirs)] == theirs
    assert len(on_the_bus) - len(theirs) <= 5

    # The feedback follows its SYNC, on the bus and in the log. On a loaded computer a frame is
    # late occasionally, but too rarely to matter.
    for frames in (seen, logged):
        pairs = [frame.identifier for frame in frames if frame.identifier in (SYNC, TPDO1)]
        ahead = list(accumulate(1 if identifier == SYNC else -1 for identifier in pairs))
        assert min(ahead) >= 0
        in_turn = sum(pair == (SYNC, TPDO1) for pair in pairwise(pairs))
        assert in_turn >= MOSTLY * pairs.count(SYNC)
    syncs = [frame.time_s for frame in logged if frame.identifier == SYNC]
    assert len(syncs) > 1000
    assert {round((later - sooner) * RATE_HZ, 6) for sooner, later in pairwise(syncs)} == {1.0}
    stamps = [frame.stamp_s for frame in seen]
    assert stamps == sorted(stamps)


@pytest.mark.usefixtures("no_bus_of_the_user")
class TestFiveStages(FiveStages):
    @pytest.fixture
    def bus(self, vcan, tool):
        def watched(folder, *arguments):
            with watching(tool("candump"), folder / "candump.log", vcan) as candump:
                done, shaft = over_a_peer(folder, *arguments, "--rate", RATE_HZ, on=("-i", "socketcan", "-c", vcan))
            assert_log_is_what_was_on_the_bus(done.log, candump.frames)
            return done, shaft

        return watched

    @pytest.fixture
    def interrupted_bus(self, vcan):
        return partial(interrupted, on=("-i", "socketcan", "-c", vcan))
