"""The bench of the field studies: embedded simulator, virtual bus, driver, runner, guard and log; in stepped time."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from tdhil import __version__

if TYPE_CHECKING:
    from drivers.drive import Command, Identity, Preflight, Sample
    from sim_bus.params import RigParams
    from tdhil.config.options import RunOptions
    from tdhil.config.rig import Rig
    from tdhil.recording.recording import Recording, Stage
    from tdhil.run.excitation import Plan, SwingPlan
    from tdhil.run.task import Idle, RunOutcome, Task
    from tdhil.studies.field.bench import FieldRun, RunProgress

BEFORE_ACQUIRE_S = 32.0
"""Setup and the stage of speed take about so long; only the progress bar rests on it."""


class SimulatedFieldBench:
    """Each run is a whole one, all five stages and the stop, as `tdhil identify --simulate` does it.

    Its log is written and dropped with the run. Ctrl-C stops the shaft, and raises `tdhil.errors.Interrupted`.
    """

    def run(self, wish: FieldRun, progress: RunProgress) -> Recording:
        """The Recording; raises what ended the run before its end."""
        from tdhil.cli.connection import simulated_canopen
        from tdhil.cli.open_drive import PeerPlan, open_drive
        from tdhil.commands.stop_signals import stop_on_signals
        from tdhil.config.options import resolve
        from tdhil.recording.log_writer import RunWriter
        from tdhil.recording.run_log import RunLog
        from tdhil.run.runner import Runner

        rig = bench_rig(wish)
        options = resolve(_asked(wish), rig)
        peer = PeerPlan(embedded=True, stepped=True, seed=wish.seed, plant=plant_of(wish))
        with tempfile.TemporaryDirectory(prefix="tdhil-study-") as folder:
            writer = RunWriter(Path(folder) / "run.mcap", epoch_ns=peer.epoch_ns, block=True)
            log = RunLog(writer, {"tdhil": __version__, "embedded_simulator": True, "seed": wish.seed})
            try:
                with stop_on_signals() as stop_request, open_drive(
                    peer, options, simulated_canopen(options), None, log.frame, None
                ) as drive:
                    make_task = partial(_task, options, rig)
                    outcome = Runner(drive, make_task, log, stop_request, _Progress(progress), _no_prompt).run()
            finally:
                log.close()
        _raise_if_ended(outcome)
        return log.recording(complete=True)


def bench_rig(wish: FieldRun) -> Rig:
    """The limits of the bench: those of the simulated rig, with the study's torque limit."""
    from tdhil.config.rig import Rig, simulated_default_rig

    usual = simulated_default_rig().model_dump(by_alias=True)
    return Rig.model_validate({**usual, "limits": {**usual["limits"], "torque_nm": wish.torque_limit_nm}})


def plant_of(wish: FieldRun) -> RigParams:
    """The simulator's parameters: the study's rig, loop and torque limit on the simulator's own defaults."""
    from sim_bus.params import RigParams

    rig = wish.rig
    usual = RigParams().model_dump()
    usual["plant"] |= {
        "inertia_kg_m2": rig.inertia_kg_m2,
        "viscous_nm_s_rad": rig.viscous_nm_s_rad,
        "coulomb_nm": rig.coulomb_nm,
    }
    usual["drive"] |= {
        "torque_limit_nm": wish.torque_limit_nm,
        "rated_torque_nm": max(usual["drive"]["rated_torque_nm"], wish.torque_limit_nm),
        "speed_gain_nm_s_rad": wish.speed_gain_nm_s_rad,
        "speed_integral_gain_nm_rad": wish.integral_gain_nm_rad,
        "speed_filter_s": rig.loop_filter_s,
        "torque_lag_s": rig.loop_torque_lag_s,
    }
    usual["reporting"] |= {"speed_lag_s": rig.speed_lag_s, "torque_lag_s": rig.torque_lag_s}
    return RigParams.model_validate(usual)


def _asked(wish: FieldRun) -> dict[str, object]:
    return {
        "simulate": True,
        "rate_hz": wish.rate_hz,
        "excitation": "sine",
        "mode": wish.mode,
        "frequency_hz": wish.frequency_hz,
        "amplitude_rad_s": wish.amplitude_rad_s,
        "offset_rad_s": wish.offset_rad_s,
        "periods": wish.periods,
        "seed": wish.seed,
    }


def _task(options: RunOptions, rig: Rig, identity: Identity) -> Task:
    from tdhil.cli.task import bench_of, excitation_request, facts, machine_limits
    from tdhil.run.task import Task

    bench = bench_of(identity, rig)
    return Task(machine_limits(bench), excitation_request(options), facts(bench))


def _no_prompt(task: Task, preflight: Preflight, idle: Idle) -> None:
    """Nothing real moves: a peer without the simulator's marker is never opened here."""
    assert preflight.identity.simulated


def _raise_if_ended(outcome: RunOutcome) -> None:
    from tdhil.run.stop import not_confirmed

    if outcome.cause is not None:
        raise outcome.cause
    if outcome.stop is not None and not outcome.stop.confirmed:
        raise not_confirmed(outcome.stop)


class _Progress:
    """A display that turns cycles into a share of the run."""

    def __init__(self, report: Callable[[float], None]) -> None:
        self._report = report
        self._start_s: float | None = None
        self._expected_s = 150.0
        self._next_s = 0.0

    def preflight(self, preflight: Preflight) -> None:
        """Nothing to show."""

    def stage_started(self, name: str, expected_s: float) -> None:
        """Nothing to show."""

    def stage_ended(self, stage: Stage) -> None:
        """Nothing to show."""

    def stopped(self, confirmed: bool) -> None:
        """The run is over."""
        self._report(1.0)

    def planned(self, plan: Plan | SwingPlan) -> None:
        """Now it is known how long the run takes."""
        self._expected_s = BEFORE_ACQUIRE_S + plan.duration_s + 5.0

    def cycle(self, command: Command, sample: Sample) -> None:
        """Every second of control time."""
        if sample.time_s < self._next_s:
            return
        self._start_s = sample.time_s if self._start_s is None else self._start_s
        self._next_s = sample.time_s + 1.0
        self._report(min(1.0, (sample.time_s - self._start_s) / self._expected_s))
