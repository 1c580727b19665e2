"""Seeded samples, frames and whole runs for the tests of the log."""

import random
from dataclasses import fields
from pathlib import Path

import numpy as np

from drivers.drive import Command, Mode, PowerState, RawFrame, Sample
from tdhil.recording.builder import RecordingBuilder
from tdhil.recording.log_format import Event
from tdhil.recording.log_reader import LoggedRun
from tdhil.recording.log_writer import RunWriter
from tdhil.recording.recording import (
    Excitation,
    LagPrior,
    Level,
    Ramp,
    Recording,
    Segment,
    Stage,
    TorqueAnswer,
)

PERIOD_S = 0.004
SEGMENT = Segment(1.0, 3.0, 0.5, 1, 3.0, (2.0, 4.0), (0.1, 0.05), (0.0, 1.5))
EXCITATION = Excitation("multisine", "torque", (SEGMENT, SEGMENT))
LEVELS = (Level(0.1, 0.2), Level(0.3, 0.4))
RAMPS = (Ramp(0.2, 0.3),)
STAGES = (Stage("setup", 0.0, 0.5, "ok"), Stage("speed", 0.5, 1.0, "degraded", "5 cycles missed · ½"))
FACTS = {
    "lag_prior": LagPrior(speed_lag_s=0.4, speed_lag_sd_s=0.01, source="drive"),
    "speed_resolution_rad_s": 0.1 / 3,
    "torque_resolution_nm": 0.12,
    "torque_limit_nm": 400,
    "torque_offset_nm": -0.3,
    "torque_scale_rel_sd": 0.02,
    "gear_ratio": 10.5,
    "torque_answer": TorqueAnswer(0.15, 0.1 / 3),
    "position_gap_s": 0.1 / 3,
    "speed_unit_accepted": True,
    "simulated": True,
}
CONFIGURATION = {"drive": "canopen", "rate_hz": 250.0, "ids": [1, 2], "nothing": None}
RESULT = {"verdict": "valid", "inertia_kg_m2": {"value": 104.00000000000001}, "odd": float("nan")}


def sample(cycle: int, rng: random.Random) -> Sample:
    time_s = cycle * PERIOD_S
    return Sample(
        time_s, 0.0003, 0.0, rng.random() > 0.01, 3.0 + rng.gauss(0, 0.01), rng.gauss(100, 2),
        None if cycle % 3 else rng.gauss(100, 2), rng.choice((None, *Mode)), rng.choice(list(PowerState)),
        rng.random() > 0.5, rng.random() > 0.9, rng.getrandbits(16), None if cycle % 5 else rng.gauss(0, 50))


def frames(cycle: int, rng: random.Random) -> list[RawFrame]:
    time_s = cycle * PERIOD_S
    return [
        RawFrame(time_s, True, 0x201, rng.randbytes(8)),
        RawFrame(time_s, True, 0x80, b""),
        RawFrame(time_s + 0.0003, False, 0x181, rng.randbytes(8)),
    ]


def fill(writer: RunWriter, builder: RecordingBuilder, cycles: int, seed: int = 1) -> list[RawFrame]:
    """Write a run of this number of cycles into both; return the logged frames."""
    rng = random.Random(seed)
    logged = []
    builder.learn(**FACTS)
    writer.configuration(CONFIGURATION, builder.facts)
    for cycle in range(cycles):
        command = Command(Mode.TORQUE, 3.0, 100.0)
        writer.command(cycle * PERIOD_S, command)
        for frame in frames(cycle, rng):
            writer.frame(frame)
            logged.append(frame)
        one = sample(cycle, rng)
        writer.sample(one)
        builder.add(one, command)
    for stage in STAGES:
        writer.stage(stage)
        builder.stage(stage)
    for excitation in (None, EXCITATION):
        writer.excitation(excitation, LEVELS, RAMPS)
        builder.excitation(excitation, LEVELS, RAMPS)
    writer.event(Event(cycles * PERIOD_S, "warning", "bus error-passive", "Traceback …"))
    writer.result(RESULT)
    return logged


def make_run(path: Path, cycles: int = 1000, epoch_ns: int = 0) -> RecordingBuilder:
    builder = RecordingBuilder()
    with RunWriter(path, epoch_ns=epoch_ns, block=True) as writer:
        fill(writer, builder, cycles)
    return builder


def same_run(one: LoggedRun, other: LoggedRun) -> bool:
    """Return whether all data and problems are equal, and the recordings bit for bit."""
    rest = [(field.name, repr(getattr(one, field.name)) == repr(getattr(other, field.name)))
            for field in fields(LoggedRun) if field.name != "recording"]
    return same(one.recording, other.recording) and all(equal for _, equal in rest)


def same(one: Recording, other: Recording) -> bool:
    """Return whether both are equal bit for bit, NaN included."""
    for field in fields(Recording):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if isinstance(a, np.ndarray):
            if a.dtype != b.dtype or a.tobytes() != b.tobytes() or not a.flags.c_contiguous:
                return False
        elif a != b or repr(a) != repr(b):
            return False
    return True
