"""`tdhil study`: the paper's experiments and ours, run again, beside what was published."""

from __future__ import annotations

import argparse
import difflib
import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tdhil.studies.study import Study, StudyOutcome
    from tdhil.study.write_report import Chapter

LIST, ALL = "list", "paper"
OURS = ("coverage",)
"""Studies that are no experiment of the paper's, and take long."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of study."""
    parser.add_argument(
        "studies", nargs="*", metavar="NAME", help=f"studies to run; '{LIST}' names them, '{ALL}' runs all of them"
    )
    parser.add_argument("--out", type=Path, default=Path("study"), metavar="DIR", help="where files go (default study)")
    parser.add_argument("--json", action="store_true", help="one JSON document on stdout")
    parser.add_argument("--set", dest="assignments", action="append", default=[], metavar="NAME=VALUE",
                        help="one setting of one study, such as Kp=3000; may be repeated")
    parser.add_argument("--study", dest="file", type=Path, metavar="my.yaml", help="settings from a file")
    parser.add_argument("--seed", type=int, metavar="N", help="of everything random in it")
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """List, or run what was asked for. A statement that does not hold is a finding and no failure."""
    studies = all_studies()
    if namespace.studies == [LIST]:
        return _list(studies, namespace.json)
    wanted = chosen(namespace, studies)
    return _run(wanted, namespace, report=namespace.studies == [ALL])


def all_studies() -> dict[str, Study]:
    """Every study by its name, tables first, figures in the paper's order; ours last."""
    from tdhil.commands.field_bench import SimulatedFieldBench
    from tdhil.studies.coverage.study import COVERAGE
    from tdhil.studies.field.registry import field_studies
    from tdhil.studies.registry import simulated_studies

    known = {study.name: study for study in (*simulated_studies(), *field_studies(SimulatedFieldBench()))}
    return {name: known[name] for name in sorted(known, key=_order)} | {COVERAGE.name: COVERAGE}


def chosen(namespace: argparse.Namespace, studies: Mapping[str, Study]) -> list[tuple[Study, Any]]:
    """Each study that was asked for, with its settings. UsageError and DataFileError, a line each."""
    from tdhil.errors import UsageError
    from tdhil.studies.settings_files import load_study_file, with_assignments

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
                             next_step=f"Leave the name out, or name {study.name} alone")
        found = [(study, settings)]
    else:
        found = [(studies[name], studies[name].settings_model()) for name in names]
    if not found:
        raise UsageError("no study was named", next_step=f"tdhil study {LIST} names them")
    if namespace.assignments and len(found) > 1:
        raise UsageError("settings differ from study to study", where="--set", next_step="Name one study")
    if namespace.assignments:
        found = [(study, with_assignments(settings, namespace.assignments)) for study, settings in found]
    if namespace.seed is None:
        return found
    return [(study, _seeded(study, settings, namespace.seed, alone=len(found) == 1)) for study, settings in found]


def _seeded(study: Study, settings: Any, seed: int, *, alone: bool) -> Any:
    from tdhil.errors import UsageError
    from tdhil.studies.settings_files import with_assignments

    if "seed" in type(settings).model_fields:
        try:
            return with_assignments(settings, [f"seed={seed}"])
        except UsageError as error:
            raise UsageError(error.what.removeprefix("--set "), where="--seed") from None
    if alone:
        raise UsageError(f"nothing in {study.name} is random", where="--seed")
    return settings


def _run(wanted: list[tuple[Study, Any]], namespace: argparse.Namespace, *, report: bool) -> int:
    from tdhil.errors import ExitCode, Interrupted, TdhilError, exit_code
    from tdhil.report.console import PlainConsole
    from tdhil.report.live import stderr_console
    from tdhil.studies.output import INSTALL, document, write_study
    from tdhil.study.write_progress import StudyBar
    from tdhil.study.write_report import Chapter, tally, write_report
    from tdhil.study.write_terminal import print_outcome

    told, out = stderr_console(), PlainConsole()
    folder = _made(namespace.out)
    chapters: list[Chapter] = []
    documents: list[dict[str, Any]] = []
    code, without = 0, False
    bar = StudyBar(told, len(wanted))
    for index, (study, settings) in enumerate(wanted):
        begun_s = time.monotonic()
        try:
            with bar.of(index, study.name) as progress:
                outcome = study.run(settings, progress)
        except TdhilError as error:
            if not report or isinstance(error, Interrupted):
                raise
            # in a report the other studies still count
            told.print(f"tdhil: {study.name}: {error}", style="bold red", markup=False, soft_wrap=True)
            code = code or int(exit_code(error))
            chapters.append(Chapter(study.name, None, None, str(error)))
            documents.append({"study": study.name, "error": {"kind": type(error).__name__, "message": str(error)}})
            continue
        took_s = time.monotonic() - begun_s
        written = write_study(outcome, settings, folder / study.name)
        without |= written.without_matplotlib
        chapters.append(Chapter(study.name, outcome, written))
        documents.append(document(outcome, settings, written))
        if not namespace.json:
            print_outcome(outcome, written, out)
        told.print(_cost(outcome, took_s), style="dim", markup=False)
        if outcome.interrupted:
            told.print(f"tdhil: {study.name} was interrupted; its figures are of the runs done by then",
                       style="bold yellow", markup=False, soft_wrap=True)
            code = int(ExitCode.INTERRUPTED)
            break
    if without:
        told.print(f"tdhil: {INSTALL}", markup=False, soft_wrap=True)
    index_path = write_report(chapters, folder) if report else None
    if index_path is not None:
        told.print(f"{tally(chapters)}; report: {index_path}", markup=False, soft_wrap=True)
    if namespace.json:
        several = {"studies": documents, "report": None if index_path is None else str(index_path)}
        json.dump(documents[0] if len(documents) == 1 and not report else several, sys.stdout, ensure_ascii=False,
                  indent=2, allow_nan=False)
        sys.stdout.write("\n")
    return code


def _made(folder: Path) -> Path:
    """The output folder, before anything is computed for it."""
    from tdhil.errors import UsageError

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"can't be made a folder ({error.strerror})", where=f"--out {folder}") from None
    return folder


def _cost(outcome: StudyOutcome, took_s: float) -> str:
    """Wall time, and what a simulated second costs: of the simulation alone where a study tells."""
    simulated_s = outcome.simulated_s
    if simulated_s <= 0.0:
        return f"{outcome.name}: {took_s:.1f} s"
    each_ms = 1e3 * (outcome.simulation_wall_s or took_s) / simulated_s
    return f"{outcome.name}: {took_s:.1f} s; {simulated_s:.0f} simulated seconds, {each_ms:.3g} ms each"


def _list(studies: Mapping[str, Study], as_json: bool) -> int:
    if as_json:
        json.dump({"studies": [{"name": study.name, "title": study.title} for study in studies.values()]}, sys.stdout,
                  ensure_ascii=False, indent=2)
        sys.stdout.write("\n")
        return 0
    from tdhil.report.console import PlainConsole
    from tdhil.study.write_terminal import print_list

    print_list(studies.values(), PlainConsole())
    return 0


def _unknown(name: str, studies: Mapping[str, Study]) -> Exception:
    from tdhil.errors import UsageError

    if name in (LIST, ALL):
        return UsageError(f"'{name}' stands alone", next_step=f"tdhil study {name}")
    close = difflib.get_close_matches(name, [*studies, LIST, ALL], n=1)
    meant = f"Did you mean '{close[0]}'? " if close else ""
    return UsageError(f"there is no study '{name[:40]}'", next_step=f"{meant}tdhil study {LIST} names them")


def _order(name: str) -> tuple[bool, str, int]:
    stem = name.rstrip("0123456789")
    return (not name.startswith("table"), stem, int(name[len(stem) :] or 0))
