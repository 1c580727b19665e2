"""One round of the cycle's transactions over the line, and when speed and torque were under way."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from drivers.modbus.access import Access, Answer
from drivers.modbus.errors import BUSY, NoisyReply, RegisterRefused
from drivers.modbus.plan import Transaction
from profiles.modbus import Register

BUSY_TRIES, BUSY_PAUSE_S = 3, 0.002
"""Of a transaction in the cycle that the drive put off with exception 6; then the cycle counts as missed."""


class Round(NamedTuple):
    """What the registers read were, and the control times that bound the transactions with speed and torque."""

    words: Mapping[tuple[str, int], int]
    sent_s: float
    received_s: float
    longest_s: float               # of the single transactions


def go_round(
    access: Access,
    transactions: Sequence[Transaction],
    image: Mapping[int, int],
    timeout_s: float,
    moving: Sequence[Register],
    again_until_s: float = -math.inf,
) -> Round:
    """Run them one after the other; the first that fails ends the round.

    A reply that noise has damaged is asked for once more, up to ``again_until_s`` (control time): the same words.

    Raises CommunicationLost (NoReply, BadReply, LinkLost) and RegisterRefused.
    """
    words: dict[tuple[str, int], int] = {}
    sent_s: float | None = None
    received_s = longest_s = 0.0
    for transaction in transactions:
        answer = _patiently(access, transaction.request(image), timeout_s, str(transaction), again_until_s)
        longest_s = max(longest_s, answer.received_s - answer.sent_s)
        span = transaction.read
        if span is None:
            continue
        words.update({(span.table, span.address + k): word for k, word in enumerate(answer.words)})
        if any(span.covers(register) for register in moving):
            sent_s = answer.sent_s if sent_s is None else sent_s
            received_s = answer.received_s
    return Round(words, sent_s or 0.0, received_s, longest_s)


def _patiently(access: Access, pdu: bytes, timeout_s: float, what: str, again_until_s: float) -> Answer:
    tries, noisy = 1, False
    while True:
        try:
            return access.once(pdu, timeout_s, f"function {what}")
        except NoisyReply:
            if noisy or access.clock.now_s() >= again_until_s:
                raise
            noisy = True
            continue
        except RegisterRefused as error:
            if error.code != BUSY or tries >= BUSY_TRIES:
                raise
        tries += 1
        access.clock.wait_until(access.clock.now_s() + BUSY_PAUSE_S)
