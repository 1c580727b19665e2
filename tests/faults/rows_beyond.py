"""Faults beyond the fifty that trials found, numbered from 51, with one section per room."""

from tests.faults.row import HERE, Row, must

LATE: dict[int, Row] = {
    51: Row("adapter or host late: the answers of many SYNCs come in a burst",
            "counted as late; no other master is blamed", "0, 5",
            ("tests/drivers/test_late_host.py::test_an_adapter_that_hands_everything_on_at_once_is_nobody_else",
             "tests/drivers/test_feedback.py::test_a_late_answer_is_never_another_syncs",
             "tests/drivers/test_feedback.py::test_somebody_who_sends_too_is_found_however_late_the_host_was"),
            "each answer is given to its own SYNC, or the cycle has no sample; more answers than SYNCs are foreign"),
    52: Row("host stood still (SIGSTOP, load): then the drive is silent, or reports its watchdog",
            "the stall is reported first", "5",
            ("tests/drivers/test_late_host.py::test_a_stall_is_told_before_what_the_drive_did_meanwhile",
             "tests/drivers/test_late_host.py::test_a_short_stall_is_told_before_a_heartbeat_that_is_missing",
             "tests/drivers/test_late_host.py::test_half_of_the_watchdogs_time_is_the_longest_stall"),
            "\"this computer was late: its control loop stood still for …\" comes before what was seen on the bus"),
    53: Row("Ctrl-C, or a trip of the guard, while the rest of the run is planned", "QS in the next cycle", "130, 7",
            ("tests/runner/test_deaf.py::test_the_stop_does_not_wait_for_arithmetic",
             "tests/runner/test_deaf.py::test_a_process_ends_although_arithmetic_that_was_left_alone_goes_on"),
            "the run does not wait for the plan, and drops it"),
    54: Row("a busy computer, in stepped time (answers take seconds, or are lost)", "the run is the same", "as without",
            ("tests/drivers/test_drive_faults.py::test_in_stepped_time_nothing_is_late",
             "tests/drivers/test_drive_faults.py::test_in_stepped_time_what_is_lost_is_lost_on_any_computer",
             "tests/drivers/test_drive_faults.py::test_a_dead_peer_ends_a_wait_and_costs_little_from_then_on"),
            "tdhil asks the simulator whether a frame is still to come; a wait ends only after 4 s without an answer"),
    55: Row("this computer doesn't hold the profile's rate", "a lower one, chosen and reported before motion", "0",
            ("tests/runner/test_choose_rate.py::"
             "test_the_highest_rate_whose_half_period_is_longer_than_the_delay",
             "tests/runner/test_choose_rate.py::test_the_runner_tries_before_motion_and_goes_on_at_that_rate"),
            "the highest rate at which 999 of 1000 cycles are late by half a period at most"),
}

SECOND = f"{HERE}test_second_master_rows.py::"
OTHER_MASTER = "tests/drivers/test_other_master.py::"

SECOND_MASTER: dict[int, Row] = {
    56: Row("another node uses the host's number: its heartbeat feeds the drive's watchdog",
            must(56), "0, 5",
            (f"{SECOND}test_noticed_and_stopped",
             f"{SECOND}test_a_number_that_is_taken_from_the_start_is_not_the_host_s",
             f"{OTHER_MASTER}test_a_number_that_another_node_bears_is_not_taken",
             f"{OTHER_MASTER}test_one_that_comes_before_motion_is_refused")),
    57: Row("a tool writes watchdog or reaction in motion", must(57), "5",
            (f"{SECOND}test_noticed_and_stopped",)),
    58: Row("watchdog, quick stop or a limit changed at the drive's panel in motion", must(58), "5",
            (f"{SECOND}test_noticed_and_stopped",
             f"{OTHER_MASTER}test_a_setting_that_somebody_changes_in_motion_ends_the_run")),
    59: Row("a second master's setpoints in another RPDO", must(59), "5",
            (f"{SECOND}test_noticed_and_stopped", f"{OTHER_MASTER}test_other_rpdos_are_switched_off_and_given_back")),
    60: Row("a second master's setpoints by SDO, or by another fieldbus", must(60), "5",
            (f"{SECOND}test_noticed_and_stopped",
             f"{OTHER_MASTER}test_a_speed_in_the_drive_that_is_not_ours_ends_the_run")),
    61: Row("a stray SDO that the cycle undoes", must(61), "0, 9",
            (f"{SECOND}test_stray_writes_that_the_cycle_undoes_are_told",)),
    62: Row("a second master undoes the quick stop again and again", "the host stops transmitting and watches; WD", "5",
            (f"{SECOND}test_a_quick_stop_that_is_undone_again_and_again_is_left_to_the_watchdog",)),
    63: Row("`tdhil stop` in torque mode, on a drive that its quick stop disables", "speed mode at zero first", "0",
            ("tests/drivers/test_quick_stop.py::test_in_torque_mode_it_is_braked_and_never_let_go_while_it_turns",),
            "braked to standstill, never disabled while it turned"),
    64: Row("the drive's own limits are tighter than rig.yaml's", "they stay, or R; widened by name only", "0, 4",
            ("tests/drivers/test_preflight.py::test_a_tighter_limit_of_the_drive_s_own_stays",
             "tests/drivers/test_preflight.py::test_it_is_widened_by_name_and_no_other_with_it",
             "tests/runner/test_run_refused.py::test_limits_of_the_drive_that_leave_no_room"),
            "kept, and the run keeps within them"),
    65: Row("a killed host leaves its limits in the drive", "named by doctor, restored by the next run", "-",
            ("tests/drivers/test_undo_journal.py::test_the_next_run_gives_back_what_a_killed_one_left",
             "tests/drivers/test_undo_journal.py::test_each_is_written_down_before_it_is_changed",
             "tests/path/test_doctor.py::test_what_a_killed_run_left_in_a_drive_is_named"),
            "named, and restored before the next run reads the drive's limits"),
}

MODBUS: dict[int, Row] = {
    66: Row(
        "Modbus drive whose watchdog any client's request feeds: a reader keeps it running when the host is killed",
        "R, unless the operator accepts it by name; requests of others are counted where the drive counts them", "4",
        (HERE + "test_modbus_second_master.py::test_row_66_refused_unless_taken_by_name",),
    ),
    67: Row(
        "another master writes control word and setpoints over Modbus in motion, 5 to 100 times a second",
        "noticed by reading them back; QS that stands against it (stop word repeated, the drive's own speed limit"
        " lowered along the ramp); 8 if that master still commands at the end", "5, 8",
        (HERE + "test_modbus_second_master.py::test_row_67_another_master_commands",),
    ),
    68: Row(
        "another master sets the Modbus watchdog, its reaction or a limit in motion",
        "read back during the run: QS, naming register, old and new value", "5",
        (HERE + "test_modbus_second_master.py::test_row_68_somebody_changes_a_setting_in_motion",),
    ),
    69: Row(
        "the drive's own torque or speed limit, or quick stop, is tighter than rig.yaml's (Modbus)",
        "it stays and the run keeps within it; made wider by name only; old and new value are reported; "
        "restored at the end", "",
        ("tests/drivers/test_modbus_preflight.py::test_limits_that_are_tighter_stay_and_the_run_keeps_within_them",
         "tests/drivers/test_modbus_preflight.py::test_a_limit_is_widened_by_name_no_other_with_it_and_given_back"),
        "kept as found; `--accept-wider-limit torque`: 0.375 of rated torque (was 0.1 …: wider, accepted by …)",
    ),
    70: Row(
        "`tdhil stop` in torque mode where a quick stop doesn't decelerate, and where the drive's watchdog coasts",
        "speed mode at zero first, the stop word again while the shaft turns: braked to standstill, "
        "never disabled while it turns", "0",
        ("tests/drivers/test_modbus_quick_stop.py::test_it_brakes_to_rest_and_never_lets_go",),
        "every shipped Modbus profile, in each of its modes",
    ),
    71: Row(
        "`tdhil stop` against a dead host, a closed port, a dead hub, a device that isn't there",
        "8 and: STOP NOT CONFIRMED: use the hard-wired emergency stop now", "8",
        ("tests/path/test_stop_command.py::test_where_nobody_is_reached",
         "tests/path/test_stop_command.py::test_a_hub_that_dies_while_it_stops"),
        "the sentence on stdout, in the JSON document too",
    ),
    72: Row(
        "RTU: every fifth reply is damaged from some time in motion on",
        "asked for once more within the cycle; whatever ends the run, standstill is seen and confirmed", "0, 5, 9",
        (HERE + "test_modbus_noise.py::test_row_72_it_comes_to_rest_and_that_is_confirmed",),
    ),
    73: Row(
        "Modbus TCP: every reply comes twice; foreign replies again and again; a new connection isn't answered",
        "dropped by their ids; renewed three times in ten seconds at most; never longer than a reply may take", "",
        ("tests/drivers/test_modbus_links.py::test_replies_that_come_twice_cost_nothing",
         "tests/drivers/test_modbus_links.py::test_foreign_replies_cost_the_connection_a_few_times_only",
         "tests/drivers/test_modbus_links.py::test_opening_anew_never_takes_longer_than_a_reply_may"),
        "one connection for fifty doubled replies; the cycle goes on while a new connection is opened",
    ),
}

UNITS: dict[int, Row] = {
    74: Row("profile's unit of speed too small by 2 to 10, and no object of the drive contradicts it",
            "found at walking pace by the drive's angle, with its factor; the true shaft stays below speed_max", "4",
            (HERE + "test_speed_unit.py::test_the_angle_shows_a_unit_that_is_too_small",)),
    75: Row("the same in a drive that reports no angle",
            "tdhil asks the operator at speed_max/20; the answer no ends the run", "4",
            (HERE + "test_speed_unit.py::test_without_an_angle_the_operator_says_no",)),
    76: Row("the same, without a terminal", "R at that speed, unless the unit is accepted by name", "4",
            (HERE + "test_speed_unit.py::test_without_an_angle_and_with_nobody_there",)),
    77: Row("the drive's angle counts against its reported speed", "R, naming the sign", "4",
            (HERE + "test_speed_unit.py::test_an_angle_that_counts_backwards",)),
    78: Row("the drive's angle stands still while it reports that the shaft turns", "the operator is asked", "4",
            (HERE + "test_speed_unit.py::test_an_angle_that_stands_still_is_put_to_the_operator",)),
}

STAGES: dict[int, Row] = {
    79: Row("a drill string, and a drive whose quick stop releases it", "R", "4",
            ("tests/faults/test_stage_rows.py::test_a_string_and_a_quick_stop_that_lets_go",
             "tests/runner/test_stop_string.py::test_what_a_string_forbids",
             "tests/drivers/test_preflight.py::test_whether_a_quick_stop_holds_the_shaft")),
    80: Row("another master drives the shaft against the quick stop", "tdhil stops feeding the watchdog: WD",
            "as its cause",
            ("tests/runner/test_stop_polls.py::"
             "test_a_shaft_that_somebody_drives_on_is_left_to_the_watchdog_and_watched",),
            "no slower for 3 s: tdhil stops feeding the watchdog, the drive stops the shaft, and standstill is seen"),
    81: Row("a scripted fault whose time the run does not reach", "reported at the end", "as without",
            ("tests/faults/test_stage_rows.py::test_a_fault_that_never_comes_is_said",)),
    82: Row("a mode that is lost in motion", must(82), "6",
            ("tests/faults/test_stage_rows.py::test_a_mode_that_is_lost_in_motion",
             "tests/runner/test_guard_follows.py::test_a_mode_that_is_lost_trips_once_it_can_be_no_late_frame")),
    83: Row("a shaft that does not follow in speed mode", "following error: QS", "7",
            ("tests/faults/test_stage_rows.py::test_a_shaft_that_does_not_follow_in_speed_mode",
             "tests/runner/test_guard_follows.py::test_a_shaft_that_stays_at_another_speed_trips",
             "tests/runner/test_guard_follows.py::test_no_rig_that_does_what_it_can_trips")),
    84: Row("a log that is removed, cut short, or whose thread dies", "reported at once: QS", "3",
            ("tests/faults/test_stage_rows.py::test_a_log_that_is_taken_away",
             "tests/recording/test_writer.py::test_a_log_that_was_taken_away_is_told_at_once",
             "tests/recording/test_writer.py::test_a_log_whose_thread_died_is_told_within_a_second")),
}

STREAMS = "tests/path/test_standard_streams.py::"
FILES = "tests/path/test_files_of_a_run.py::"
COMMAND_LINE: dict[int, Row] = {
    85: Row("rig.yaml confirms in the operator's place (run: yes, accept_no_watchdog …)", "refused, with the line and "
            "the flag; an override of a profile's entries counts for the profile of the same file only", "2",
            ("tests/cli/test_only_the_operator.py::test_a_file_does_not_confirm",
             "tests/cli/test_only_the_operator.py::test_nothing_that_the_operator_answers_for_stands_in_a_file",
             "tests/cli/test_only_the_operator.py::test_an_override_in_a_file_is_for_the_profile_of_that_file"),
            "the key is named with its line, nothing is connected to"),
    86: Row("a quantity in rig.yaml in another unit than the key's (speed_max_rad_s: 100 rpm, speed_max_rpm)",
            "converted and shown both ways, or refused without offering a number; both forms of a key are refused",
            "0, 2", ("tests/config/test_rig_units.py::test_a_value_with_its_unit_is_converted_and_both_are_told",
             "tests/config/test_rig_units.py::test_a_key_in_the_manual_s_unit",
             "tests/config/test_rig_units.py::test_what_is_refused_offers_no_wrong_number"),
            "100 rpm = 10.47 rad/s in settings, dry run and prompt"),
    87: Row("a bit rate that CAN doesn't have (500 for 500k)", "refused wherever it stands; the nearest is named", "2",
            ("tests/config/test_rig_units.py::test_the_command_line_and_the_environment_know_the_same_rates",
             "tests/config/test_rig_units.py::test_bit_rates_that_can_does_not_have"),
            "500 bit/s is not a CAN bit rate; 500k is one"),
    88: Row("two runs log into one folder",
            "a live log is never moved; the second takes a name of its own and reports it",
            "-", (f"{FILES}test_a_live_log_is_never_moved", f"{FILES}test_runs_begun_at_once_share_no_file",
                  f"{FILES}test_a_second_run_in_the_folder_of_a_live_one_says_where_its_log_is"),
            "the second's log is run-<date>.mcap, as its settings, its end and its JSON state"),
    89: Row("a run that is refused, where the last good log is", "the last good log keeps its name", "as the refusal's",
            (f"{FILES}test_a_refusal_leaves_the_last_good_log_in_its_place",
             f"{FILES}test_a_bus_that_can_not_be_opened_is_no_reason_to_lose_the_last_log_s_name"),
            "the refusal is logged in run.refused.mcap"),
    90: Row("--log, --report or --trace names a file of another kind (rig.yaml)", "R; the file stays as it is", "2",
             (f"{FILES}test_no_file_of_somebody_else_is_touched",
              f"{FILES}test_a_replay_s_report_goes_over_nothing_either"),
             "named with the option; not even a log was begun"),
    91: Row("stdout full, closed or ASCII only at the end of a run; no descriptor left",
             "the run ends as it should, the card goes to stderr, the result is in the log",
             "3 (full), else as the result",
             (f"{STREAMS}test_a_full_device_at_the_end_of_a_run", f"{STREAMS}test_no_stdout_at_all",
              f"{STREAMS}test_an_encoding_that_lacks_our_signs",
              f"{STREAMS}test_nothing_is_loaded_once_the_shaft_may_move"),
             "no module is loaded once the shaft may move"),
    92: Row("a drive's name (1008h), a profile's title, a file's name with terminal escapes, markup or line breaks",
             "shown as text, never executed", "-",
             ("tests/report/test_foreign_text.py::test_the_preflight_table_and_the_prompt",
              "tests/report/test_foreign_text.py::test_a_profile_s_title",
              "tests/report/test_foreign_text.py::test_a_console_obeys_nothing"),
             "a visible sign without effect; no additional line in the text that the operator confirms"),
}

LOG: dict[int, Row] = {
    93: Row("replay of a run that was aborted and came to rest",
             "the data before the abort count; the cause is named", "3",
             ("tests/path/test_replay_ended.py::test_an_aborted_run_is_a_partial_result",
              "tests/estimation/test_aborted.py::test_whatever_follows_the_abort_the_result_is_the_same"),
             "result with a warning that names stage and cause"),
    94: Row("replay of a run that was refused, or ended in setup", "its refusal is reported", "the run's own",
             ("tests/path/test_replay_ended.py::test_a_refused_run_says_its_refusal",),
             "what, where, and the next step"),
    95: Row("replay on another kind of processor", "numbers the same to 1e-9, texts the same", "the run's own",
             ("tests/path/test_two_kernels.py::test_a_replay_under_other_kernels",
              "tests/estimation/test_data_checks.py::test_rounding_does_not_decide_whether_a_period_is_wrong"),
             "the same result"),
}

VIRTUAL, IMPEDANCE = "tests/runner/test_virtual_string.py::", "tests/runner/test_impedance_run.py::"
SOFT_TORQUE: dict[int, Row] = {
    96: Row("virtual string: Ctrl-C while the bit sticks", "QS; the string's torque goes first", "130",
            (f"{VIRTUAL}test_ctrl_c_while_the_bit_sticks_takes_the_string_away_first",),
            "no torque is commanded from the stop's first cycle on; the shaft never turns back"),
    97: Row("virtual string: feedback frozen or lost, torque lost or limited, load lost, drive fault",
            "QS; the string's torque goes first", "5, 6, 7, 8",
            ("tests/path/test_virtual_string.py::"
             "test_a_fault_while_the_bit_sticks_and_slips_ends_with_a_shaft_at_rest",
             f"{VIRTUAL}test_what_befalls_the_drive_ends_the_stage_and_the_shaft_comes_to_rest"),
            "standstill; the drive is never disabled while it turns, and the stop only brakes"),
    98: Row("virtual string: SIGKILL of the host while the bit sticks and slips", "WD", "-",
            ("tests/path/test_virtual_string.py::"
             "test_a_host_killed_while_the_bit_sticks_and_slips_leaves_the_shaft_to_the_drive_s_watchdog",),
            "the last torque acts for the watchdog's time, then the drive brakes; the log is replayed as cut short"),
    99: Row("virtual string: the loop puts energy into the shaft, or oscillates more than string and bit can", "QS",
            "7",
            (f"{VIRTUAL}test_energy_that_the_loop_puts_in_and_a_swing_beyond_string_and_bit_end_it",),
            "energy above 5 % of that of the twisted string; torque above the simulated one for 5 s"),
    100: Row("virtual string: the torque limit acts", "the string is faded out; no result", "9",
             (f"{VIRTUAL}test_a_torque_limit_that_acts_fades_the_string_out_and_leaves_no_result",),
             "share of the string's torque falls to none, verdict invalid"),
    101: Row("virtual string: cycle, lag, mud, window, torque or time outside the limits of the method; a real string; "
             "another rig than the result's", "R; another rig: after stage 2", "4",
             ("tests/soft_torque/test_evaluation.py::test_what_can_not_be_true_is_refused",
              "tests/soft_torque/test_evaluation.py::test_a_window_without_room_is_refused",
              f"{VIRTUAL}test_what_can_not_be_is_refused_before_anything_moves",
              f"{VIRTUAL}test_a_result_of_another_rig_is_refused"),
             "named with the value and the limit"),
    102: Row("impedance by the torque offset: any fault of its stage, or Ctrl-C", "QS; the offset goes first",
             "5, 6, 7, 8, 130",
             ("tests/path/test_impedance.py::"
              "test_whatever_fails_in_it_the_shaft_comes_to_rest_and_the_offset_goes_first",
              f"{IMPEDANCE}test_whatever_ends_it_the_offset_goes_with_the_first_cycle_of_the_stop",
              f"{IMPEDANCE}test_an_interrupt_takes_it_away_as_well"),
             "60B2h is zero with the stop's first cycle"),
    103: Row("impedance: a torque offset that a dead host left in the drive", "WD; cleared before anything else moves",
             "-", ("tests/drivers/test_torque_offset.py::"
                   "test_what_a_dead_host_left_is_gone_with_the_next_run_and_with_a_stop_from_outside",),
             "cleared by the next run, and by tdhil stop"),
    104: Row("impedance by the reference: a filter of it that was not declared", "no result", "9",
             ("tests/estimation/test_impedance.py::test_a_reference_filter_that_nobody_declared_is_refused",),
             "model_rejected, with its time constant"),
}

STRING, SESSION = "tests/runner/test_stop_string.py::", "tests/session/"
BETWEEN: dict[int, Row] = {
    105: Row("Modbus: a status word that makes no sense (zeros of a gateway for a cycle, an unknown pattern)",
             "QS; never disabled while the shaft may turn", "6",
             ("tests/drivers/test_modbus_drive.py::test_one_status_word_that_makes_no_sense_lets_no_shaft_go",
              "tests/drivers/test_modbus_drive.py::"
              "test_a_drive_that_was_enabled_and_shows_no_state_is_left_to_its_watchdog",
              "tests/drivers/test_falling_out.py::"
              "test_one_that_was_enabled_and_shows_no_state_is_left_to_its_watchdog"),
             "the quick stop is repeated until the drive shows a state; closing writes nothing to such a drive"),
    106: Row("a run, or --reset-fault, while the drive still brakes after an earlier one", "R, nothing written", "4",
             ("tests/drivers/test_preflight.py::test_a_drive_that_still_brakes_after_a_stop_is_left_alone",
              "tests/drivers/test_preflight.py::test_a_fault_reaction_is_left_alone_too",
              "tests/drivers/test_preflight.py::test_a_drive_that_is_not_in_fault_is_not_reset",
              "tests/drivers/test_modbus_preflight.py::test_a_drive_that_is_not_in_fault_is_not_reset"),
             "neither mode nor quick-stop option is written; a fault reset is written only to a drive in fault"),
    107: Row("a run on a drive that an earlier stop left holding a twisted drill string", "R, nothing written", "4",
             ("tests/drivers/test_preflight.py::"
              "test_a_string_that_is_held_wound_up_is_not_let_go_by_the_next_run",
              "tests/drivers/test_modbus_preflight.py::"
              "test_a_string_that_is_held_wound_up_is_not_let_go_by_the_next_run"),
             "the torque is named; the drive stays in quick stop"),
    108: Row("drill string: the report that trips the guard is wrong (40 rad/s of 4), or torque is no number",
             "QS, from the report before; bounded in time", "6, 7, 8",
             (f"{STRING}test_one_wrong_report_is_not_followed",
              f"{STRING}test_a_speed_beyond_the_limit_is_braked_from_the_limit",
              f"{STRING}test_torque_that_is_no_number_is_given_up_and_held"),
             "no setpoint of the stop is above the speed before; a string whose torque isn't known is held"),
    109: Row("Ctrl-Z; a program in the background asks its terminal", "QS", "143",
             ("tests/cli/test_identify_end.py::test_each_signal_is_a_wish_to_stop_and_the_first_one_stays",
              "tests/cli/test_identify_end.py::"
              "test_a_program_in_the_background_is_not_stopped_by_its_terminal_while_a_shaft_turns",
              f"{SESSION}test_confirm_speed.py::test_a_program_in_the_background_is_refused_not_stopped"),
             "a request to stop, as Ctrl-C; the control loop is never suspended"),
    110: Row("a drive's lock is removed while a run holds it", "R for the second", "4",
             (f"{SESSION}test_drive_lock.py::test_a_lock_whose_file_was_removed_holds_all_the_same",),
             "a name in the kernel holds it too (Linux)"),
    111: Row("the terminal accepts no output (Ctrl-S) at a question in motion; an answer typed before the question",
             "cycles and stop go on; no answer", "130, 4",
             (f"{SESSION}test_confirm_speed.py::test_a_terminal_that_takes_nothing_holds_no_cycle_up",
              f"{SESSION}test_confirm_speed.py::test_what_was_typed_before_the_question_is_no_answer"),
             "another thread prints and waits; earlier input is discarded"),
    112: Row("`tdhil stop`: the drive refuses what comes before the quick stop, or shows an unknown state",
             "the quick stop is written nevertheless", "0, 8",
             ("tests/drivers/test_quick_stop.py::"
              "test_whatever_the_drive_refuses_before_it_the_quick_stop_is_written",
              "tests/drivers/test_modbus_quick_stop.py::"
              "test_a_drive_that_refuses_speed_mode_gets_its_quick_stop_in_the_end",
              "tests/drivers/test_modbus_quick_stop.py::"
              "test_a_drive_that_shows_a_state_nobody_knows_is_asked_all_the_same"),
             "standstill"),
    113: Row("limits without effect: a torque limit below one count of the drive, a quick stop of minutes", "R",
             "2, 4",
             ("tests/drivers/test_preflight.py::test_a_torque_limit_below_one_count_is_no_wider_one",
              "tests/drivers/test_modbus_preflight.py::test_a_torque_limit_below_one_count_is_no_wider_one",
              "tests/config/test_rig.py::test_what_is_refused"),
             "named with the required value; not rounded up"),
    114: Row("transmit queue full, or bus-off, on a drive without a watchdog (--accept-no-watchdog)", "QS is repeated",
             "8", ("tests/drivers/test_no_watchdog.py::"
                   "test_a_full_queue_keeps_no_stop_back_where_no_watchdog_acts",),
             "only the host can stop the shaft, so the stop is tried in every cycle"),
}

SCRIPTED, OVER_MODBUS = f"{HERE}test_rows_scripted.py::test_row", f"{HERE}test_modbus_scripted.py::test_row"
OBSERVER, DOUBT = "tests/runner/test_observer.py::", "tests/runner/test_stop_doubt.py::"

LYING: dict[int, Row] = {
    115: Row("the drive's speed sensor is lost or frozen; its speed control follows it",
             must(115),
             "8", (SCRIPTED, OVER_MODBUS,
                   f"{OBSERVER}test_a_lost_encoder_is_found_before_the_shaft_is_fast",
                   f"{OBSERVER}test_a_sensor_that_is_dead_in_the_stop_is_seen_in_two_ways",
                   f"{OBSERVER}test_a_speed_that_was_lost_is_not_believed_again",
                   f"{DOUBT}test_a_speed_that_is_lost_disables_nothing")),
    116: Row("the reported speed is lost or frozen, the sensor is good",
             must(116), "6, 8",
             (SCRIPTED, OVER_MODBUS, f"{OBSERVER}test_a_speed_that_jumps_is_found_at_once",
              f"{OBSERVER}test_a_speed_that_freezes_is_found_once_the_shaft_turns_otherwise",
              f"{OBSERVER}test_a_position_that_lives_stands_in_for_a_lost_speed",
              f"{DOUBT}test_with_a_position_that_lives_standstill_is_confirmed")),
    117: Row("the scale of the reported speed changes in motion", must(117), "6, 8",
             (SCRIPTED, f"{OBSERVER}test_a_speed_that_jumps_is_found_at_once")),
    118: Row("the reported torque contradicts the commanded torque, or the motion", must(118), "6",
             (SCRIPTED, OVER_MODBUS, f"{OBSERVER}test_a_torque_that_lies_is_found_in_torque_mode",
              f"{OBSERVER}test_a_torque_that_lies_is_found_under_speed_control",
              f"{OBSERVER}test_torque_alone_is_doubted_where_it_contradicts_its_command")),
    119: Row("the reported position contradicts the reported speed", must(119), "6, 8",
             (SCRIPTED, f"{OBSERVER}test_a_position_that_does_not_go_as_far_as_the_speed_says",
              f"{OBSERVER}test_the_position_finds_a_frozen_speed_however_little_torque_it_takes")),
    120: Row("all feedback is zero, or has all bits set (gateway without its drive, dead TPDO)",
             must(120), "8",
             (SCRIPTED, OVER_MODBUS,
              f"{DOUBT}test_a_drive_that_shows_no_state_gets_its_quick_stop_again_and_again",
              "tests/runner/test_standstill.py::test_a_report_that_shows_none")),
    121: Row("the shaft accelerates against its quick stop (polarity, stuck torque, wrong sensor)",
             must(121), "8",
             (SCRIPTED, f"{OBSERVER}test_a_shaft_that_accelerates_against_the_quick_stop_is_seen_in_two_ways",
              f"{OBSERVER}test_above_a_drill_string_the_torque_is_left_on_below_the_speed_limit",
              f"{DOUBT}test_a_runaway_loses_its_torque_and_nothing_is_confirmed",
              f"{DOUBT}test_above_a_string_the_torque_stays_on_below_the_limit",
              f"{DOUBT}test_above_a_string_it_is_removed_beyond_the_limit")),
}

OVER_ETHERCAT = f"{HERE}test_ethercat_scripted.py::test_row"

ETHERCAT: dict[int, Row] = {
    122: Row("EtherCAT: the slave leaves OP with an AL status code", must(122), "6", (OVER_ETHERCAT,)),
    123: Row("EtherCAT: the watchdog of the process data expires", must(123), "5",
             (OVER_ETHERCAT, f"{HERE}test_ethercat_scripted.py::test_row_4_killed")),
    124: Row("EtherCAT: process data come back with a wrong working counter", must(124), "0, 5",
             (OVER_ETHERCAT, f"{HERE}test_ethercat_scripted.py::test_row_with_a_run_that_goes_on")),
    125: Row("EtherCAT: the mailbox is not answered", must(125), "0, 4, 5", (OVER_ETHERCAT,)),
    126: Row("EtherCAT: the EEPROM is damaged, or of another drive", must(126), "4", (OVER_ETHERCAT,)),
    127: Row("EtherCAT: the distributed clock jumps", must(127), "0",
             (f"{HERE}test_ethercat_scripted.py::test_row_with_a_run_that_goes_on",)),
}

BEYOND = (
    LATE | SECOND_MASTER | MODBUS | UNITS | STAGES | COMMAND_LINE | LOG | SOFT_TORQUE | BETWEEN | LYING | ETHERCAT
)
