"""Times of day and time stamps, as seconds from the first one's day.

Read are ``12:00:00.123`` (decimal comma too), ``00:12.3`` (minutes), with or without AM or PM, before it a date
(``2024-05-01T``, ``2024/05/01``, ``01.05.2024``, ``5/1/2024``), behind it a zone (``Z``, ``+02:00``). Without a date, a
clock that goes from the last hour of a day to the first one has passed midnight.
"""

import re
from datetime import date

_DAY_S = 86400.0
_CLOCK = re.compile(
    r"(?:(?P<date>[^\s:]+?)[T\s]\s*)?(?:(?P<hour>\d{1,3}):)?(?P<minute>\d{1,2}):(?P<second>\d{1,2}(?:[.,]\d*)?)"
    r"\s*(?P<half>[AaPp]\.?[Mm]\.?)?\s*(?P<zone>Z|[+-]\d{2}:?\d{2})?",
    re.ASCII,
)
_YEAR_FIRST = re.compile(r"(\d{4})[-/.](\d{1,2})[-/.](\d{1,2})", re.ASCII)
_YEAR_LAST = re.compile(r"(\d{1,2})[.](\d{1,2})[.](\d{4})", re.ASCII)


class ClockReader:
    """Reads one column from top to bottom; it has to remember the day."""

    def __init__(self) -> None:
        self._prefix = "\0"        # up to the last colon of the row before, without zone and half
        self._base_s = 0.0         # what that much is in seconds
        self._last_s = 0.0         # of its own day
        self._days: dict[str, int] = {}
        self._night = 0
        self._first: int | None = None

    def seconds(self, cell: str) -> float | None:
        """Seconds since the beginning of the first cell's day; None for what is no time."""
        prefix, _, tail = cell.rpartition(":")
        if prefix == self._prefix and len(tail) >= 2 and tail[:2].isdigit():
            try:
                return self._base_s + float(tail.replace(",", "."))
            except ValueError:
                pass
        found = _CLOCK.fullmatch(cell)
        if found is None or (found["hour"] is None and not re.search(r"[.,]", found["second"])):
            return None
        minutes, second = int(found["minute"]), float(found["second"].replace(",", "."))
        hours = int(found["hour"] or 0)
        if minutes > 59 or second >= 61.0 or (found["date"] and hours > 24):
            return None
        if found["half"]:
            hours = hours % 12 + (12 if found["half"][0] in "Pp" else 0)
        base = 3600.0 * hours + 60.0 * minutes - _zone_s(found["zone"])
        day = self._day(found["date"] or "", base)
        if day is None:
            return None
        self._base_s = base + _DAY_S * day
        self._prefix = "\0" if found["half"] or found["zone"] else prefix
        return self._base_s + second

    def _day(self, text: str, of_day_s: float) -> int | None:
        """Days since the first cell's; None for a date that is none."""
        if not text:
            if self._last_s >= _DAY_S - 3600.0 and of_day_s < 3600.0:
                self._night += 1
            self._last_s = of_day_s
            return self._night
        if text not in self._days:
            if len(self._days) > 366:
                return None
            ordinal = _ordinal(text)
            if ordinal is None:
                return None
            if self._first is None:
                self._first = ordinal
            # Day and month of 5/1/2024 can't be told apart; another date is the next day.
            self._days[text] = len(self._days) if ordinal == 0 else ordinal - self._first
        return self._days[text]


def _ordinal(text: str) -> int | None:
    """The day's number; 0 for a date of which day and month can't be told apart."""
    try:
        if found := _YEAR_FIRST.fullmatch(text):
            return date(int(found[1]), int(found[2]), int(found[3])).toordinal()
        if found := _YEAR_LAST.fullmatch(text):
            return date(int(found[3]), int(found[2]), int(found[1])).toordinal()
    except ValueError:
        return None
    return 0 if re.fullmatch(r"\d{1,2}[/-]\d{1,2}[/-]\d{2,4}", text, re.ASCII) else None


def _zone_s(zone: str | None) -> float:
    if zone is None or zone == "Z":
        return 0.0
    offset = 3600.0 * int(zone[1:3]) + 60.0 * int(zone[-2:])
    return -offset if zone[0] == "-" else offset
