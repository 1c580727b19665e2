"""Output of results: terminal, JSON, HTML and PDF."""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from tdhil.report.acceptance import AcceptanceVerdict as AcceptanceVerdict, acceptance_of as acceptance_of
    from tdhil.report.blocks import (
        Column as Column, Picture as Picture, Report as Report, ReportSection as ReportSection, Table as Table,
        Text as Text, reference_of as reference_of, shown_date as shown_date,
    )
    from tdhil.report.card import (
        card_html as card_html, card_text as card_text, inertia_text as inertia_text, minutes as minutes,
        print_card as print_card,
    )
    from tdhil.report.console import (
        PlainConsole as PlainConsole, names_and_texts as names_and_texts, stderr_console as stderr_console,
        working as working,
    )
    from tdhil.report.document import (
        SIMULATED as SIMULATED, marks as marks, rehearsal_of as rehearsal_of, rehearsed_faults as rehearsed_faults,
        result_document as result_document, run_facts as run_facts, text_of as text_of,
    )
    from tdhil.report.verification import (
        print_verification as print_verification, verification_document as verification_document,
        verification_report as verification_report, write_verification_report as write_verification_report,
    )
    from tdhil.report.evaluation import (
        evaluation_document as evaluation_document, evaluation_report as evaluation_report,
        print_evaluation as print_evaluation, write_evaluation_report as write_evaluation_report,
    )
    from tdhil.report.frequency_response import (
        draw_bode as draw_bode, draw_faults as draw_faults, draw_responses as draw_responses,
        print_responses as print_responses, response_sentences as response_sentences, save_responses as save_responses,
    )
    from tdhil.report.graphs import GRAPHS as GRAPHS
    from tdhil.report.inertia_scope import InertiaScope as InertiaScope, scope_text as scope_text
    from tdhil.report.html import (
        ShownPicture as ShownPicture, check_report_path as check_report_path, pictures_in as pictures_in,
        write_blocks as write_blocks, write_report as write_report,
    )
    from tdhil.report.intervals import (
        coverage_of as coverage_of, rounded as rounded, with_interval as with_interval,
    )
    from tdhil.report.letterhead import (
        LONGEST_LINE as LONGEST_LINE, MOST_LINES as MOST_LINES,
        NO_LETTERHEAD as NO_LETTERHEAD, Letterhead as Letterhead, clean_logo as clean_logo,
        load_letterhead as load_letterhead,
    )
    from tdhil.report.live import LiveDisplay as LiveDisplay
    from tdhil.report.page import (
        STYLE as STYLE, has_extra as has_extra, inline_svg as inline_svg,
        install_command as install_command,
        repeatable_figures as repeatable_figures, require_extra as require_extra,
    )
    from tdhil.report.plots import draw_run as draw_run
    from tdhil.report.factor_calibration import (
        factor_report as factor_report, known_pipe_document as known_pipe_document,
        pairs_document as pairs_document, print_factor as print_factor, reference_document as reference_document,
    )
    from tdhil.report.speed_calibration import (
        print_speed_calibration as print_speed_calibration, speed_document as speed_document,
        speed_report as speed_report,
    )
    from tdhil.report.torque_calibration import (
        calibration_document as calibration_document, calibration_report as calibration_report,
        draw_calibration as draw_calibration, print_calibration as print_calibration,
    )
    from tdhil.report.severity import (
        print_severity as print_severity, severity_document as severity_document,
        severity_report as severity_report,
    )
    from tdhil.report.operator_map import map_document as map_document
    from tdhil.report.speed_loop import (
        LoopTunedFor as LoopTunedFor, loop_document as loop_document, loop_report as loop_report,
        print_loop_tuning as print_loop_tuning, save_loop_picture as save_loop_picture,
    )
    from tdhil.report.schedule import schedule_document as schedule_document
    from tdhil.report.tuning import (
        TunedFor as TunedFor, print_tuning as print_tuning, showcase_of as showcase_of,
        tuning_document as tuning_document, tuning_report as tuning_report,
    )
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "acceptance": "AcceptanceVerdict acceptance_of",
        "blocks": "Column Picture Report ReportSection Table Text reference_of shown_date",
        "card": "card_html card_text inertia_text minutes print_card",
        "console": "PlainConsole names_and_texts stderr_console working",
        "document": "SIMULATED marks rehearsal_of rehearsed_faults result_document run_facts text_of",
        "verification": "print_verification verification_document verification_report write_verification_report",
        "evaluation": "evaluation_document evaluation_report print_evaluation write_evaluation_report",
        "frequency_response": "draw_bode draw_faults draw_responses print_responses response_sentences save_responses",
        "graphs": "GRAPHS",
        "intervals": "coverage_of rounded with_interval",
        "inertia_scope": "InertiaScope scope_text",
        "html": "ShownPicture check_report_path pictures_in write_blocks write_report",
        "letterhead": "LONGEST_LINE MOST_LINES NO_LETTERHEAD Letterhead clean_logo load_letterhead",
        "live": "LiveDisplay",
        "page": "STYLE has_extra inline_svg install_command repeatable_figures require_extra",
        "plots": "draw_run",
        "speed_calibration": "print_speed_calibration speed_document speed_report",
        "torque_calibration": "calibration_document calibration_report draw_calibration print_calibration",
        "operator_map": "map_document",
        "severity": "print_severity severity_document severity_report",
        "schedule": "schedule_document",
        "speed_loop": "LoopTunedFor loop_document loop_report print_loop_tuning save_loop_picture",
        "tuning": "TunedFor print_tuning showcase_of tuning_document tuning_report",
        "factor_calibration": "factor_report known_pipe_document pairs_document print_factor reference_document",
    })
