"""The fifty faults that a run must survive: what each is, what must happen, and the tests that show it.

R refuse before the shaft has moved · QS the stop sequence · WD the drive's own watchdog stops the shaft · M finish, but
mark what was degraded.
"""

from dataclasses import dataclass

HERE = "tests/faults/"
SCRIPTED, ADAPTER, HOST, PROCESS, MODBUS = (
    f"{HERE}test_rows_scripted.py::test_row", f"{HERE}test_rows_adapter.py::", f"{HERE}test_rows_host.py::",
    f"{HERE}test_rows_process.py::", f"{HERE}test_modbus_rows.py::",
)
GUARD = f"{HERE}test_guard_rows.py::"


@dataclass(frozen=True)
class Row:
    """``codes``: how the process may end. ``said``: what tests elsewhere show, where none here measures it."""

    fault: str
    expected: str
    codes: str
    tests: tuple[str, ...]
    said: str = ""


def _scripted(fault, expected, codes, *more):
    return Row(fault, expected, codes, (SCRIPTED, *more))


ROWS = {
    1: Row("Ctrl-C once", "QS", "130", (f"{HOST}test_rows_1_3_a_signal", f"{GUARD}test_rows_1_2_3_signals",
                                        "tests/path/test_stops.py::test_a_signal_in_each_stage")),
    2: Row("Ctrl-C twice", "the stop runs to its end; a turning shaft is never disabled", "130",
           (f"{HOST}test_row_2_a_second_signal_during_the_stop", f"{GUARD}test_rows_1_2_3_signals",
            "tests/path/test_stops.py::test_a_signal_in_each_stage")),
    3: Row("SIGTERM, SIGHUP", "QS", "143", (f"{HOST}test_rows_1_3_a_signal", f"{GUARD}test_rows_1_2_3_signals",
                                            "tests/path/test_stops.py::test_a_signal_in_each_stage")),
    4: Row("SIGKILL of the host", "WD; log salvageable up to the last 0.5 s", "-",
           (f"{PROCESS}test_row_4_killed",
            "tests/path/test_stops.py::test_a_killed_host_leaves_the_shaft_to_the_drive_s_watchdog",
            "tests/record/test_kill.py::test_a_killed_run_is_replayed_up_to_its_last_half_second")),
    5: Row("unhandled exception in any thread", "QS, traceback in the log", "1",
           (f"{HOST}test_row_5_a_mistake_of_ours", f"{GUARD}test_row_5_an_exception",
            "tests/path/test_stops.py::test_an_exception_in_each_stage")),
    6: Row("stop not confirmed", "loud: use the hard-wired emergency stop", "8",
           (f"{HOST}test_row_6_a_stop_that_is_not_confirmed", f"{GUARD}test_row_6_a_stop_that_is_not_confirmed")),
    7: Row("process frozen, laptop asleep", "WD; on waking no stale setpoint", "5",
           (f"{PROCESS}test_row_7_frozen", f"{PROCESS}test_row_7_nothing_is_sent_by_kernel_or_thread",
            "tests/drivers/test_drive_faults.py::test_a_frozen_loop_does_not_send_what_it_had_in_hand")),
    8: Row("loop overruns", "counted; M over a limit, QS when repeated", "0, 5",
           (f"{GUARD}test_row_8_a_loop_that_is_late_again_and_again",
            f"{GUARD}test_row_8_a_loop_that_is_late_now_and_then",
            "tests/drivers/test_drive_faults.py::test_a_short_stall_is_an_overrun_and_no_burst_follows"),
           "late in every 2nd cycle: QS on a scripted drive, exit 5; in every 10th: stage degraded, exit 0"),
    9: Row("wall clock jumps", "unaffected; the jump is noticed", "0",
           ("tests/drivers/test_stamps.py::test_a_wall_clock_that_is_set_changes_no_sample",
            "tests/drivers/test_stamps.py::test_the_offset_is_found_in_spite_of_late_frames"),
           "no sample changes; the jump is counted and stands in the log"),
    10: Row("disk full, log write error", "R if low at start; QS mid-run", "4, 3",
            (f"{HOST}test_row_10_the_log_can_not_be_written", f"{GUARD}test_row_10_a_log_that_can_not_be_written",
             "tests/record/test_full_disk.py::test_a_disk_without_room_refuses_the_run",
             "tests/path/test_stops.py::test_a_log_that_can_not_grow_stops_the_shaft")),
    11: Row("slow log writer", "bounded queue, drops counted and logged, M", "0",
            ("tests/record/test_writer.py::test_a_full_queue_drops_in_real_time_and_says_so",
             "tests/record/test_writer.py::test_a_full_queue_makes_stepped_time_wait",
             "tests/record/test_writer.py::test_a_stage_that_lost_records_is_marked_so_in_the_log"),
            "drops are counted, stand in the log, and the stage is degraded"),
    12: Row("adapter unplugged", "WD", "5", (f"{ADAPTER}test_row_12_adapter_unplugged", SCRIPTED)),
    13: Row("bus-off", "stop sending, no automatic restart; WD", "5", (f"{ADAPTER}test_row_13_bus_off",)),
    14: Row("error-passive", "warn, M", "0, 9", (f"{ADAPTER}test_row_14_error_passive",)),
    15: Row("transmit queue full (ENOBUFS)", "stop sending; WD", "5", (f"{ADAPTER}test_row_15_transmit_queue_full",)),
    16: Row("bus comes back with queued setpoints", "none is acted on; a new enable is needed", "5",
            (f"{ADAPTER}test_row_16_a_bus_that_comes_back_with_queued_setpoints",)),
    17: Row("1-10 % of the frames lost", "gaps found, uncertainty widens, M", "0, 9",
            (f"{HERE}test_rows_scripted.py::test_row_with_a_run_that_goes_on", f"{GUARD}test_row_17_lost_frames")),
    18: Row("duplicated or reordered PDO", "found, M", "0, 9",
            (f"{HERE}test_rows_scripted.py::test_row_with_a_run_that_goes_on",
             f"{GUARD}test_row_18_duplicated_or_late_feedback_is_found")),
    19: _scripted("frozen feedback (stale TPDO)", "age limit, QS", "5",
                  f"{GUARD}test_row_19_no_feedback_any_more",
                  f"{GUARD}test_row_19_the_same_feedback_again_and_again"),
    20: _scripted("drive heartbeat lost", "QS attempt", "5", f"{GUARD}test_rows_20_to_23_what_the_driver_raises"),
    21: _scripted("unexpected boot-up (node reset)", "abort, never enabled again", "6",
                  "tests/drivers/test_drive_faults.py::test_a_third_party_resets_the_drive"),
    22: _scripted("a third party's NMT stop or pre-operational", "abort", "5",
                  "tests/drivers/test_drive_faults.py::test_a_third_party_puts_the_drive_into_pre_operational"),
    23: _scripted("EMCY in motion", "QS, code decoded", "6"),
    24: _scripted("SDO abort", "names object and reason; R", "4",
                  "tests/drivers/test_sdo.py::test_an_abort_names_object_and_code"),
    25: _scripted("SDO time-out", "bounded retry, then abort", "5",
                  "tests/drivers/test_sdo.py::test_a_silent_node_is_given_up_after_a_bounded_time"),
    26: _scripted("a second master, a duplicate node-ID", "R; QS in motion", "4, 5, 6"),
    27: Row("wrong bit rate, wrong node-ID", "R with the likely cause", "4",
            (f"{HOST}test_row_27_a_wrong_node_id", "tests/path/test_scan.py::test_a_wrong_bit_rate")),
    28: Row("malformed EDS or profile", "one line with file and line", "2",
            (f"{HOST}test_row_28_a_malformed_profile", "tests/profiles/test_library.py::test_wrong_profiles")),
    29: _scripted("identity (1018h) is not the profile's", "R", "4"),
    30: _scripted("drive in fault at start", "never reset silently: R", "4",
                  "tests/path/test_cli.py::test_a_drive_in_fault_is_reset_on_the_operator_s_word_only"),
    31: _scripted("state machine stuck, illegal transition", "time-out, QS", "6",
                  f"{GUARD}test_rows_31_33_a_drive_that_leaves_its_state"),
    32: _scripted("mode display does not follow", "R; QS where it comes up in motion", "4, 6"),
    33: _scripted("STO or internal limit active", "abort with its own message", "6, 7"),
    34: _scripted("overspeed in torque mode (load lost)", "QS; the drive's own speed limit was set first", "7",
                  f"{GUARD}test_row_34_the_load_is_lost"),
    35: _scripted("torque, temperature, travel or time limit", "QS", "7 (travel of the probe: 4)",
                  f"{HOST}test_row_35_time_and_travel", f"{GUARD}test_row_35_limits"),
    36: _scripted("encoder sign inverted", "sign probe, QS", "4", f"{GUARD}test_row_36_an_inverted_encoder"),
    37: Row("NaN, Inf, out-of-range setpoint", "rejected before the bus", "1",
            (f"{HOST}test_row_37_a_setpoint_that_is_none",
             f"{GUARD}test_row_37_a_setpoint_that_is_none_never_reaches_the_bus")),
    38: Row("Modbus exceptions 1-4, 6", "typed error; 6 is retried", "6, 5",
            ("tests/drivers/test_modbus_drive.py::test_an_exception_in_the_cycle_is_raised_once",
             "tests/drivers/test_modbus_drive.py::test_busy_is_asked_again_within_the_cycle",
             "tests/drivers/test_modbus_drive.py::test_busy_for_good_counts_as_lost"),
            "each is typed and names the register; busy is asked again, for good it counts as lost"),
    39: Row("Modbus time-out", "retry within the watchdog's time, then QS", "5",
            ("tests/drivers/test_modbus_drive.py::test_silence_ends_within_half_the_watchdogs_time_and_is_said_once",),
            "given up within half the watchdog's time"),
    40: Row("late RTU reply taken for the next", "drained and resynchronised", "0",
            ("tests/drivers/test_modbus_links.py::test_a_late_reply_is_not_taken_for_the_next",
             "tests/drivers/test_modbus_links.py::test_a_reply_so_late_that_the_next_request_is_out"),
            "dropped and counted, the next reply is the right one"),
    41: Row("wrong TCP transaction id", "sample dropped; the connection is given up", "5",
            ("tests/drivers/test_modbus_links.py::test_a_wrong_transaction_id_costs_the_connection",),
            "the connection is given up"),
    42: Row("CRC error, split or short reply", "dropped and counted", "0",
            ("tests/drivers/test_modbus_links.py::test_a_crc_error_on_the_line",
             "tests/drivers/test_modbus_links.py::test_a_reply_in_pieces",
             "tests/drivers/test_modbus_links.py::test_a_short_reply_on_the_line"),
            "dropped and counted; pieces are put together"),
    43: Row("TCP reset, half-open connection", "WD; no blind reconnect while enabled", "5",
            ("tests/drivers/test_modbus_links.py::test_a_connection_that_ends_is_not_opened_again",
             "tests/drivers/test_modbus_links.py::test_nothing_queues_up_on_a_connection_that_takes_nothing"),
            "not opened again in this run"),
    44: Row("wrong word order or scaling", "known-register check, R", "4",
            ("tests/drivers/test_modbus_wrongs.py::test_each_wrong_is_refused",
             "tests/drivers/test_modbus_preflight.py::test_one_known_register_that_is_wrong"),
            "refused before anything is written"),
    45: _scripted("a write is accepted but not applied", "read back, R", "4",
                  "tests/drivers/test_modbus_preflight.py::test_a_write_that_is_taken_but_not_applied"),
    46: Row("truncated, bit-flipped or bomb MCAP", "partial replay, memory capped", "3, 10",
            ("tests/record/test_damage.py::test_flipped_bits", "tests/record/test_damage.py::test_cut_anywhere",
             "tests/record/test_damage.py::test_a_bomb_is_refused_in_little_memory"),
            "what is whole is read, at most a chunk is lost for each wrong byte; a bomb is refused"),
    47: Row("YAML: duplicate or unknown key, tag, 1e3, on/off, 010", "2, with the line", "2",
            ("tests/profiles/test_strict_yaml.py::test_what_is_refused",), "one line each, with file and line"),
    48: Row("flat, unexcited or saturated data", "not identifiable and why", "9",
            ("tests/identify/test_refusals.py::test_never_a_number",
             "tests/identify/test_hopeless.py::test_never_a_number_without_a_warning"),
            "no number, or one with a warning"),
    49: Row("aborted protocol", "resumed at a stage boundary only, after a new preflight", "-",
            (f"{HOST}test_row_49_an_aborted_run_begins_anew",
             "tests/protocol/test_no_resume.py::test_after_an_abort_in_any_stage_a_run_begins_anew")),
    50: _scripted("watchdog not armed, or cannot be", "R", "4",
                  "tests/drivers/test_preflight.py::test_a_watchdog_that_cannot_be_armed"),
}
