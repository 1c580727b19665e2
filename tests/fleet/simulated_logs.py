"""Hundreds of real run.mcap files of simulated rigs, by the batch simulator of the studies and the log container."""

import json
from collections.abc import Iterator
from dataclasses import asdict, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from tdhil.recording.builder import FACTS
from tdhil.recording.chunk_table import _SAMPLE_ROW, _TAGS
from tdhil.recording.log_messages import configuration_message, excitation_message, result_message, stage_message
from tdhil.recording.mcap_container import Container
from tdhil.recording.recording import Recording, Stage
from tdhil.studies.coverage.plants import FLEET, CoveragePlant, HostSampling
from tdhil.studies.coverage.simulate import simulate

BEGAN = datetime(2026, 1, 5, 8, 0, tzinfo=UTC)
FIELD = next(plant for plant in FLEET if plant.name == "field")
QUICK = replace(FIELD, reading=HostSampling(rate_hz=25.0, command_s=0.04), step_s=0.008)
PERIODS = 6


def rig_plants(count: int) -> list[CoveragePlant]:
    """Return rigs of different size, each with its own lags."""
    rng = np.random.default_rng(17)
    plants = []
    for number in range(count):
        size = float(rng.uniform(0.6, 1.6))
        plants.append(replace(
            QUICK, name=f"R{number + 1}", inertia_kg_m2=104.0 * size, viscous_nm_s_rad=8.0 * size,
            coulomb_nm=60.0 * size, torque_limit_nm=400.0 * size))
    return plants


def write_log(
    path: Path, recording: Recording, rig: str, number: int, result: dict[str, object] | None = None,
    aborted_by: str | None = None, faults: tuple[str, ...] = (),
) -> None:
    """Write the recording as a finished log of rig ``rig``, with one run per week.

    ``aborted_by``: kind of error that ended the run. ``faults``: rehearsed faults.

    """
    epoch_ns = int((BEGAN + timedelta(weeks=number)).timestamp() * 1e9)
    run = {
        "tdhil": "0.1.0", "drive": "canopen", "embedded_simulator": True, "bench": {"name": rig, "load": "none"},
        "identity": {"name": "Simulated drive", "vendor": 1, "product": 2, "revision": 3, "serial": int(rig[1:])},
        "profile": {"name": "generic/cia402", "title": "CiA 402"},
        "started": (BEGAN + timedelta(weeks=number)).isoformat(), "identify": {"tolerance": 0.05, "confidence": 0.95},
    }
    if faults:
        run["faults"] = list(faults)
    if aborted_by is not None:
        run["ended"] = {"kind": aborted_by, "what": "it ended", "exit_code": 6, "time_s": float(recording.time_s[-1])}
    whole = asdict(recording)
    rows = np.zeros(len(recording.time_s), _SAMPLE_ROW)
    for name, tag in _TAGS:
        rows[name] = tag
    for name in ("time_s", "speed_rad_s", "torque_nm"):
        rows[name] = getattr(recording, name)
    rows["fresh"], rows["limit_active"], rows["state"], rows["mode"] = recording.fresh, recording.limited, 3, 2
    data, size = rows.tobytes(), _SAMPLE_ROW.itemsize
    with path.open("wb", buffering=0) as file:
        container = Container(file)
        began, last = float(recording.time_s[0]), float(recording.time_s[-1])
        colds = [configuration_message(run, {name: whole[name] for name in FACTS}),
                 stage_message(Stage("setup", 0.0, 0.1, "ok"))]
        for message in colds:
            container.add(message.channel, epoch_ns, message.payload)
        times = [epoch_ns + round(time_s * 1e9) for time_s in recording.time_s.tolist()]
        each = max(1, round(0.2 * len(rows) / (last - began)))
        for n, time_ns in enumerate(times):
            container.add(1, time_ns, data[n * size:(n + 1) * size])
            if n % each == each - 1:
                container.close_chunk()
        colds = [excitation_message(recording.excitation, recording.levels, recording.ramps),
                 stage_message(
                 Stage("acquire", began, last, "ok") if aborted_by is None      # a little later than all relevant data
                 else Stage("acquire", began, last + 1.0, "aborted"))]
        if result is not None:
            colds.append(result_message(result))
        for message in colds:
            container.add(message.channel, times[-1], message.payload)
        container.close_chunk()
        container.finish()


def write_rig(
    folder: Path, plant: CoveragePlant, count: int, seed: int, periods: int = PERIODS, group: int = 50
) -> Iterator[Path]:
    """Write ``count`` runs of one rig, as R7-003.mcap and so on."""
    for first in range(0, count, group):
        numbers = range(first, min(first + group, count))
        seeds = [(seed, int(plant.name[1:]), number) for number in numbers]
        for number, recording in zip(numbers, simulate(plant, seeds, periods), strict=True):
            path = folder / f"{plant.name}-{number:03d}.mcap"
            write_log(path, replace(recording, torque_scale_rel_sd=0.03), plant.name, number)
            yield path


def result_of(path: Path) -> dict[str, object]:
    """Return the document of a replay."""
    import tdhil

    return json.loads(json.dumps(tdhil.identify(tdhil.read(path)).to_dict()))
