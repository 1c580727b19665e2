"""Peer of a run: the embedded simulator, or the drive at its address."""

from __future__ import annotations

from typing import Any

import pytest

from tdhil.buses import PeerPlan
from tdhil.config import resolve
from tdhil.errors import MessageCode, UsageError
from tdhil.session import connection_of, plan_peer


def planned(**given: Any) -> PeerPlan:
    return plan_peer(*connection_of(given, None, resolve(given, None)))


def test_a_drive_at_an_address_is_no_simulated_one() -> None:
    found = planned(drive="modbus", host="127.0.0.1")
    assert (found.embedded, found.seed, found.plant) == (False, None, None)
    assert planned(drive="modbus", host="127.0.0.1", simulate=True).embedded


def test_a_line_without_sync_cannot_be_stepped() -> None:
    with pytest.raises(UsageError) as refused:
        planned(drive="modbus", host="127.0.0.1", stepped=True)
    assert refused.value.entry is MessageCode.STEPPED_NEEDS_SYNC
