"""Time stamps as a drive's tool left them: repeated, out of order, with gaps; what can be put right and what can't."""

import numpy as np

from tdhil.record.csv_errors import CsvUnusable
from tdhil.record.csv_rows import LineArray
from tdhil.recording.recording import BoolArray, FloatArray

LONGEST_S = 7 * 86400.0
_MOST_DROPPED = 0.10      # of the rows; more and it isn't one record
_GAP = 5.0                # usual intervals


def rising(time_s: FloatArray, lines: LineArray, file: str) -> tuple[BoolArray, list[str]]:
    """(N,) the rows to keep, and warnings. CsvUnusable if the rows are no record in order, or a week or longer."""
    keep = np.ones(len(time_s), dtype=np.bool_)
    if len(time_s) < 2:
        return keep, []
    # One stamp too high between two good ones: it is the one to go, not all that follow.
    keep[1:-1] = ~((time_s[1:-1] > time_s[2:]) & (time_s[2:] > time_s[:-2]))
    kept = np.flatnonzero(keep)
    highest = np.maximum.accumulate(time_s[kept])
    keep[kept[1:]] = time_s[kept][1:] > highest[:-1]
    lost = np.flatnonzero(~keep)
    warnings = []
    if len(lost):
        first = int(lost[0])
        same = float(np.mean(np.isin(time_s[lost], time_s[keep]))) if len(lost) < 100_000 else _same(time_s)
        how = "repeats itself" if same > 0.5 else "goes back"
        if len(lost) > _MOST_DROPPED * len(time_s):
            raise CsvUnusable(
                f"the time {how}, here and in {len(lost) - 1} more of {len(time_s)} rows",
                where=f"{file}:{lines[first]}",
                next_step="Export one recording, in its order, with time stamps as fine as the samples",
            )
        warnings.append(f"{file}:{lines[first]}: {_rows(len(lost))} dropped, where the time {how}")
    steps = np.diff(time_s[keep])
    if not len(steps):
        return keep, warnings
    usual, widest = float(np.median(steps)), int(np.argmax(steps))
    line = int(lines[keep][widest + 1])
    if float(np.sum(steps)) > LONGEST_S:
        raise CsvUnusable(
            f"the time spans {float(np.sum(steps)):.3g} s, more than a week", where=f"{file}:{line}",
            next_step="Check the unit of time (--columns time=…:ms), and the widest gap, which is at this line",
        )
    gaps = int(np.sum(steps > _GAP * usual))
    if gaps:
        plural = "gap" if gaps == 1 else "gaps"
        warnings.append(f"{file}:{line}: {gaps} {plural} in the time, the widest of {steps[widest]:.3g} s here")
    return keep, warnings


def _same(time_s: FloatArray) -> float:
    falls = np.diff(time_s)
    return float(np.mean(falls[falls <= 0.0] == 0.0)) if np.any(falls <= 0.0) else 0.0


def _rows(count: int) -> str:
    return "1 row was" if count == 1 else f"{count} rows were"
