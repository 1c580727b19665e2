"""Recording of samples to run.mcap, and reading of run.mcap as a Recording."""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from tdhil.recording.builder import RecordingBuilder as RecordingBuilder, RecordingPart as RecordingPart
    from tdhil.recording.csv import (
        Bench as Bench, GAP_INTERVALS as GAP_INTERVALS, REFERENCE_FLAG as REFERENCE_FLAG,
        ReferenceTrace as ReferenceTrace,
        TIME_AND_TORQUE as TIME_AND_TORQUE, USUAL as USUAL, parse_columns as parse_columns,
        TraceSurvey as TraceSurvey, column_mistakes as column_mistakes,
        motion_of as motion_of,
        read_recording as read_recording, read_reference as read_reference, survey_trace as survey_trace,
        units_of as units_of,
    )
    from tdhil.recording.log_audit import (
        LogAudit as LogAudit, audit_log as audit_log, messages_of as messages_of, texts_of_message as texts_of_message,
    )
    from tdhil.recording.log_format import (
        CAN as CAN, CHANNELS as CHANNELS, CLASSES as CLASSES, COMMAND as COMMAND, EXCITATION as EXCITATION,
        FRAME_CHANNELS as FRAME_CHANNELS, LiveInertia as LiveInertia, RAW_FRAMES as RAW_FRAMES, REHEARSAL as REHEARSAL,
        SAMPLE as SAMPLE, VIRTUAL_COLUMNS as VIRTUAL_COLUMNS, VIRTUAL_STRING as VIRTUAL_STRING,
        schema_name as schema_name,
    )
    from tdhil.recording.log_reader import read_cycles as read_cycles, read_frames as read_frames, read_run as read_run
    from tdhil.recording.log_tail import (
        LogChunks as LogChunks, LoggedMessage as LoggedMessage, LogNews as LogNews, LogTail as LogTail,
        messages_in as messages_in,
    )
    from tdhil.recording.log_writer import RunWriter as RunWriter
    from tdhil.recording.mcap_container import schema_of as schema_of
    from tdhil.recording.npz_cache import pack_recording as pack_recording, unpack_recording as unpack_recording
    from tdhil.recording.recording import (
        BoolArray as BoolArray, Excitation as Excitation, FloatArray as FloatArray, ImpedanceInput as ImpedanceInput,
        IntArray as IntArray,
        LagPrior as LagPrior, Level as Level, Pipe as Pipe, Ramp as Ramp, Recording as Recording, Segment as Segment,
        Stage as Stage, SteppedSetpoint as SteppedSetpoint,
        TorqueAnswer as TorqueAnswer, ABORTED as ABORTED, aborted_stage as aborted_stage,
        before_abort as before_abort, counts_until_s as counts_until_s,
    )
    from tdhil.recording.run_end import RunEnd as RunEnd, find_ended as find_ended
    from tdhil.recording.run_log import RunLog as RunLog
    from tdhil.recording.sample_table import SAMPLE_COLUMNS as SAMPLE_COLUMNS, write_samples as write_samples
    from tdhil.recording.salvage import Salvage as Salvage, examine as examine, write_copy as write_copy
    from tdhil.recording.trace_log import write_trace_log as write_trace_log
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "builder": "RecordingBuilder RecordingPart",
        "csv": (
            "Bench GAP_INTERVALS USUAL parse_columns read_recording REFERENCE_FLAG ReferenceTrace TIME_AND_TORQUE "
            "read_reference TraceSurvey motion_of column_mistakes survey_trace units_of"
        ),
        "log_audit": "LogAudit audit_log messages_of texts_of_message",
        "log_format": "CAN CHANNELS CLASSES COMMAND EXCITATION FRAME_CHANNELS LiveInertia RAW_FRAMES REHEARSAL SAMPLE "
                      "VIRTUAL_COLUMNS VIRTUAL_STRING schema_name",
        "log_reader": "read_cycles read_frames read_run",
        "log_tail": "LogChunks LoggedMessage LogNews LogTail messages_in",
        "log_writer": "RunWriter",
        "mcap_container": "schema_of",
        "npz_cache": "pack_recording unpack_recording",
        "recording": "BoolArray Excitation FloatArray ImpedanceInput IntArray LagPrior Level Pipe Ramp Recording "
                     "Segment Stage SteppedSetpoint TorqueAnswer ABORTED aborted_stage before_abort counts_until_s",
        "run_end": "RunEnd find_ended",
        "run_log": "RunLog",
        "sample_table": "SAMPLE_COLUMNS write_samples",
        "salvage": "Salvage examine write_copy",
        "trace_log": "write_trace_log",
    })
