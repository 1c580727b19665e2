"""The types of the service's replies, and the document that describes them (OpenAPI 3.1).

The web and the document use the same table of routes. `role` states the least role. On
loopback without accounts, every client has every role.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from types import MappingProxyType
from typing import Any, ClassVar, Final, Literal

from pydantic import ConfigDict, TypeAdapter

from tdhil.buses import DoctorFinding
from tdhil.config import Option
from tdhil.service.acceptance_signature import AcceptanceSignature
from tdhil.service.accounts import Role
from tdhil.service.annotations import AnnotationEdit
from tdhil.service.audit import Broken, Entry
from tdhil.service.evidence_request import STATEMENT, EvidenceView
from tdhil.service.fleets import FleetView
from tdhil.service.foxglove import PROTOCOLS
from tdhil.service.limits import API
from tdhil.service.run_filter import SORTS, Summary
from tdhil.service.run_state import Check, Confirmation, Entered, State, Stop, Told, Watch
from tdhil.service.start_request import TAKEN, option_schema
from tdhil.service.upload_request import ACCEPTED
from tdhil.service.uploads import Upload
from tdhil.version import __version__

NO_ROOM: Final = 507
"""HTTP status of a full disk: any request that writes a file may get it."""

# For mypy these are plain dataclasses; pydantic makes the schemas from their annotations.


@dataclass(frozen=True)
class RigView:
    """A rig. ``state``: whether a run may be started, or the reason why not; ``holder``: its present user, in words."""

    id: str
    name: str
    state: Literal["free", "busy", "held", "blocked", "unusable"]
    simulated: bool
    motion: Literal["never", "attended", "watched"]
    problem: str = ""
    holder: str | None = None
    run: str | None = None
    blocked_by: str | None = None
    drive: str | None = None
    profile: str | None = None
    limits: dict[str, float | None] | None = None
    last: Summary | None = None


@dataclass(frozen=True)
class FieldView:
    """A key of a rig's file: its meaning, what the drive has to have there (empty for any value), and its unit."""

    name: str
    description: str
    required: str = ""
    unit: str = ""


@dataclass(frozen=True)
class ProfileView:
    """A profile that ships. ``by_hand``: settings at the drive. ``unverified``: its unverified entries and sources."""

    name: str
    title: str
    bus: str
    bus_title: str
    experimental: bool
    by_hand: list[str]
    unverified: dict[str, str]
    rated_torque_by_hand: bool
    parameters: list[FieldView]
    address: list[FieldView]


@dataclass(frozen=True)
class NewRigView:
    """Everything that the page of a new rig offers."""

    machine: list[FieldView]
    profiles: list[ProfileView]


@dataclass(frozen=True)
class DraftProblemView:
    """A mistake in a draft, with its field; '' belongs to the whole file."""

    field: str
    message: str


@dataclass(frozen=True)
class DraftView:
    """The text of a new rig's file, its mistakes, and its limits in SI if they have none."""

    text: str
    problems: list[DraftProblemView]
    limits: dict[str, float]


@dataclass(frozen=True)
class FoundDriveView:
    """A drive that a scan found. ``fields``: what names it on its bus."""

    address: int
    title: str
    identity: str
    simulated: bool
    profile: str | None
    why: str
    fields: dict[str, str]


@dataclass(frozen=True)
class ScanView:
    """The drives that replied, and remarks of the scan."""

    found: list[FoundDriveView]
    remarks: list[str]


@dataclass(frozen=True)
class RigFileView:
    """A rig's present file; ``editable``: the keys that may be changed over HTTP."""

    rig: str
    text: str
    sha256: str
    editable: list[str]


@dataclass(frozen=True)
class ReplayView:
    """A replay: its settings and its result. ``holder``: holds a drive, so the replay is delayed until it has ended."""

    name: str
    asked: dict[str, Any]
    at: str
    by: str
    state: Literal["waiting", "delayed", "done", "failed"]
    result: dict[str, Any] | None = None
    error: Told | None = None
    holder: str | None = None


@dataclass(frozen=True)
class RunView:
    """A run without its samples. ``result``: document of `tdhil identify --json`; ``files``: names for downloads.

    ``operator``, ``note``, ``customer``, ``order_number``, ``place``: as edited later, else as in ``options``.
    ``edits``: each later edit, with old and new value. ``outdated``: reports that are made again at the next request.
    ``signature``: under its acceptance. ``uploaded``: source of an uploaded recording (file, sha256, by, at, rig as
    stated, kind, size_bytes); None for a run of this service. ``evidence``: its archive, if one was made.
    """

    id: str
    rig: str
    rig_name: str
    state: State
    stage: str | None
    at: str
    asked: str
    asked_by: str
    simulated: bool
    options: dict[str, Any]
    history: list[Entered]
    expected_s: dict[str, float]
    preflight: list[Check]
    identity: str
    safe_action: str
    confirmation: Confirmation | None
    motion: str
    watch: Watch | None
    stop: Stop
    error: Told | None
    exit_code: int | None
    verdict: str | None
    result: dict[str, Any] | None
    files: list[str]
    replays: list[ReplayView]
    signed_off: dict[str, Any] | None
    alive: bool
    rehearsal: bool = False
    rehearsal_verdict: dict[str, Any] | None = None
    operator: str = ""
    note: str = ""
    tags: list[str] = field(default_factory=list)
    archived: bool = False
    edits: list[AnnotationEdit] = field(default_factory=list)
    signature: AcceptanceSignature | None = None
    uploaded: dict[str, Any] | None = None
    evidence: EvidenceView | None = None
    customer: str = ""
    order_number: str = ""
    place: str = ""
    outdated: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class LetterheadView:
    """Head of the reports of this service. ``logo``: a PNG in base64, '' without one."""

    company: str
    address: list[str]
    logo: str


@dataclass(frozen=True)
class UploadsView:
    """The uploads that wait to be identified, the newest first. ``limit_bytes``: largest file."""

    limit_bytes: int
    uploads: list[Upload]


@dataclass(frozen=True)
class DeletedView:
    """A deleted run: its files, and the SHA-256 of its log ('' without one). The audit keeps both."""

    run: str
    files: list[str]
    log_sha256: str


@dataclass(frozen=True)
class AcceptanceView:
    """The acceptance of a run, the SHA-256 of its log, and its signature. ``problem``: why it is not valid."""

    run: str
    acceptance: dict[str, Any]
    log_sha256: str
    signature: AcceptanceSignature | None
    problem: str


@dataclass(frozen=True)
class PlanView:
    """The plan and its expected result: the document of `tdhil identify --dry-run --json`."""

    rig: str
    rig_sha256: str
    plan: dict[str, Any]


@dataclass(frozen=True)
class PaceView:
    """Measurement whether this computer sustains a simulated rig's cycle rate in real time: ``holds`` and ``text``."""

    rig: str
    pace: dict[str, Any]


@dataclass(frozen=True)
class TrendView:
    """A rig's results over time, and whether they changed: the document of `tdhil trend --json`."""

    rig: str
    trend: dict[str, Any]


@dataclass(frozen=True)
class RunsPageView:
    """A page of the list of runs. ``total``: number of runs that meet the conditions; ``first``: number of the first
    run on this page, 0 for an empty page. ``until``: id for the next request, so that new runs move no page. ``rigs``,
    ``verdicts``, ``tags``, ``acceptances``: the values that occur, for a choice.
    """

    runs: list[Summary]
    total: int
    page: int
    pages: int
    first: int
    until: str | None
    rigs: list[str]
    verdicts: list[str]
    tags: list[str]
    acceptances: list[str]


@dataclass(frozen=True)
class CompareView:
    """A comparison of runs: the document of `tdhil compare --json`."""

    runs: list[str]
    comparison: dict[str, Any]


@dataclass(frozen=True)
class CalibrationView:
    """A torque calibration: the document of `tdhil calibrate torque --json`. It is not stored."""

    calibration: dict[str, Any]


@dataclass(frozen=True)
class PictureView:
    """A picture of the report. ``caption``: description of the picture."""

    number: int
    heading: str
    caption: str


@dataclass(frozen=True)
class FaultView:
    """A fault to rehearse, written ``NAME@STAGE+2s=VALUE``. ``row``: its row in docs/reference/faults.md; 0: none.

    ``value``: the default value if none is given; ``takes``: the meaning of the value, '' if there is none.
    ``from_start``: it has no start time and lasts for the whole run. ``required``: the reaction that the row requires.
    """

    name: str
    summary: str
    row: int
    value: str
    takes: str
    from_start: bool
    required: str


@dataclass(frozen=True)
class StoppedView:
    """A stop of a rig: its run, and the outcome of `tdhil stop` on its drive (exit code 0: standstill).

    `tdhil stop` is used without a run, and if another program holds the drive while the run is identified.
    """

    rig: str
    runs: list[str]
    exit_code: int | None = None
    said: str = ""


@dataclass(frozen=True)
class LeaseView:
    """The user who watches a run. Without a message of the page, the lease ends after ``lease_s``."""

    run: str
    watch: Watch
    lease_s: float


@dataclass(frozen=True)
class AuditView:
    """The latest audit lines, the newest first. ``broken``: the place where the chain is broken.

    ``head``: the last line as NUMBER:HASH, to keep on another computer and send as ``head`` later; None if the chain's
    end is broken. ``key_made``: when the chain's key was made.
    """

    entries: list[Entry]
    broken: Broken | None
    head: str | None = None
    key_made: str | None = None


@dataclass(frozen=True)
class HealthView:
    """Health of the service. ``live``: runs that have not ended; empty for a client that is not logged in."""

    status: Literal["ok"]
    version: str
    live: list[str]
    rigs: int


@dataclass(frozen=True)
class MeView:
    """The identified client. ``ends``: end of its login."""

    name: str
    roles: list[Role]
    login: bool
    ends: str | None = None


@dataclass(frozen=True)
class AccountView:
    """A user or a machine. ``since``: when the password was set, or the token made."""

    name: str
    role: Role
    since: str


@dataclass(frozen=True)
class AccountsView:
    """All users and tokens."""

    users: list[AccountView]
    tokens: list[AccountView]


@dataclass(frozen=True)
class TokenView:
    """A new token. It is shown only once."""

    name: str
    role: Role
    token: str


@dataclass(frozen=True)
class FieldError:
    """One wrong value of a request: the option, its label on the form, and the reason."""

    option: str
    label: str
    message: str


@dataclass(frozen=True)
class PreviewView:
    """Content of an upload. ``preview``: the table of a trace with a guess of its columns, or the run of a log; and
    ``reading``: length, rate, gaps, ranges and a plot, with this mapping. ``wrong``: every wrong value of the mapping.
    """

    upload: str
    preview: dict[str, Any]
    wrong: list[FieldError]


@dataclass(frozen=True)
class ErrorView:
    """An error of the error tree. ``fields``: every wrong value of a request, null for any other error."""

    error: Told
    holder: str | None = None
    fields: list[FieldError] | None = None


# -- request bodies -------------------------------------------------------------------------------------------------


KIBIBYTE: Final = 1024


class Body:
    """A request body. An unknown key is refused, not ignored."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")


@dataclass(frozen=True)
class ConfirmBody(Body):
    """The six digits of the code. ``binding``: the hash that was shown with the plan, if the sender has it.

    ``lease``: for a watched rig a random key of 16 to 200 characters. Only its sender has and renews it.
    """

    code: str
    binding: str | None = None
    lease: str | None = None


@dataclass(frozen=True)
class LeaseBody(Body):
    """Message that the page with this key is visible; ``gone``: hidden or closed. ``new_key`` replaces the key."""

    key: str
    new_key: str | None = None
    gone: Literal["hidden", "closed"] | None = None


@dataclass(frozen=True)
class SignOffBody(Body):
    """Statement of a user that the shaft is at standstill."""

    note: str


@dataclass(frozen=True)
class AnnotationsBody(Body):
    """New annotations of a run. None: the value stays."""

    tags: list[str] | None = None
    operator: str | None = None
    note: str | None = None
    customer: str | None = None
    order_number: str | None = None
    place: str | None = None


@dataclass(frozen=True)
class LetterheadBody(Body):
    """The whole new letterhead. ``logo``: a PNG in base64, '' for none, null for the present one."""

    company: str
    address: list[str]
    logo: str | None = None


@dataclass(frozen=True)
class ArchiveBody(Body):
    """State of the archive: lists and histories leave out an archived run."""

    archived: bool


@dataclass(frozen=True)
class DeleteBody(Body):
    """Confirmation of a deletion: the run's id, as the user typed it."""

    confirm: str


@dataclass(frozen=True)
class SignatureBody(Body):
    """Signature under an acceptance. ``verdict``, ``log_sha256``: as the person saw them. ``name``: of the person.

    ``remark`` is required unless the verdict is a pass.
    """

    name: str
    verdict: str
    log_sha256: str
    remark: str = ""


@dataclass(frozen=True)
class ReplayBody(Body):
    """Settings of a replay. None: the setting of the run. A relative value is a number, or a text such as ``1%``."""

    model: str | None = None
    tolerance: float | str | None = None
    confidence: float | str | None = None


@dataclass(frozen=True)
class CalibrationBody(Body):
    """Two runs of the rig: without and with an added body. Inertia of the body, kg·m², at the ``at`` shaft.

    ``added_sd_kg_m2``: standard uncertainty of this inertia; None: a default.
    """

    without: str
    with_body: str
    added_kg_m2: float
    added_sd_kg_m2: float | None = None
    at: Literal["motor", "main"] = "motor"


@dataclass(frozen=True)
class RigFileBody(Body):
    """The whole new rig file. ``sha256``: hash of the file that it replaces."""

    text: str
    sha256: str


@dataclass(frozen=True)
class DraftBody(Body):
    """Entries of a new rig's file, as typed: in the unit of the key, or with another unit.

    ``address``: keys of the drive's address. ``accept_unverified``: entries of the profile that were compared with the
    drive's manual. ``alone``: no other master is active on the bus; a scan needs it. ``simulated``: there is no drive.
    """

    profile: str
    simulated: bool = False
    name: str = ""
    load: str = "none"
    address: dict[str, str] = field(default_factory=dict)
    limits: dict[str, str] = field(default_factory=dict)
    string: dict[str, str] = field(default_factory=dict)
    rated_torque_nm: str = ""
    parameters: dict[str, str] = field(default_factory=dict)
    gear_ratio: str = ""
    accept_unverified: list[str] = field(default_factory=list)
    motion: str = "never"
    alone: bool = False


@dataclass(frozen=True)
class NewRigBody(Body):
    """A new rig: its id, which is the name of its file, and the text of the file."""

    id: str
    text: str


@dataclass(frozen=True)
class LoginBody(Body):
    """Login of a user."""

    name: str
    password: str


@dataclass(frozen=True)
class PasswordBody(Body):
    """Change of the user's own password."""

    old: str
    new: str


@dataclass(frozen=True)
class UserBody(Body):
    """A new user."""

    name: str
    role: Role
    password: str


@dataclass(frozen=True)
class NewPasswordBody(Body):
    """A new password for a user, set by an admin."""

    password: str


@dataclass(frozen=True)
class TokenBody(Body):
    """A new token for a machine."""

    name: str
    role: Role


@dataclass(frozen=True)
class FleetBody(Body):
    """Logs to identify again, and settings; None: the setting of each run.

    ``folder``: a name from `/fleets/folders`, '' for the service's own runs; ``below``: a folder inside it.
    ``archived``: whether the service's own runs include the archived ones; ``rehearsals``: include those of faults.
    """

    folder: str = ""
    below: str = ""
    model: str | None = None
    tolerance: float | str | None = None
    confidence: float | str | None = None
    archived: bool = False
    rehearsals: bool = False


@dataclass(frozen=True)
class Nothing:
    """An empty object."""


OPTIONS: Final = "Options"
"""Body of a request for a run: an object with the command line's options."""
RECORDING: Final = "Recording"
"""Body of a request about an upload: an object with the options of `tdhil replay`, and the rig."""
EVIDENCE: Final = "Evidence"
"""Body of a request for an archive: an object with the statement of the publisher."""
_NUMBERS: Final = "numbers in SI, or a text with a unit"
OBJECTS: Final[Mapping[str, tuple[str, Mapping[str, Option]]]] = MappingProxyType({
    OPTIONS: (f'the command line\'s options, such as {{"seed": 7, "tolerance": 0.01}}; {_NUMBERS}', TAKEN),
    RECORDING: ("options of `tdhil replay` for a trace, such as "
                f'{{"columns": ["time=t:s", "speed=n:rpm", "torque=m:Nm"]}}; {_NUMBERS}', ACCEPTED),
    EVIDENCE: ("the options of `tdhil evidence`, such as "
               '{"publisher": "The Institute", "publish": "log,result,identity"}', STATEMENT),
})
"""Bodies that are objects with options: their meaning, and the options. Their handlers check them."""
FILE: Final = "File"
"""Body of an upload: the bytes of a file. Its handler receives and limits them."""


@dataclass(frozen=True)
class Route:
    """One route of the service. ``answers``: by HTTP status, a type of this module, or the media type of a file.

    ``role``: the least role; None: every client, also without a login. A known client may always stop a run.
    """

    method: Literal["GET", "POST"]
    path: str
    name: str
    summary: str
    role: Role | None
    answers: Mapping[int, Any]
    body: Any = None
    errors: tuple[int, ...] = ()
    query: Mapping[str, str] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    longest: int = 64 * KIBIBYTE
    """Largest body, bytes."""


_ARCHIVED: Final = {"archived": "true: archived runs too"}
_LEFT_OUT: Final = {**_ARCHIVED, "rehearsals": "true: rehearsals of faults too"}
_RUN_FILTER: Final = {
    "rig": "runs of this rig only", "state": "runs in this state only", "verdict": "runs with this verdict only",
    "tag": "runs with this tag only", "acceptance": "runs with this verdict on their expected values only",
    "text": "runs with these words in id, rig, state, time, user, verdict, acceptance, operator, note,"
    " customer, order number, place or tags",
    "until": "runs up to this id only", **_ARCHIVED,
}
_RANGE: Final = {"Range": "a part of it, such as bytes=0-99"}


def _file(media: str) -> Mapping[int, Any]:
    return {200: media, 206: (media, "multipart/byteranges"), 400: "text/plain", 416: "text/plain"}


ROUTES: Final = (
    Route("GET", "/rigs", "rigs", "The rigs of this site", "viewer", {200: list[RigView]}),
    Route("GET", "/rigs/{rig}", "rig", "One rig", "viewer", {200: RigView}, errors=(404,)),
    Route("GET", "/new-rig", "new_rig", "Fields and profiles for a new rig", "viewer", {200: NewRigView}),
    Route("POST", "/new-rig/draft", "draft_rig", "The file of a new rig with all its mistakes; nothing is written",
          "engineer", {200: DraftView}, DraftBody, (422,)),
    Route("POST", "/new-rig/scan", "scan_bus", "The drives at an address, by tdhil scan; nothing is written to a drive",
          "engineer", {200: ScanView}, DraftBody, (403, 409, 422, 503)),
    Route("POST", "/rigs", "add_rig", "Add a rig by its file", "engineer", {201: RigView}, NewRigBody,
          (403, 409, 422, 503)),
    Route("GET", "/rigs/{rig}/file", "rig_file", "A rig's file", "viewer", {200: RigFileView}, errors=(404, 422)),
    Route("POST", "/rigs/{rig}/file", "edit_rig", "Change a rig's file (not the drive's address)",
          "engineer", {200: RigFileView}, RigFileBody, (404, 409, 422, 503)),
    Route("GET", "/rigs/{rig}/trend", "trend", "J, friction and lags over time, and whether they changed", "viewer",
          {200: TrendView}, errors=(404, 422), query=_LEFT_OUT),
    Route("POST", "/rigs/{rig}/calibration", "calibration", "Calibrate the torque by two runs; nothing is connected,"
          " and nothing is stored", "operator", {200: CalibrationView}, CalibrationBody, (403, 404, 422)),
    Route("POST", "/rigs/{rig}/plan", "plan", "Plan a run; nothing is connected", "viewer", {200: PlanView},
          OPTIONS, (403, 404, 409, 422)),
    Route("GET", "/rigs/{rig}/pace", "pace", "Measure whether this computer sustains a simulated rig's cycle rate",
          "operator", {200: PaceView}, errors=(403, 404, 409, 422)),
    Route("POST", "/rigs/{rig}/check", "check_rig", "Check a rig's drive by tdhil doctor; nothing is written to it",
          "operator", {200: list[DoctorFinding]}, Nothing, (403, 404, 409, 422, 503)),
    Route("POST", "/rigs/{rig}/runs", "start", "Request a run", "operator", {201: RunView, 200: RunView}, OPTIONS,
          (403, 404, 409, 422, 429, 503, 507),
          headers={"Idempotency-Key": "the same key returns the same run and never starts a second one, also after"
                   " the run was deleted (409)"}),
    Route("POST", "/rigs/{rig}/stop", "stop_rig", "Stop the rig's run; without a run, tdhil stop on its drive, which"
          " needs an operator if no tdhil moves it", "viewer", {200: StoppedView}, Nothing, (403, 404, 503, 504)),
    Route("GET", "/runs", "runs", "The runs, the newest first", "viewer", {200: list[Summary]}, errors=(422,),
          query={**_RUN_FILTER, "limit": "most runs to return (100)"}),
    Route("GET", "/runs/page", "runs_page", "A page of the list of runs, and what can be chosen in it", "viewer",
          {200: RunsPageView}, errors=(422,),
          query={**_RUN_FILTER, "sort": f"{', '.join(SORTS)} (id)", "order": "desc or asc (desc)",
                 "page": "number of the page (1)"}),
    Route("GET", "/runs/compare", "compare", "Compare runs", "viewer", {200: CompareView}, errors=(404, 422),
          query={"runs": "two to eight runs, separated by commas", **_LEFT_OUT}),
    Route("GET", "/runs/{run}", "run", "One run", "viewer", {200: RunView}, errors=(404,)),
    Route("POST", "/runs/{run}/confirm", "confirm", "Confirm motion with the code shown at the rig", "operator",
          {200: RunView}, ConfirmBody, (403, 404, 409, 422)),
    Route("POST", "/runs/{run}/lease", "renew", "Report once a second that the page of a watched run is visible",
          "operator", {200: LeaseView}, LeaseBody, (403, 404, 409, 422, 503)),
    Route("POST", "/runs/{run}/stop", "stop", "Stop the run. This is no emergency stop", "viewer", {200: RunView},
          Nothing, (403, 404, 503, 504)),
    Route("POST", "/runs/{run}/sign-off", "sign_off", "Sign off a stop that was not confirmed", "engineer",
          {200: RunView}, SignOffBody, (403, 404, 409, 422)),
    Route("POST", "/runs/{run}/annotations", "annotate", "Edit tags, operator, note, customer, order"
          " number and place of a run; its log stays as recorded", "operator", {200: RunView}, AnnotationsBody,
          (403, 404, 422, 503)),
    Route("POST", "/runs/{run}/archive", "archive", "Hide a run from lists and histories, or show it again",
          "engineer", {200: RunView}, ArchiveBody, (403, 404, 409, 422, 503)),
    Route("POST", "/runs/{run}/delete", "delete_run", "Delete a run with all its files; the audit keeps the entry",
          "admin", {200: DeletedView}, DeleteBody, (403, 404, 409, 422, 503)),
    Route("GET", "/runs/{run}/acceptance", "acceptance", "The acceptance of a run, with its signature", "viewer",
          {200: AcceptanceView}, errors=(404, 409)),
    Route("POST", "/runs/{run}/acceptance", "sign_acceptance", "Sign the acceptance of a run, once", "engineer",
          {200: AcceptanceView}, SignatureBody, (403, 404, 409, 422, 503)),
    Route("POST", "/runs/{run}/replays", "ask_replay", "Identify again; the first result is kept", "operator",
          {202: ReplayView, 200: ReplayView}, ReplayBody, (403, 404, 422, 503)),
    Route("GET", "/runs/{run}/replays/{replay}", "replay", "One replay", "viewer", {200: ReplayView}, errors=(404,)),
    Route("GET", "/runs/{run}/log.mcap", "log", "The log; also while it grows (Range)", "viewer",
          _file("application/octet-stream"), errors=(404,), headers=_RANGE),
    Route("GET", "/runs/{run}/recovered.mcap", "recovered", "An undamaged copy of a log that broke off", "viewer",
          _file("application/octet-stream"), errors=(404,), headers=_RANGE),
    Route("GET", "/runs/{run}/report.html", "report", "The report", "viewer", _file("text/html"), errors=(404,),
          headers=_RANGE),
    Route("GET", "/runs/{run}/report.pdf", "report_pdf", "The report on A4, made at the first request", "viewer",
          _file("application/pdf"), errors=(404, 422), headers=_RANGE),
    Route("GET", "/runs/{run}/result.json", "result", "The result", "viewer",
          _file("application/json"), errors=(404,), headers=_RANGE),
    Route("GET", "/runs/{run}/samples.csv", "samples", "Every sample with its command; made at the first request",
          "viewer", _file("text/csv"), errors=(404, 422, 507), headers=_RANGE),
    Route("POST", "/runs/{run}/evidence", "make_evidence", "Make the archive of a run, scrubbed, for others to check",
          "engineer", {201: EvidenceView}, EVIDENCE, (403, 404, 409, 422, 503)),
    Route("GET", "/runs/{run}/evidence.zip", "evidence", "The archive of evidence", "viewer",
          _file("application/zip"), errors=(404,), headers=_RANGE),
    Route("GET", "/runs/{run}/pictures", "pictures", "The report's pictures", "viewer", {200: list[PictureView]},
          errors=(404,)),
    Route("GET", "/runs/{run}/pictures/{number}", "picture", "One of the pictures", "viewer", {200: "image/svg+xml"},
          errors=(404,)),
    Route("GET", "/runs/{run}/trace.csv", "recording", "The uploaded trace, as it was received", "viewer",
          _file("text/csv"), errors=(404,), headers=_RANGE),
    Route("GET", "/uploads", "uploads", "Uploads that wait to be identified", "operator", {200: UploadsView}),
    Route("POST", "/uploads", "upload", "Upload a log of tdhil, or a trace in CSV, as the body", "operator",
          {201: Upload}, FILE, (403, 408, 409, 413, 422, 503, 507),
          query={"name": "name of the file, for display"}),
    Route("GET", "/uploads/{upload}", "one_upload", "One upload, and the run that was made from it", "operator",
          {200: Upload}, errors=(404,)),
    Route("POST", "/uploads/{upload}/preview", "preview", "Read an upload with this mapping; nothing is stored",
          "operator", {200: PreviewView}, RECORDING, (403, 404, 422)),
    Route("POST", "/uploads/{upload}/identify", "identify_upload", "Identify an upload; it becomes a run that has"
          " ended", "operator", {202: Upload}, RECORDING, (403, 404, 409, 422)),
    Route("POST", "/uploads/{upload}/delete", "delete_upload", "Delete an upload", "operator", {200: UploadsView},
          Nothing, (403, 404, 409)),
    Route("GET", "/rigs/{rig}/faults", "faults", "Faults that can be rehearsed on a simulated rig", "viewer",
          {200: list[FaultView]}, errors=(403, 404)),
    Route("GET", "/fleets", "fleets", "Fleet requests (many logs identified again), the newest first", "viewer",
          {200: list[FleetView]}),
    Route("GET", "/fleets/folders", "fleet_folders", "Folders of logs", "viewer", {200: list[str]}),
    Route("POST", "/fleets", "ask_fleet", "Identify many logs again; the same request continues with the rest",
          "operator", {202: FleetView}, FleetBody, (403, 409, 422)),
    Route("GET", "/fleets/{fleet}", "fleet", "Progress and results of a fleet request", "viewer", {200: FleetView},
          errors=(404,)),
    Route("POST", "/fleets/{fleet}/stop", "stop_fleet", "End it; finished rows are kept", "operator", {200: FleetView},
          Nothing, (403, 404)),
    Route("GET", "/fleets/{fleet}/rows", "fleet_rows", "One row per log; while it runs, only the rows since its start",
          "viewer", {200: list[dict[str, Any]]}, errors=(404, 422),
          query={"from": "first row (0)", "limit": "most rows to return (200)"}),
    Route("GET", "/fleets/{fleet}/fleet.csv", "fleet_table", "The table of a fleet request", "viewer",
          _file("text/csv"), errors=(404,), headers=_RANGE),
    Route("GET", "/letterhead", "letterhead", "Company, address and logo of the reports", "viewer",
          {200: LetterheadView}),
    Route("POST", "/letterhead", "change_letterhead", "Change company, address and logo of the reports", "admin",
          {200: LetterheadView}, LetterheadBody, (403, 422, 503), longest=512 * KIBIBYTE),
    Route("GET", "/audit", "audit", "The audit: requests, confirmations, stops, downloads", "admin", {200: AuditView},
          query={"limit": "most lines to return (200)", "head": "an exported NUMBER:HASH to check the chain against"}),
    Route("POST", "/login", "login", "Name and password for a session, in two cookies", None, {200: MeView}, LoginBody,
          (401, 403, 422, 429)),
    Route("POST", "/logout", "logout", "End the session", None, {200: MeView}, Nothing, (403, 422)),
    Route("GET", "/me", "me", "The client as the service identifies it", None, {200: MeView}),
    Route("POST", "/password", "password", "Change the user's own password; ends all sessions of the user", "viewer",
          {200: MeView}, PasswordBody, (422, 429, 503)),
    Route("GET", "/accounts", "accounts", "Users and machines", "admin", {200: AccountsView}),
    Route("POST", "/users", "add_user", "Add a user", "admin", {201: AccountView}, UserBody, (422, 503)),
    Route("POST", "/users/{user}/password", "set_password", "Set a user's password; ends the user's sessions", "admin",
          {200: AccountView}, NewPasswordBody, (404, 422, 503)),
    Route("POST", "/users/{user}/remove", "remove_user", "Remove a user", "admin", {200: AccountsView}, Nothing,
          (404, 422, 503)),
    Route("POST", "/tokens", "add_token", "Add a machine's token, which is shown only once", "admin", {201: TokenView},
          TokenBody, (422, 503)),
    Route("POST", "/tokens/{token}/remove", "remove_token", "Remove a token", "admin", {200: AccountsView}, Nothing,
          (404, 422, 503)),
    Route("GET", "/healthz", "health", "Health of the service", None, {200: HealthView}),
    Route("GET", "/metrics", "metrics", "Metrics for Prometheus", "viewer", {200: "text/plain"}),
    Route("GET", "/openapi.json", "openapi", "This document", None, {200: "application/json"}),
)

CSRF_HEADER: Final = "X-CSRF-Token"


@dataclass(frozen=True)
class Socket:
    """A WebSocket; ``protocols``: a client must offer one of these sub-protocols, if there are any."""

    path: str
    name: str
    summary: str
    role: Role
    protocols: tuple[str, ...] = ()


SOCKETS: Final = (
    Socket("/live/{run}", "watch", "A run from its start, live: hello, then news (JSON)", "viewer"),
    Socket("/foxglove/{rig}", "foxglove", "The log of the rig's run as it grows, for Foxglove and Lichtblick", "viewer",
           PROTOCOLS),
)
"""WebSockets, below the API and also at the root."""


@cache
def adapter(kind: Any) -> TypeAdapter[Any]:
    """Return pydantic's adapter for a type of this module."""
    return TypeAdapter(kind)


def plain(value: Any, kind: Any) -> Any:
    """Return a value of this type as plain data for JSON."""
    return adapter(kind).dump_python(value, mode="json")


@cache
def document() -> dict[str, Any]:
    """Return the OpenAPI document."""
    schemas: dict[str, Any] = {}

    def security(role: Role | None) -> dict[str, Any]:
        return {"x-role": role or "anybody", "security": [] if role is None else [{"session": []}, {"token": []}]}

    def schema(kind: Any, mode: Literal["validation", "serialization"] = "serialization") -> dict[str, Any]:
        if kind in OBJECTS:
            text, options = OBJECTS[kind]
            rig = {"type": "string", "description": "rig of the recording as you state it, '' for none"}
            return {"type": "object", "description": text, "properties": {
                **({"rig": rig} if kind == RECORDING else {}),
                **{name: option_schema(one) for name, one in options.items()}}}
        found = adapter(kind).json_schema(mode=mode, ref_template="#/components/schemas/{model}")
        schemas.update(found.pop("$defs", {}))
        if isinstance(kind, type) and found.get("type") == "object":
            schemas[kind.__name__] = found
            return {"$ref": f"#/components/schemas/{kind.__name__}"}
        return found

    error = {"description": "refused", "content": {"application/json": {"schema": schema(ErrorView)}}}
    paths: dict[str, Any] = {}
    for route in ROUTES:
        responses: dict[str, Any] = {}
        for code, kind in route.answers.items():
            files = kind if isinstance(kind, tuple) else (kind,) if isinstance(kind, str) else ()
            content: dict[str, Any] = {media: {} for media in files} or {"application/json": {"schema": schema(kind)}}
            responses[str(code)] = {"description": route.summary, "content": content}
        closed = () if route.role is None else (401, 403)
        writes = () if route.method == "GET" else (NO_ROOM,)
        responses |= {str(code): error for code in sorted({*route.errors, *closed, *writes})}
        parameters = [
            {"name": part[1:-1], "in": "path", "required": True, "schema": {"type": "string"}}
            for part in route.path.split("/") if part.startswith("{")
        ]
        changes = {CSRF_HEADER: "with a session: the value of its second cookie"} if route.method != "GET" else {}
        for where, named in (("query", route.query), ("header", {**route.headers, **changes})):
            parameters += [{"name": name, "in": where, "description": text, "schema": {"type": "string"}}
                           for name, text in named.items()]
        described: dict[str, Any] = {
            "operationId": route.name, "summary": route.summary, "parameters": parameters, "responses": responses,
            **security(route.role),
        }
        if route.body == FILE:
            described["requestBody"] = {"content": {"application/octet-stream": {
                "schema": {"type": "string", "format": "binary"}}}}
        elif route.body is not None:
            described["requestBody"] = {"content": {"application/json": {"schema": schema(route.body, "validation")}}}
        paths.setdefault(f"{API}{route.path}", {})[route.method.lower()] = described
    for one in SOCKETS:
        name = one.path.rpartition("{")[2][:-1]
        paths[f"{API}{one.path}"] = {"get": {
            "operationId": one.name, "summary": one.summary, "x-websocket": list(one.protocols), **security(one.role),
            "parameters": [{"name": name, "in": "path", "required": True, "schema": {"type": "string"}},
                           {"name": "token", "in": "query", "schema": {"type": "string"},
                            "description": "a machine's token, for browsers, which can't send a header"}],
            "responses": {"101": {"description": "WebSocket; closed with 4401 without a login, 4403 for a lower role"},
                          **dict.fromkeys(("400", "401", "403", "404", "426"), error)},
        }}
    return {
        "openapi": "3.1.0",
        "info": {"title": "tdhil", "version": __version__,
                 "description": "Runs that identify a moment of inertia. A stop over HTTP is no emergency stop."},
        "paths": paths,
        "components": {"schemas": schemas, "securitySchemes": {
            "token": {"type": "http", "scheme": "bearer", "description": "a machine's token: tdhil serve tokens add"},
            "session": {"type": "apiKey", "in": "cookie", "name": "__Host-tdhil-8420",
                        "description": "from POST /login; the number is the port of the address"},
        }},
    }
