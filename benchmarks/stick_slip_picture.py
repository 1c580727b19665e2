"""Draws docs/images/stick_slip.png: bit and top drive of the simulated drive, over CANopen, by its gains.

::

    python benchmarks/stick_slip_picture.py [FILE]

The runs are those of tests/path/test_soft_torque.py, in stepped time; half a minute.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tdhil.report import repeatable_figures
from tests.path.test_soft_torque import RPM, SET_RPM, gains, rig_with, turned

FILE = Path(__file__).parents[1] / "docs" / "images" / "stick_slip.png"
COLOURS = {"stiff": "#c2410c", "soft": "#1f5fa8"}


def main() -> None:
    """Both runs, a picture below the other."""
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else FILE
    with repeatable_figures():
        figure = Figure(figsize=(8.0, 4.2), layout="constrained")
        FigureCanvasAgg(figure)
        every = figure.subplots(2, 1, sharex=True)
        for axes, (kind, colour) in zip(every, COLOURS.items(), strict=True):
            law = gains()[kind]
            with tempfile.TemporaryDirectory() as folder:
                times, bit, top = turned(rig_with(Path(folder), law))
            axes.plot(times, bit / RPM, color=colour, lw=1.2, label="bit")
            axes.plot(times, top / RPM, color="0.4", lw=1.0, label="top drive, as reported")
            axes.set(ylabel="rpm", title=f"{kind}: P = {law.gain_nm_s_rad:.0f} N·m·s/rad, I = "
                     f"{law.integral_nm_rad:.0f} N·m/rad; set speed ramped to {SET_RPM:.0f} rpm")
            axes.title.set_fontsize(9)
            axes.grid(alpha=0.3)
            axes.margins(x=0.0)
            axes.set_ylim(top=1.35 * float(bit.max()) / RPM)
            axes.legend(fontsize="small", loc="upper right", ncols=2)
        every[-1].set_xlabel("time, s")
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=100)


if __name__ == "__main__":
    main()
