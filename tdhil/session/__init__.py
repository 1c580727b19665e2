"""One run, from the request to a closed log: connection, confirmation, log files."""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from tdhil.session.conclusion import conclude as conclude, conclude_run as conclude_run
    from tdhil.session.confirm import (
        confirm_mounted as confirm_mounted, require_terminal as require_terminal,
        CallbackOperator as CallbackOperator, TerminalOperator as TerminalOperator, motion_summary as motion_summary,
    )
    from tdhil.session.connection import (
        connection_of as connection_of, simulated_connection as simulated_connection,
    )
    from tdhil.session.drive_lock import (
        DriveHeld as DriveHeld, Holder as Holder, address_of as address_of, hold as hold, holder_of as holder_of,
        holders as holders,
    )
    from tdhil.session.dry_run import (
        BEFORE_ACQUIRE_S as BEFORE_ACQUIRE_S, Figure as Figure, plan_course as plan_course,
        plan_dry_steps as plan_dry_steps,
        plan_document as plan_document, plan_dry as plan_dry,
    )
    from tdhil.session.evaluation import (
        evaluation_case as evaluation_case, is_evaluation as is_evaluation,
        load_tuning as load_tuning,
    )
    from tdhil.session.kept import connection_of_kept as connection_of_kept, kept_connection as kept_connection
    from tdhil.session.log_files import (
        check_different_files as check_different_files, check_log_path as check_log_path, is_live as is_live,
        make_room as make_room,
    )
    from tdhil.session.open_drive import (
        opened_drive as opened_drive, plan_peer as plan_peer, with_faults as with_faults,
    )
    from tdhil.session.overrides import (
        UNVERIFIED_FLAG as UNVERIFIED_FLAG, check_unverified as check_unverified, doubtful as doubtful,
        is_accepted as is_accepted,
    )
    from tdhil.session.reference_calibration import (
        date_of_log as date_of_log, find_by_known_pipe as find_by_known_pipe,
        find_by_reference as find_by_reference, gear_before as gear_before, known_pipe_of as known_pipe_of,
        log_of_calibration as log_of_calibration,
    )
    from tdhil.session.pace import PaceMeasured as PaceMeasured, measure_pace as measure_pace
    from tdhil.session.rehearsal import (
        ANY_FAULT as ANY_FAULT, REQUIRED as REQUIRED, Rehearsal as Rehearsal, RehearsalVerdict as RehearsalVerdict,
        RehearsedShaft as RehearsedShaft, RequiredReaction as RequiredReaction, judge_rehearsal as judge_rehearsal,
        required_reaction as required_reaction,
    )
    from tdhil.session.rig_text import (
        LIMIT_KEYS as LIMIT_KEYS, STRING_KEYS as STRING_KEYS, RigEntries as RigEntries, blank_rig as blank_rig,
        by_hand as by_hand, starter as starter, to_fill_in as to_fill_in,
    )
    from tdhil.session.run_record import (
        RunRecord as RunRecord, ByKeyword as ByKeyword, check_lags as check_lags, is_log as is_log, read as read,
        require_file as require_file, trace_arguments as trace_arguments, write_as_log as write_as_log,
    )
    from tdhil.session.run_session import (
        OperatorInterface as OperatorInterface, RunRequest as RunRequest,
        RunSession as RunSession,
    )
    from tdhil.session.verification import (
        is_verification as is_verification,
        load_step_case as load_step_case,
    )
    from tdhil.session.speed_calibration import (
        SECONDS_SD as SECONDS_SD, SPEED_REL_SD as SPEED_REL_SD, TURNS_SD as TURNS_SD, TurnsCount as TurnsCount,
        add_speed_calibration as add_speed_calibration, check_speed_place as check_speed_place,
        speed_by_position as speed_by_position, speed_by_turns as speed_by_turns,
    )
    from tdhil.session.stored_calibration import (
        drive_identity as drive_identity, drive_settings as drive_settings, load_calibration as load_calibration,
        save_calibration as save_calibration, with_calibration as with_calibration,
    )
    from tdhil.session.stop_signals import Ending as Ending, stop_on_signals as stop_on_signals
    from tdhil.session.task import (
        bench_of as bench_of, excitation_request as excitation_request, facts as facts,
        machine_limits as machine_limits, stated_lags as stated_lags, suited as suited,
    )
    from tdhil.session.torque_calibration import (
        ASSUMED_BODY_REL_SD as ASSUMED_BODY_REL_SD, CalibrationFound as CalibrationFound,
        CalibrationRun as CalibrationRun, document_of_calibration as document_of_calibration,
        find_calibration as find_calibration, find_plan as find_plan, read_pairs as read_pairs,
    )
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "conclusion": "conclude conclude_run",
        "confirm": "confirm_mounted require_terminal CallbackOperator TerminalOperator motion_summary",
        "connection": "connection_of simulated_connection",
        "drive_lock": "DriveHeld Holder address_of hold holder_of holders",
        "dry_run": "BEFORE_ACQUIRE_S Figure plan_course plan_document plan_dry plan_dry_steps",
        "evaluation": "evaluation_case is_evaluation load_tuning",
        "verification": "is_verification load_step_case",
        "kept": "connection_of_kept kept_connection",
        "log_files": "check_different_files check_log_path is_live make_room",
        "open_drive": "opened_drive plan_peer with_faults",
        "overrides": "UNVERIFIED_FLAG check_unverified doubtful is_accepted",
        "pace": "PaceMeasured measure_pace",
        "rehearsal": "ANY_FAULT REQUIRED Rehearsal RehearsalVerdict RehearsedShaft RequiredReaction judge_rehearsal "
                     "required_reaction",
        "rig_text": "LIMIT_KEYS STRING_KEYS RigEntries blank_rig by_hand starter to_fill_in",
        "run_record": "RunRecord ByKeyword check_lags is_log read require_file trace_arguments "
                      "write_as_log",
        "run_session": "OperatorInterface RunRequest RunSession",
        "speed_calibration": "SECONDS_SD SPEED_REL_SD TURNS_SD TurnsCount add_speed_calibration check_speed_place "
                             "speed_by_position speed_by_turns",
        "stored_calibration": "drive_identity drive_settings load_calibration save_calibration with_calibration",
        "stop_signals": "Ending stop_on_signals",
        "task": "bench_of excitation_request facts machine_limits stated_lags suited",
        "torque_calibration": "ASSUMED_BODY_REL_SD CalibrationFound CalibrationRun document_of_calibration "
                              "find_calibration find_plan read_pairs",
        "reference_calibration": "date_of_log find_by_known_pipe find_by_reference gear_before known_pipe_of "
                                 "log_of_calibration",
    })
