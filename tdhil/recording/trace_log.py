"""Writing of a trace of another tool as a log of tdhil, so that everything that reads a log reads the trace.

The log has every sample, the stated motion and the facts of the Recording, and neither commands nor frames. A replay of
this log uses the same Recording, bit for bit, as a replay of the trace.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from drivers import PowerState, Sample
from tdhil.recording.builder import FACTS
from tdhil.recording.log_writer import RunWriter
from tdhil.recording.recording import Recording

QUEUE: Final = 65_536
"""Samples that wait for the file; 20 MB at most."""


def write_trace_log(path: Path, recording: Recording, run: Mapping[str, Any]) -> None:
    """Write the log of a trace to ``path``, a new file. ``run``: its configuration.

    Raises LogError: LogRefused without disk space, LogUnopened or LogBroken.
    """
    facts = {name: value for name in FACTS if (value := getattr(recording, name)) is not None}
    writer = RunWriter(path, epoch_ns=0, block=True, queue_size=QUEUE, overwrite=False)
    writer.keep_up = False
    with writer:
        writer.configuration(run, facts)
        writer.excitation(recording.excitation, recording.levels, recording.ramps)
        columns = (recording.time_s, recording.speed_rad_s, recording.torque_nm, recording.fresh, recording.limited)
        for time_s, speed_rad_s, torque_nm, fresh, limited in zip(*(one.tolist() for one in columns), strict=True):
            writer.sample(Sample(time_s, 0.0, 0.0, fresh, speed_rad_s, torque_nm, None, None, PowerState.UNKNOWN,
                                 False, limited, 0, None))
