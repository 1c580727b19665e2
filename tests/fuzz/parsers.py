"""Every parser of external bytes, with its corpus, its mutations and its only allowed exception.

An input passes if the parser returns a result, or raises a `TdhilError` with one line and place per problem.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from drivers.errors import TdhilError
from tests.fuzz import mutate, replies

HERE = Path(__file__).parent
CORPUS = HERE / "corpus"
YAML_WORDS = [
    b"!!python/object/apply:os.system [id]", b"!!python/name:os.system", b"!!binary aGk=", b"!!float 1", b"&a", b"*a",
    b"<<", b"---", b"...", b"%YAML 1.1", b"on", b"off", b"yes", b"null", b"~", b"true", b"1e3", b"010", b"0o7", b"1:30",
    b"{", b"}", b"[", b"]", b"'", b'"', b"|", b">", b"? ", b": ", b"- ", b"\t", b"# ", b"\xef\xbb\xbf", b"\xff\xfe",
    b"\xe2\x80\xa8", b"\x00", b"\x85", b"2026-01-01", b"[[[[[[[[[[[[[[[[", b"{a: {a: {a: {a: ", b"\xc3\xa9",
]
CSV_WORDS = [b";", b",", b"\t", b"|", b'"', b"\r\n", b"\r", b"\xef\xbb\xbf", b"\xff\xfe", b"\0", b"time_s", b"rpm",
             b"[Nm]", b"%", b"1,5", b"1.000,5", b"2026-01-01T00:00:00", b"12:30:01,5", b"NaN", b"#", b"\xb5s", b"sep=;"]

EDS_WORDS = [b"[", b"]", b"=", b";", b"#", b"0x", b"$NODEID+", b"[6060]", b"[1018sub1]", b"[1016Name]", b"sub",
             b"\r\n", b"\xfc", b"\0", b"CompactSubObj=200", b"ObjectType=8", b"ObjectType=5", b"DataType=0x8",
             b"ParameterValue=", b"HighLimit=-1", b"NodeID=$NODEID", b"ParameterName=\xe2\x80\xae", b"AccessType=",
             b"\x1b[2J"]


@dataclass(frozen=True)
class Parser:
    """Parser. ``parse`` reads the file at a path and checks the result; ``mutations`` are those of its kind of file."""

    name: str
    suffix: str
    parse: Callable[[Path], None]
    mutations: Sequence[mutate.Mutation]

    @property
    def folder(self) -> Path:
        return CORPUS / self.name

    def corpus(self) -> list[bytes]:
        """Return the corpus: valid files first, then all files found by fuzzing."""
        return [path.read_bytes() for path in sorted(self.folder.iterdir())]


def try_one(parser: Parser, data: bytes, path: Path) -> str:
    """Return 'taken' or 'refused'. Any exception other than a proper refusal is raised."""
    path.write_bytes(data)
    try:
        parser.parse(path)
    except TdhilError as error:
        check_refusal(error, path)
        return "refused"
    return "taken"


def check_refusal(error: TdhilError, path: Path) -> None:
    """Check that a refusal has one line of bounded length per problem, each with its place."""
    said = str(error)
    problems = getattr(error, "problems", None)
    assert said.count("\n") < (len(problems) if problems else 1), f"more lines than problems: {said!r}"
    assert all(line.strip() and len(line) < 2000 for line in said.split("\n")), f"no line of a message: {said!r}"
    assert all(sign.isprintable() or sign == "\n" for sign in said), f"control characters: {said!r}"
    assert problems is None or all(problem.file for problem in problems)
    assert problems or error.where or parser_free(said), f"no place: {said!r}"


def parser_free(said: str) -> bool:
    """Run a parser below a bus. Its errors name an object, a node or the host in ``where``, or in the text."""
    return any(word in said for word in ("node", "bus", "drive", "request"))


# -- what is done with each -------------------------------------------------------------------------------------------


def _profile(path: Path) -> None:
    from profiles.library import load_profile

    load_profile(str(path))


def _eds(path: Path) -> None:
    from profiles.eds_import import begin_profile
    from profiles.eds_reader import read_eds

    begin_profile(read_eds(path), str(path))


def _rig(path: Path) -> None:
    from tdhil.config.rig import load_rig

    rig = load_rig(path)
    for name in ("limits", "gear.ratio", "run.seed"):
        rig.source(name)


def _plant(path: Path) -> None:
    from profiles.yaml_loader import load_model
    from sim_bus.params import RigParams

    load_model(path, RigParams)


@cache
def _studies() -> dict:
    from tdhil.cli.study import all_studies

    return all_studies()


def _study(path: Path) -> None:
    from tdhil.studies.settings_files import load_study_file

    load_study_file(path, _studies())


def _excitation(path: Path) -> None:
    from tdhil.recording.csv.excitation import load_excitation

    found, levels = load_excitation(path, np.linspace(0.0, 100.0, 1001))
    for segment in found.segments:
        assert np.isfinite([segment.start_s, segment.end_s, segment.period_s, *segment.lines_hz]).all()
    assert all(np.isfinite([level.start_s, level.end_s]).all() for level in levels)


def _csv(path: Path) -> None:
    from tdhil.recording.csv.layout import USUAL, parse_columns
    from tdhil.recording.csv.reader import Bench, read_recording

    choices = USUAL
    if not path.read_bytes().startswith(b"time_s"):
        choices = parse_columns(["time=t:ms", "speed=n_rpm:rpm", "torque=m_pct:%"])
    recording, _ = read_recording(path, choices, None, Bench(rated_torque_nm=480.0))
    assert len(recording.time_s) == len(recording.speed_rad_s) == len(recording.torque_nm)
    assert np.isfinite(recording.time_s).all()
    assert (np.diff(recording.time_s) > 0).all()


def _mcap(path: Path) -> None:
    from tdhil.recording.log_reader import read_frames, read_run, read_samples
    from tdhil.recording.salvage import examine, write_copy
    from tests.recording.log_runs import same_run

    copy = path.with_suffix(".copy")
    found = examine(path)                  # like `tdhil recover`: with a damaged head too
    write_copy(path, copy, found)
    again = read_run(copy)
    assert again.complete == found.whole
    assert len(again.recording.time_s) == len(found.run.recording.time_s)
    assert same_run(read_run(path), read_run(path, batch=0))
    for _ in read_samples(path):
        pass
    for _ in read_frames(path):
        pass


def _can(path: Path) -> None:
    replies.can_session(path.read_bytes())


def _modbus(path: Path) -> None:
    replies.modbus_replies(path.read_bytes())


_YAML = (*mutate.BYTES, mutate.lines, mutate.lines, mutate.number, mutate.number, mutate.tokens(YAML_WORDS),
         mutate.tokens(YAML_WORDS))
PARSERS = {
    parser.name: parser
    for parser in (
        Parser("profile", ".yaml", _profile, _YAML),
        Parser("eds", ".eds", _eds, (*mutate.BYTES, mutate.lines, mutate.number, mutate.tokens(EDS_WORDS))),
        Parser("rig", ".yaml", _rig, _YAML),
        Parser("plant", ".yaml", _plant, _YAML),
        Parser("study", ".yaml", _study, _YAML),
        Parser("excitation", ".yaml", _excitation, _YAML),
        Parser("csv", ".csv", _csv, (*mutate.BYTES, mutate.lines, mutate.number, mutate.tokens(CSV_WORDS))),
        Parser("mcap", ".mcap", _mcap, (*mutate.BYTES, *(mutate.inside_chunks,) * 6)),
        Parser("can", ".bin", _can, (*mutate.BYTES, *(mutate.records,) * 6)),
        Parser("modbus", ".bin", _modbus, mutate.BYTES),
    )
}
