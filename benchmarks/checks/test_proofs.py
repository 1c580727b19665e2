"""A few of what `benchmarks/service_proofs.py` does by the fifty: webs killed, stops beside all that is in the way."""

from __future__ import annotations

import pytest

from benchmarks import service_proofs


@pytest.mark.heavy
def test_a_killed_web_costs_no_sample_and_is_found_again(tmp_path, monkeypatch):
    monkeypatch.setattr(service_proofs, "FOUND_S", 60.0)       # nothing asserts on wall time here
    assert service_proofs.kill(tmp_path, times=3, seed=1)


@pytest.mark.heavy
def test_a_stop_gets_through_viewers_replays_and_a_locked_index(tmp_path, monkeypatch):
    monkeypatch.setattr(service_proofs, "STOP_S", 60.0)
    monkeypatch.setattr(service_proofs, "RATE_HZ", 20.0)       # which a loaded machine still keeps
    assert service_proofs.stop(tmp_path, times=1, disk=False)
