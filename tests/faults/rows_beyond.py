"""What was found beyond the fifty by trying it on the rig floor, numbered on from 51, a section a room."""

from row import HERE, Row

LATE: dict[int, Row] = {
    51: Row("adapter or host late: the answers of many SYNCs come in a burst", "counted as late; nobody else is blamed",
            "0, 5", ("tests/drivers/test_late_host.py::test_an_adapter_that_hands_everything_on_at_once_is_nobody_else",
                     "tests/drivers/test_feedback.py::test_a_late_answer_is_never_another_syncs",
                     "tests/drivers/test_feedback.py::test_somebody_who_sends_too_is_found_however_late_the_host_was"),
            "each answer is given to its own SYNC, or the cycle has no sample; more answers than SYNCs are foreign"),
    52: Row("host stood still (SIGSTOP, load): the drive's silence and its watchdog's word follow",
            "the stall is told first", "5",
            ("tests/drivers/test_late_host.py::test_a_stall_is_told_before_what_the_drive_did_meanwhile",
             "tests/drivers/test_late_host.py::test_a_short_stall_is_told_before_a_heartbeat_that_is_missing",
             "tests/drivers/test_late_host.py::test_half_of_the_watchdogs_time_is_the_longest_stall"),
            "\"this computer was late: its control loop stood still for …\" comes before what was seen on the bus"),
    53: Row("Ctrl-C, or a trip of the guard, while the rest of the run is planned", "QS in the next cycle", "130, 7",
            ("tests/protocol/test_deaf.py::test_the_stop_does_not_wait_for_arithmetic",
             "tests/protocol/test_deaf.py::test_a_process_ends_although_arithmetic_that_was_left_alone_goes_on"),
            "the plan is dropped, not waited for; it was before, and nothing was sent meanwhile"),
    54: Row("a busy computer, in stepped time (answers take seconds, or are lost)", "the run is the same", "as without",
            ("tests/drivers/test_drive_faults.py::test_in_stepped_time_nothing_is_late",
             "tests/drivers/test_drive_faults.py::test_in_stepped_time_what_is_lost_is_lost_on_any_computer",
             "tests/drivers/test_drive_faults.py::test_a_dead_peer_ends_a_wait_and_costs_little_from_then_on"),
            "the peer is asked whether anything is still to come; nothing but a dead one (4 s) ends a wait"),
    55: Row("this computer doesn't hold the profile's rate", "a lower one, chosen and said before motion", "0",
            ("tests/protocol/test_choose_rate.py::"
             "test_the_highest_rate_whose_half_period_is_longer_than_the_delay",
             "tests/protocol/test_choose_rate.py::test_the_runner_tries_before_motion_and_goes_on_at_that_rate"),
            "the highest of which 999 cycles of 1000 are in time by half a period"),
}

SECOND = f"{HERE}test_second_master_rows.py::"
STRANGERS = "tests/drivers/test_strangers.py::"

SECOND_MASTER: dict[int, Row] = {
    56: Row("another node bears the host's number: its heartbeat feeds the drive's watchdog",
            "a free number from the start; QS in motion, however slow it is", "0, 5",
            (f"{SECOND}test_noticed_and_stopped", f"{SECOND}test_a_number_that_is_taken_from_the_start",
             f"{STRANGERS}test_a_number_that_another_node_bears_is_not_taken",
             f"{STRANGERS}test_one_that_comes_before_motion_is_refused")),
    57: Row("a tool writes watchdog or reaction in motion", "read back at once, QS", "5",
            (f"{SECOND}test_noticed_and_stopped",)),
    58: Row("watchdog, quick stop or a limit changed at the drive's panel in motion", "read back, QS", "5",
            (f"{SECOND}test_noticed_and_stopped",
             f"{STRANGERS}test_a_setting_that_somebody_changes_in_motion_ends_the_run")),
    59: Row("a second master's setpoints in another RPDO", "that RPDO is off; QS, at rest", "5",
            (f"{SECOND}test_noticed_and_stopped", f"{STRANGERS}test_other_rpdos_are_switched_off_and_given_back")),
    60: Row("a second master's setpoints by SDO, or by another fieldbus", "QS, at rest", "5",
            (f"{SECOND}test_noticed_and_stopped",
             f"{STRANGERS}test_a_speed_in_the_drive_that_is_not_ours_ends_the_run")),
    61: Row("a stray SDO that the cycle undoes", "told in log, result and at the end", "0, 9",
            (f"{SECOND}test_stray_writes_that_the_cycle_undoes_are_told",)),
    62: Row("a drive that doesn't take the quick stop", "the host falls silent; WD", "6, 8",
            (f"{SECOND}test_a_drive_that_does_not_take_the_quick_stop",)),
    63: Row("`tdhil stop` in torque mode, where the drive's quick stop lets go", "speed mode at zero first", "0",
            ("tests/drivers/test_bare_stop.py::test_in_torque_mode_it_is_braked_and_never_let_go_while_it_turns",),
            "braked to rest, never off while it turned"),
    64: Row("the drive's own limits are tighter than rig.yaml's", "they stay, or R; widened by name only", "0, 4",
            ("tests/drivers/test_preflight.py::test_a_tighter_limit_of_the_drive_s_own_stays",
             "tests/drivers/test_preflight.py::test_it_is_widened_by_name_and_no_other_with_it",
             "tests/protocol/test_run_refused.py::test_limits_of_the_drive_that_leave_no_room"),
            "kept, and the run keeps within them"),
    65: Row("a killed host leaves its limits in the drive", "named by doctor, given back by the next run", "-",
            ("tests/drivers/test_left_behind.py::test_the_next_run_gives_back_what_a_killed_one_left",
             "tests/drivers/test_left_behind.py::test_each_is_written_down_before_it_is_changed",
             "tests/path/test_doctor.py::test_what_a_killed_run_left_in_a_drive_is_named"),
            "named, and given back before the next run looks at the drive's limits"),
}

MODBUS: dict[int, Row] = {
    70: Row(
        "Modbus drive whose watchdog any client's request feeds: a reader keeps it running when the host is killed",
        "R, unless the operator accepts it by name; requests of others are counted where the drive counts them", "4",
        (HERE + "test_modbus_second_master.py",),
    ),
    71: Row(
        "another master writes control word and setpoints over Modbus in motion, 5 to 100 times a second",
        "noticed by reading them back; QS that stands against it (stop word repeated, the drive's own speed limit"
        " lowered along the ramp); 8 where that one still commands at the end", "5, 8",
        (HERE + "test_modbus_second_master.py",),
    ),
    72: Row(
        "somebody sets the Modbus watchdog, its reaction or a limit in motion",
        "read back during the run: QS, naming register, old and new value", "5",
        (HERE + "test_modbus_second_master.py",),
    ),
    73: Row(
        "the drive's own torque or speed limit, or quick stop, is tighter than rig.yaml's (Modbus)",
        "it stays and the run keeps within it; made wider by name only, old and new value told, given back", "",
        ("tests/drivers/test_modbus_preflight.py::test_limits_that_are_tighter_stay_and_the_run_keeps_within_them",
         "tests/drivers/test_modbus_preflight.py::test_a_limit_is_widened_by_name_no_other_with_it_and_given_back"),
        "kept as found; `--accept-wider-limit torque`: 0.375 of rated torque (was 0.1 …: wider, accepted by …)",
    ),
    74: Row(
        "`tdhil stop` in torque mode where a quick stop doesn't decelerate, and where the drive's watchdog coasts",
        "speed mode at zero first, the stop word again while the shaft turns: braked to rest, never let go", "0",
        ("tests/drivers/test_modbus_bare_stop.py::test_it_brakes_to_rest_and_never_lets_go",),
        "every shipped Modbus profile, in each of its modes",
    ),
    75: Row(
        "`tdhil stop` against a dead host, a closed port, a dead hub, a device that isn't there",
        "8 and: STOP NOT CONFIRMED: use the hard-wired emergency stop now", "8",
        ("tests/path/test_stop_command.py::test_where_nobody_is_reached",
         "tests/path/test_stop_command.py::test_a_hub_that_dies_while_it_stops"),
        "the sentence on stdout, in the JSON document too",
    ),
}

UNITS: dict[int, Row] = {
    80: Row("profile's unit of speed too small by 2 to 10, and no object of the drive contradicts it",
            "found at walking pace by the drive's angle, with its factor; the true shaft stays below speed_max", "4",
            (HERE + "test_speed_unit.py",)),
    81: Row("the same in a drive that tells no angle", "the operator is asked at speed_max/20; his no ends it", "4",
            (HERE + "test_speed_unit.py",)),
    82: Row("the same, with nobody at a terminal", "R at that speed, unless the unit is taken by name", "4",
            (HERE + "test_speed_unit.py",)),
    83: Row("the drive's angle counts against its reported speed", "R, naming the sign", "4",
            (HERE + "test_speed_unit.py",)),
    84: Row("the drive's angle stands still while it reports that the shaft turns", "the operator is asked", "4",
            (HERE + "test_speed_unit.py",)),
}

STAGES: dict[int, Row] = {
    85: Row("a drill string, and a drive whose quick stop lets go of it", "R", "4",
            ("tests/faults/test_stage_rows.py::test_a_string_and_a_quick_stop_that_lets_go",
             "tests/protocol/test_stop_string.py::test_what_a_string_forbids",
             "tests/drivers/test_preflight.py::test_whether_a_quick_stop_holds_the_shaft")),
    86: Row("somebody else drives the shaft on against the quick stop", "the drive is fed no more: WD", "as its cause",
            ("tests/protocol/test_stop_looks.py::"
             "test_a_shaft_that_somebody_drives_on_is_left_to_the_watchdog_and_watched",),
            "no slower for 3 s: no sign of life goes out any more, the drive's watchdog stops it, and that is seen"),
    87: Row("a scripted fault whose moment the run does not reach", "said at the end", "as without",
            ("tests/faults/test_stage_rows.py::test_a_fault_that_never_comes_is_said",)),
    88: Row("a mode that is lost in motion", "QS", "6",
            ("tests/faults/test_stage_rows.py::test_a_mode_that_is_lost_in_motion",
             "tests/protocol/test_guard_follows.py::test_a_mode_that_is_lost_trips_once_it_can_be_no_late_frame")),
    89: Row("a shaft that does not follow in speed mode", "following error: QS", "7",
            ("tests/faults/test_stage_rows.py::test_a_shaft_that_does_not_follow_in_speed_mode",
             "tests/protocol/test_guard_follows.py::test_a_shaft_that_stays_at_another_speed_trips",
             "tests/protocol/test_guard_follows.py::test_no_rig_that_does_what_it_can_trips")),
    90: Row("a log that is removed, cut short, or whose thread dies", "said at once: QS", "3",
            ("tests/faults/test_stage_rows.py::test_a_log_that_is_taken_away",
             "tests/record/test_writer.py::test_a_log_that_was_taken_away_is_told_at_once",
             "tests/record/test_writer.py::test_a_log_whose_thread_died_is_told_within_a_second")),
}

STREAMS = "tests/path/test_streams.py::"
FILES = "tests/path/test_files_of_a_run.py::"
COMMAND_LINE: dict[int, Row] = {
    95: Row("rig.yaml confirms in the operator's place (run: yes, accept_no_watchdog …)", "refused, with the line and "
            "the flag; consent to a profile's entries counts for the profile of the same file only", "2",
            ("tests/tdhil/test_only_the_operator.py::test_a_file_does_not_confirm",
             "tests/tdhil/test_only_the_operator.py::test_nothing_that_the_operator_answers_for_stands_in_a_file",
             "tests/tdhil/test_only_the_operator.py::test_consent_in_a_file_is_for_the_profile_of_that_file"),
            "the key is named with its line, nothing is connected to"),
    96: Row("a quantity in rig.yaml in another unit than the key's (speed_max_rad_s: 100 rpm, speed_max_rpm)",
            "converted and shown both ways, or refused without offering a number; both forms of a key are refused",
            "0, 2", ("tests/tdhil/test_rig_units.py::test_a_value_with_its_unit_is_converted_and_both_are_told",
             "tests/tdhil/test_rig_units.py::test_a_key_in_the_manual_s_unit",
             "tests/tdhil/test_rig_units.py::test_what_is_refused_offers_no_wrong_number"),
            "100 rpm = 10.47 rad/s in settings, dry run and prompt"),
    97: Row("a bit rate that CAN doesn't have (500 for 500k)", "refused wherever it stands; the nearest is named", "2",
            ("tests/tdhil/test_rig_units.py::test_the_command_line_and_the_environment_know_the_same_rates",
             "tests/tdhil/test_rig_units.py::test_bit_rates_that_can_does_not_have"),
            "500 bit/s is none of CAN's; 500k is one"),
    98: Row("two runs log into one folder", "a live log is never moved; the second takes a name of its own and says it",
            "-", (f"{FILES}test_a_live_log_is_never_moved", f"{FILES}test_runs_begun_at_once_share_no_file",
                  f"{FILES}test_a_second_run_in_the_folder_of_a_live_one_says_where_its_log_is"),
            "the second's log is run-<date>.mcap, as its settings, its end and its JSON say"),
    99: Row("a run that is refused, where the last good log is", "the last good log keeps its name", "as the refusal's",
            (f"{FILES}test_a_refusal_leaves_the_last_good_log_in_its_place",
             f"{FILES}test_a_bus_that_can_not_be_opened_is_no_reason_to_lose_the_last_log_s_name"),
            "the refusal is logged in run.refused.mcap"),
    100: Row("--log, --report or --trace names a file that isn't theirs (rig.yaml)", "R; the file stays as it is", "2",
             (f"{FILES}test_no_file_of_somebody_else_is_touched",
              f"{FILES}test_a_replay_s_report_goes_over_nothing_either"),
             "named with the option; not even a log was begun"),
    101: Row("stdout full, closed or ASCII only at the end of a run; no descriptor left",
             "the run ends as it should, the card goes to stderr, the result is in the log",
             "3 (full), else as the result",
             (f"{STREAMS}test_a_full_device_at_the_end_of_a_run", f"{STREAMS}test_no_stdout_at_all",
              f"{STREAMS}test_an_encoding_that_lacks_our_signs",
              f"{STREAMS}test_nothing_is_loaded_once_the_shaft_may_move"),
             "no module is loaded once the shaft may move"),
    102: Row("a drive's name (1008h), a profile's title, a file's name with terminal escapes, markup or line breaks",
             "shown, never obeyed", "-",
             ("tests/report/test_foreign_text.py::test_the_preflight_table_and_the_prompt",
              "tests/report/test_foreign_text.py::test_a_profile_s_title",
              "tests/report/test_foreign_text.py::test_a_console_obeys_nothing"),
             "a sign that is seen and does nothing; no line of its own in what the operator confirms"),
}

LOG: dict[int, Row] = {
    105: Row("replay of a run that was aborted and came to rest", "what came before the abort counts; it is named", "3",
             ("tests/path/test_replay_ended.py::test_an_aborted_run_is_a_partial_result",
              "tests/identify/test_aborted.py::test_whatever_follows_the_abort_the_result_is_the_same"),
             "result with a warning that names stage and cause"),
    106: Row("replay of a run that was refused, or ended in setup", "its refusal is said", "the run's own",
             ("tests/path/test_replay_ended.py::test_a_refused_run_says_its_refusal",),
             "what, where, and the next step"),
    107: Row("replay on another kind of processor", "numbers the same to 1e-9, words the same", "the run's own",
             ("tests/path/test_two_kernels.py::test_a_replay_under_other_kernels",
              "tests/identify/test_quality.py::test_rounding_does_not_decide_whether_a_period_is_wrong"),
             "the same result"),
}

BEYOND = LATE | SECOND_MASTER | MODBUS | UNITS | STAGES | COMMAND_LINE | LOG
