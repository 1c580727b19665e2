"""Request to read or identify an uploaded recording: options for a trace, settings, texts and the rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

from tdhil.config import ASKED_AGAIN, OF_A_TRACE, OF_EVIDENCE, OPTION, OPTIONS, STATED
from tdhil.errors import UsageError
from tdhil.service.run_state import request_wrong
from tdhil.service.start_request import limits_in_words, value_of

RIG: Final = "rig"
"""Key of the rig as the person states it, '' for none."""
_ALSO: Final = (*ASKED_AGAIN, *(OPTION[name] for name in STATED))
ACCEPTED: Final = MappingProxyType({one.name: one for one in (*OF_A_TRACE, *_ALSO)})
"""Options of a request about an upload, by name."""
_LABELS: Final = {one.name: one.form.label for one in (*OF_EVIDENCE, *OF_A_TRACE, *OPTIONS) if one.form is not None}
_OF_A_TRACE: Final = frozenset(one.name for one in OF_A_TRACE)
_COLUMNS: Final = next(one.name for one in OF_A_TRACE if one.joined)
_RATED: Final = next(one.name for one in OF_A_TRACE if one.flag == "--rated-torque")


_LAGS: Final = (("speed_lag_s", "speed_lag_sd_s"), ("torque_lag_s", "torque_lag_sd_s"))
"""Each stated lag, with its standard uncertainty."""


def field_of(quantity: str) -> str:
    """Return the name of the field for a mistake in the columns, such as ``columns.speed``."""
    return _RATED if quantity == "rated" else f"{_COLUMNS}.{quantity}" if quantity else _COLUMNS


def label_of(name: str) -> str:
    """Return the label of a field on any form of the pages."""
    return _LABELS.get(name) or (f"column of {name.partition('.')[2]}" if name.startswith(f"{_COLUMNS}.") else name)


def upload_options(body: Mapping[str, Any], kind: str) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """Return the options by name, without the rig, and the wrong values as (name, reason).

    ``kind``: log or trace. Raises UsageError for a key that no request about an upload has.
    """
    found: dict[str, Any] = {}
    wrong: list[tuple[str, str]] = []
    for name, value in body.items():
        if name == RIG:
            continue
        option = ACCEPTED.get(str(name))
        if option is None:
            raise request_wrong("is not an option of an upload", str(name)[:60],
                                f"Options: {', '.join(sorted((RIG, *ACCEPTED)))}")
        if value in (None, "", []):
            continue
        if kind == "log" and name in _OF_A_TRACE:
            wrong.append((name, "is for a trace in CSV. A log of tdhil contains its own"))
            continue
        try:
            found[name] = value_of(option, value)
        except UsageError as error:
            wrong.append((name, error.what))
            continue
        if option.allowed and not option.joined and found[name] not in option.allowed:
            wrong.append((name, f"must be {' or '.join(option.allowed)}"))
        elif text := limits_in_words(option, found[name]):
            wrong.append((name, text))
    wrong += [(sd, f"needs the value: {label_of(lag)}") for lag, sd in _LAGS if sd in found and lag not in found]
    from tdhil.recording import motion_of

    refused = {name for name, _ in wrong}
    wrong += [(name, text) for name, text in motion_of(found)[1] if name not in refused]
    return found, wrong


def columns_wrong(options: Mapping[str, Any], names: Sequence[str]) -> list[tuple[str, str]]:
    """Return the mistakes in the chosen columns of a trace as (field, reason). ``names``: the columns of the file."""
    from tdhil.recording import column_mistakes

    mistakes = column_mistakes(options.get(_COLUMNS, ()), names, rated=_RATED in options)
    return [(field_of(quantity), text) for quantity, text in mistakes]
