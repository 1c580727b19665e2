"""`tdhil study`: the paper's experiments and tdhil's own, compared with the published values."""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from profiles import MessageCode
from tdhil.cli.arguments import add_option
from tdhil.cli.results import print_json
from tdhil.config import OPTION
from tdhil.version import __version__

if TYPE_CHECKING:
    from drivers import Command, Identity, Preflight, Sample
    from sim_bus import RigParams
    from tdhil.config import Rig, RunOptions
    from tdhil.recording import Recording, Stage
    from tdhil.runner import Idle, Task
    from tdhil.runner.excitation import Plan, SpeedChangePlan
    from tdhil.studies import Chapter, FieldRun, RunProgress, Study


# ---------------------------------------------------------------------------------------------------------------------
# Bench of the field studies: embedded simulator, virtual bus, driver, runner, guard and log; in stepped time.


BEFORE_ACQUIRE_S = 32.0
"""Approximate duration of setup and stage 2, s; only for the progress bar."""


class SimulatedFieldBench:
    """Bench that runs all five stages and the stop, like `tdhil identify --simulate`.

    Its log is deleted after the run. Ctrl-C stops the shaft, and raises `tdhil.errors.Interrupted`.
    """

    def run(self, wish: FieldRun, progress: RunProgress) -> Recording:
        """Return the Recording. Raises the error that ended the run early."""
        from tdhil.buses import PeerPlan
        from tdhil.config import resolve
        from tdhil.recording import RunLog, RunWriter
        from tdhil.runner import Runner, not_confirmed
        from tdhil.session import opened_drive, simulated_connection, stop_on_signals

        rig = bench_rig(wish)
        options = resolve(_asked(wish), rig)
        peer = PeerPlan(embedded=True, stepped=True, seed=wish.seed, plant=plant_of(wish))
        with tempfile.TemporaryDirectory(prefix="tdhil-study-") as folder:
            writer = RunWriter(Path(folder) / "run.mcap", epoch_ns=peer.epoch_ns, block=True)
            log = RunLog(writer, {"tdhil": __version__, "embedded_simulator": True, "seed": wish.seed})
            try:
                with stop_on_signals() as stop_request, opened_drive(
                    peer, options, simulated_connection(options), None, log.frame, None
                ) as drive:
                    make_task = partial(_task, options, rig)
                    outcome = Runner(drive, make_task, log, stop_request, _ProgressDisplay(progress), _no_prompt).run()
            finally:
                log.close()
        if outcome.cause is not None:
            raise outcome.cause
        if outcome.stop is not None and not outcome.stop.confirmed:
            raise not_confirmed(outcome.stop)
        return log.recording(complete=True)


def bench_rig(wish: FieldRun) -> Rig:
    """Return the limits of the bench: those of the simulated rig, with the study's torque limit."""
    from tdhil.config import rig_model, simulated_default_rig

    usual = simulated_default_rig().model_dump(by_alias=True)
    return rig_model().model_validate({**usual, "limits": {**usual["limits"], "torque_nm": wish.torque_limit_nm}})


def plant_of(wish: FieldRun) -> RigParams:
    """Return the simulator's parameters: its defaults with the study's rig, loop and torque limit."""
    from sim_bus import RigParams

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
    from tdhil.runner import Task
    from tdhil.session import bench_of, excitation_request, facts, machine_limits

    bench = bench_of(identity.simulated, rig)
    return Task(machine_limits(bench), excitation_request(options), facts(bench))


def _no_prompt(task: Task, preflight: Preflight, idle: Idle) -> None:
    """Confirm: only simulated peers are opened here, so no real shaft moves."""
    assert preflight.identity.simulated


class _ProgressDisplay:
    """Display that converts cycles to a share of the run."""

    def __init__(self, report: Callable[[float], None]) -> None:
        self._report = report
        self._start_s: float | None = None
        self._expected_s = 150.0
        self._next_s = 0.0

    def preflight(self, preflight: Preflight) -> None:
        """Show nothing."""

    def stage_started(self, name: str, expected_s: float) -> None:
        """Show nothing."""

    def stage_ended(self, stage: Stage) -> None:
        """Show nothing."""

    def stopped(self, confirmed: bool) -> None:
        """Report the end of the run."""
        self._report(1.0)

    def planned(self, plan: Plan | SpeedChangePlan) -> None:
        """Note the duration of the run."""
        self._expected_s = BEFORE_ACQUIRE_S + plan.duration_s + 5.0

    def cycle(self, command: Command, sample: Sample) -> None:
        """Report progress every second of control time."""
        if sample.time_s < self._next_s:
            return
        self._start_s = sample.time_s if self._start_s is None else self._start_s
        self._next_s = sample.time_s + 1.0
        self._report(min(1.0, (sample.time_s - self._start_s) / self._expected_s))


# ---------------------------------------------------------------------------------------------------------------------

LIST, ALL = "list", "paper"
OURS = ("coverage", "soft-torque")
"""Long studies that are not experiments of the paper."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of study."""
    parser.add_argument(
        "studies", nargs="*", metavar="NAME", help=f"studies to run; '{LIST}' names them, '{ALL}' runs all of them"
    )
    parser.add_argument("--out", type=Path, default=Path("study"), metavar="DIR", help="folder for the files "
                                                                                       "(default study)")
    add_option(parser, OPTION["json"])
    parser.add_argument("--set", dest="assignments", action="append", default=[], metavar="NAME=VALUE",
                        help="one setting of one study, such as Kp=3000; repeatable")
    parser.add_argument("--study", dest="file", type=Path, metavar="my.yaml", help="settings from a file")
    parser.add_argument("--seed", type=int, metavar="N", help="seed of all random numbers")
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """List, or run the requested studies. A statement that is not confirmed is a finding, not a failure."""
    studies = all_studies()
    if namespace.studies == [LIST]:
        return _list(studies, namespace.json)
    wanted = chosen(namespace, studies)
    return _run(wanted, namespace, report=namespace.studies == [ALL])


def all_studies() -> dict[str, Study]:
    """Return every study by name: tables first, then figures in the paper's order, tdhil's own last."""
    from tdhil.studies import COVERAGE, SOFT_TORQUE, field_studies, simulated_studies

    known = {study.name: study for study in (*simulated_studies(), *field_studies(SimulatedFieldBench()))}
    return {name: known[name] for name in sorted(known, key=_order)} | {
        COVERAGE.name: COVERAGE, SOFT_TORQUE.name: SOFT_TORQUE}


def chosen(namespace: argparse.Namespace, studies: Mapping[str, Study]) -> list[tuple[Study, Any]]:
    """Return each requested study with its settings. Raises UsageError and DataFileError, a line each."""
    from tdhil.errors import UsageError
    from tdhil.studies import load_study_file, with_assignments

    names = list(dict.fromkeys(namespace.studies))
    if names == [ALL]:
        names = [name for name in studies if name not in OURS]
    for name in names:
        if name not in studies:
            raise _unknown(name, studies)
    if namespace.file is not None:
        study, settings = load_study_file(namespace.file, studies)
        if names and names != [study.name]:
            raise UsageError(f"the file is for {study.name}", where=f"--study {namespace.file}",
                             next_step=f"Remove the name, or name only {study.name}",
                             entry=MessageCode.STUDY_SETTING_WRONG)
        found = [(study, settings)]
    else:
        found = [(studies[name], studies[name].settings_model()) for name in names]
    if not found:
        raise UsageError("no study is named", next_step=f"tdhil study {LIST} lists them",
                         entry=MessageCode.STUDY_SETTING_WRONG)
    if namespace.assignments and len(found) > 1:
        raise UsageError("settings differ from study to study", where="--set", next_step="Name one study",
                         entry=MessageCode.STUDY_SETTING_WRONG)
    if namespace.assignments:
        found = [(study, with_assignments(settings, namespace.assignments)) for study, settings in found]
    if namespace.seed is None:
        return found
    seeded: list[tuple[Study, Any]] = []
    for study, settings in found:
        random = "seed" in type(settings).model_fields
        if not random and len(found) == 1:
            raise UsageError(f"nothing in {study.name} is random", where="--seed",
                             entry=MessageCode.STUDY_SETTING_WRONG)
        try:
            seeded.append((study, with_assignments(settings, [f"seed={namespace.seed}"]) if random else settings))
        except UsageError as error:
            raise UsageError(error.what.removeprefix("--set "), where="--seed") from None
    return seeded


def _run(wanted: list[tuple[Study, Any]], namespace: argparse.Namespace, *, report: bool) -> int:
    from tdhil.errors import ExitCode, Interrupted, TdhilError, UsageError, error_document, exit_code
    from tdhil.report import PlainConsole, stderr_console
    from tdhil.studies import (
        INSTALL,
        Chapter,
        StudyBar,
        document,
        print_outcome,
        tally,
        write_report,
        write_study,
    )

    stderr, out = stderr_console(), PlainConsole()
    folder: Path = namespace.out
    try:                               # before the computation
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"can't be made a folder ({error.strerror})", where=f"--out {folder}",
                         entry=MessageCode.FILE_NOT_WRITABLE) from None
    chapters: list[Chapter] = []
    documents: list[dict[str, Any]] = []
    code, without = 0, False
    bar = StudyBar(stderr, len(wanted))
    for index, (study, settings) in enumerate(wanted):
        begun_s = time.monotonic()
        try:
            with bar.of(index, study.name) as progress:
                outcome = study.run(settings, progress)
        except TdhilError as error:
            if not report or isinstance(error, Interrupted):
                raise
            # with a report, the other studies continue
            stderr.print(f"tdhil: {study.name}: {error.coded}", style="bold red", markup=False, soft_wrap=True)
            code = code or int(exit_code(error))
            chapters.append(Chapter(study.name, None, None, str(error)))
            documents.append({"study": study.name, "error": error_document(error)})
            continue
        took_s = time.monotonic() - begun_s
        written = write_study(outcome, settings, folder / study.name)
        without |= written.without_matplotlib
        chapters.append(Chapter(study.name, outcome, written))
        documents.append(document(outcome, settings, written))
        if not namespace.json:
            print_outcome(outcome, written, out)
        cost = f"{outcome.name}: {took_s:.1f} s"
        if outcome.simulated_s > 0.0:
            # of the simulation alone if the study reports it
            each_ms = 1e3 * (outcome.simulation_wall_s or took_s) / outcome.simulated_s
            cost += f"; {outcome.simulated_s:.0f} simulated seconds, {each_ms:.3g} ms each"
        stderr.print(cost, style="dim", markup=False)
        if outcome.interrupted:
            stderr.print(f"tdhil: {study.name} was interrupted; its figures use the runs finished before",
                       style="bold yellow", markup=False, soft_wrap=True)
            code = int(ExitCode.INTERRUPTED)
            break
    if without:
        stderr.print(f"tdhil: {INSTALL}", markup=False, soft_wrap=True)
    index_path = write_report(chapters, folder) if report else None
    if index_path is not None:
        stderr.print(f"{tally(chapters)}; report: {index_path}", markup=False, soft_wrap=True)
    if namespace.json:
        several = {"studies": documents, "report": None if index_path is None else str(index_path)}
        print_json(documents[0] if len(documents) == 1 and not report else several)
    return code


def _list(studies: Mapping[str, Study], as_json: bool) -> int:
    if as_json:
        print_json({"studies": [{"name": study.name, "title": study.title} for study in studies.values()]})
        return 0
    from tdhil.report import PlainConsole
    from tdhil.studies import print_list

    print_list(studies.values(), PlainConsole())
    return 0


def _unknown(name: str, studies: Mapping[str, Study]) -> Exception:
    from tdhil.cli.arguments import meant
    from tdhil.errors import UsageError

    if name in (LIST, ALL):
        return UsageError(f"'{name}' must be the only name", next_step=f"tdhil study {name}")
    hint = meant(name, (*studies, LIST, ALL))
    return UsageError(f"unknown study '{name[:40]}'", next_step=f"{hint}tdhil study {LIST} lists them",
                      entry=MessageCode.STUDY_SETTING_WRONG)


def _order(name: str) -> tuple[bool, str, int]:
    stem = name.rstrip("0123456789")
    return (not name.startswith("table"), stem, int(name[len(stem) :] or 0))
