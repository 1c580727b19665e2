"""The five stages on a real SocketCAN interface: the same tests as over the other buses (tests/path)."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "path"))     # tests are imported by path, not as a package

from five_stages import FiveStages, interrupted, over_a_peer


class TestFiveStages(FiveStages):
    @pytest.fixture(autouse=True)
    def _no_bus_of_the_user(self, monkeypatch, tmp_path):
        monkeypatch.setenv("HOME", str(tmp_path))
        monkeypatch.chdir(tmp_path)

    @pytest.fixture
    def bus(self, vcan):
        return partial(over_a_peer, on=("-i", "socketcan", "-c", vcan))

    @pytest.fixture
    def interrupted_bus(self, vcan):
        return partial(interrupted, on=("-i", "socketcan", "-c", vcan))
