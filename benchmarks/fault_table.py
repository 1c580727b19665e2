"""Runs the fault table's own tests and writes docs/reference/faults.md from what they saw.

Each row: the fault, what must happen, what was seen, the plant time from the fault to the last movement of the true
shaft, the log's fate, the exit code, and the tests. `--keep FILE` keeps what was seen, `--from FILE` runs nothing.
`--only NUMBER` runs the tests of one row, and writes that row alone.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from tests.faults.rows import ROWS  # noqa: E402

KILLED = (None, -signal.SIGKILL)       # a process that was killed has no code of its own

HEAD = """# The faults, and what a run does about each

The first fifty faults were required. The others were found by trials. `python benchmarks/fault_table.py` makes this
page from the tests that it names. If a message is reworded later, its quotation follows; the figures stay.

You can rehearse any scripted row: `tdhil identify --simulate --fault NAME@STAGE+2s` (`--fault list` shows the names).
`NAME@stop` begins when the drive is first commanded to stop. `sim_bus/reports.py` has a table of its own, with faults
of reports, sensors and power stages.

* **QS**: the one stop sequence. It is quick stop, confirmed standstill, trapped torque brought down, and then disable.
* **WD**: the drive's own watchdog stops the shaft.
* **R**: refused before the shaft has moved.
* **M**: the run continues, and the degraded part is marked.
* *Standstill after*: plant time from the fault to the last movement of the simulated shaft (0.02 rad/s). Unless the
  row states otherwise, it begins at some 4 rad/s, on a ramp of 2 rad/s². A dash: nothing moved, or nothing had to stop.
* *Exit*: how the process may end.

"""


def run_tests(path, only=None):
    environment = os.environ | {"TDHIL_FAULT_TABLE": str(path)}
    which = ["tests/faults"] if only is None else [*ROWS[only].tests, "-k", f"not test_row or {only}-"]
    command = [sys.executable, "-m", "pytest", "-q", "--long", *which, "-p", "no:cacheprovider"]
    done = subprocess.run(command, cwd=ROOT, env=environment, check=False)
    return done.returncode


def table(lines):
    """Rows of Markdown; ``lines`` as `seen` wrote them."""
    by_row = {}
    for line in lines:
        by_row.setdefault(line["row"], []).append(line)
    out = ["| # | fault | must | seen | standstill after | log | exit |", "|---|---|---|---|---|---|---|"]
    tests = ["", "## The tests", ""]
    for number, row in ROWS.items():
        found = by_row.get(number, [])
        said = "<br>".join(dict.fromkeys(_cell(line["said"]) for line in found)) or _cell(row.said)
        rest = [line["standstill_s"] for line in found if line["standstill_s"] is not None]
        logs = ", ".join(dict.fromkeys(line["log"] for line in found if line["log"])) or "–"
        codes = _codes([str(line["code"]) for line in found if line["code"] not in KILLED], row.codes)
        shown = "–" if not rest else f"{min(rest):.1f} s" if len(rest) == 1 else f"{min(rest):.1f} to {max(rest):.1f} s"
        out.append(f"| {number} | {row.fault} | {row.expected} | {said} | {shown} | {logs} | {codes} |")
        names = dict.fromkeys([*row.tests, *(line["test"].split("[")[0] for line in found)])
        tests.append(f"{number}. " + ", ".join(f"`{name}`" for name in names))
    return "\n".join([*out, *tests]) + "\n"


def with_row(text, new, number):
    """``text`` of the page with one row, and its line of tests, as ``new`` has them."""
    for beginning, before in ((f"| {number} |", f"| {number - 1} |"), (f"{number}. `", f"{number - 1}. `")):
        line = next(line for line in new.splitlines() if line.startswith(beginning))
        kept = [one for one in text.splitlines() if not one.startswith(beginning)]
        at = next(place for place, one in enumerate(kept) if one.startswith(before)) if number > 1 else None
        assert at is not None, "row 1 is written with all others"
        text = "\n".join([*kept[:at + 1], line, *kept[at + 1:]]) + "\n"
    return text


def _codes(found, stated):
    """Return the codes of the row itself, if they hold all that was seen: another case may end otherwise."""
    codes = stated if set(found) <= set(stated.split(", ")) else ", ".join(dict.fromkeys(found))
    return "–" if codes == "-" else codes


def _cell(text):
    return text.replace("|", "\\|").replace("\n", " ")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--from", dest="source", type=Path)
    parser.add_argument("--only", type=int, choices=tuple(ROWS), metavar="NUMBER")
    options = parser.parse_args()
    code = 0
    with tempfile.TemporaryDirectory() as folder:
        path = options.source or options.keep or Path(folder) / "seen.jsonl"
        if options.source is None:
            path.unlink(missing_ok=True)
            code = run_tests(path.absolute(), options.only)
        lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    page, text = ROOT / "docs" / "reference" / "faults.md", HEAD + table(lines)
    if options.only is not None:
        text = with_row(page.read_text(encoding="utf-8"), text, options.only)
    page.write_text(text, encoding="utf-8")
    print(f"docs/reference/faults.md: {len(lines)} observations of {len({line['row'] for line in lines})} rows")
    return code


if __name__ == "__main__":
    sys.exit(main())
