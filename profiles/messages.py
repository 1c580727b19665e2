"""The table of messages: each error, refusal, verdict and warning has one entry with a stable code such as ``TDH-412``.

The hundreds of a code are the exit code of the process that ends with it::

    TDH-0xx   a result with a number, and its warnings    0      TDH-7xx   limit reached                      7
    TDH-1xx   internal error                              1      TDH-8xx   stop not confirmed                 8
    TDH-2xx   use, files, configuration                   2      TDH-9xx   not identifiable, model rejected   9
    TDH-3xx   partial result                              3      TDH-10xx  nothing readable in a file        10
    TDH-4xx   refused before motion                       4      TDH-11xx  tuning refused                    11
    TDH-5xx   communication                               5      TDH-12xx  rehearsal, acceptance, evidence  12
    TDH-6xx   drive                                       6      TDH-13xx  interrupted              130 to 192

The table stands here because every room raises errors, and `profiles` lies below every other room. An error class has
an entry; the place that raises may name a more specific one. A code is never given to another entry: the codes are a
contract with scripts and manuals. ``tdhil explain`` shows the table, and docs/reference/messages.md is made from it.
"""

from enum import Enum
from typing import Any, Final

PREFIX: Final = "TDH-"


class MessageCode(Enum):
    """Entries of the table: number, title, cause and cure; each of the last two is one sentence or more."""

    # --- 0xx: a result with a number, and its warnings ---------------------------------------------------------------
    VALID = (
        1, "The result is valid",
        "One model fits the data, and the repeatability is within --tolerance.",
        "Use the result. A torque calibration reduces the uncertainty of the torque scale.")
    VALID_WIDE = (
        2, "The result is valid, but its interval is wide",
        "The half-width of the repeatability exceeds --tolerance. The intervals are valid.",
        "Follow the advice beside the verdict, or raise --tolerance.")
    RESULT_WARNING = (
        20, "Warning about a result",
        "An assumption of the result needs attention.",
        "Read the warning, and check it against the machine.")
    ONE_MEAN_SPEED = (
        21, "Only one mean speed",
        "The excitation has one mean speed, so viscous friction is identified from the spectral lines alone.",
        "Leave --offset out: tdhil then uses two mean speeds.")
    LAGS_NOT_FIRST_ORDER = (
        22, "First-order lags do not fit the reported signals",
        "The drive filters its reported speed or torque with more than one pole, or with a moving average.",
        "The interval allows for such filters. To narrow it, set first-order filters, and state them in drive_data.")
    BARELY_CONSISTENT = (
        23, "The residuals are barely consistent with the model",
        "The p-value of the residual test is near its limit.",
        "Repeat the run with another motion, and compare both results.")
    LINES_TOO_WEAK = (
        24, "Some spectral lines are too weak",
        "The motion at these frequencies does not exceed the noise.",
        "Raise --amplitude. Or lower --frequency. All lines are multiples of it.")
    PERIODS_MISSING = (
        25, "Some periods are not usable",
        "Samples are missing in these periods, or the record ended early.",
        "Check the bus load and the log, and repeat the run.")
    SPEED_CHANGES_SIGN = (
        26, "The speed changes sign",
        "Coulomb friction reverses with the speed, and the model cannot separate this torque from inertia.",
        "Raise the mean speed with --offset, or lower --amplitude.")
    STALE_SAMPLES = (
        27, "Some samples repeat older values",
        "The drive did not update its feedback in every cycle.",
        "Lower --rate, or check the bus load.")
    SAMPLES_LEFT_OUT = (
        28, "Samples were left out",
        "Some samples are not numbers, are spikes, or stay constant although the drive marked them as new.",
        "Check the cable, the encoder and the drive's signal scaling.")
    PARTIAL_DATA = (
        29, "The log ended before the run",
        "The run was cut off, so the result uses a part of the data.",
        "Repeat the run if the interval is too wide.")
    RUN_ENDED_EARLY = (
        30, "The run ended during motion",
        "A limit, a fault or an operator ended the run; the result uses the data recorded before.",
        "Remove the cause that the warning names, and repeat the run.")
    STOP_WAS_NOT_CONFIRMED = (
        31, "The stop of the recorded run was not confirmed",
        "The log ends without a confirmed standstill of the shaft.",
        "Check the machine before you use the result.")
    FRICTION_NOT_LINEAR = (
        32, "Friction is not linear in speed",
        "The friction is nonlinear (Stribeck effect or a quadratic part), and the model includes this.",
        "Use the friction value only near the mean speeds of the run.")
    FRICTION_DRIFTS = (
        33, "Friction drifts during the run",
        "The torque at steady speed changes over time, for example as bearings warm up or the torque zero drifts.",
        "Run the machine until it is warm, and repeat the run.")
    UNDECLARED_MOTION = (
        34, "Motion at a frequency that was not excited",
        "A resonance, a limit cycle, torque ripple or aliasing moves the shaft.",
        "Check the speed loop and the load, and compare with a run at another rate.")
    TORQUE_SIGNALS_DIFFER = (
        35, "Two torque signals differ",
        "Reported torque and commanded torque differ by more than their uncertainty.",
        "Check the rated torque in the drive, and calibrate the torque.")
    CROSS_CHECK_DISAGREES = (
        36, "A cross-check disagrees",
        "A second method finds another inertia in the same run.",
        "Check friction, load and torque scale, and repeat the run.")
    STEPPED_SETPOINT = (
        37, "Torque is sampled in step with the setpoint",
        "A slow cycle reads the torque once per setpoint, so the instant within the step is not known.",
        "Shorten the cycle, or use the torque mode of the drive.")
    STRING_MOVES_WITH_MOTOR = (
        38, "The string moves with the motor",
        "At the excited frequencies, motor, string and load move as one body.",
        "Excite higher frequencies to identify the motor alone.")
    MOTOR_SIDE_ONLY = (
        39, "J is the inertia of the motor's side",
        "The shaft is compliant, so the result separates the motor's side from the load.",
        "Use the total inertia for slow motions, and J for the motor's side.")
    RESONANCE_IN_BAND = (
        40, "A resonance lies in the excited band",
        "Shaft and load oscillate against each other at an excited frequency.",
        "Compare the frequency with the design data of the machine.")
    TOTAL_INERTIA_OPEN = (
        41, "The interval of the total inertia is open on one side",
        "No excited frequency lies far enough below the resonance.",
        "Lower --frequency, which is the lowest excited frequency.")
    LOAD_SWINGS_WIDELY = (
        42, "The load oscillates differently at each mean speed",
        "The load oscillates with a large amplitude, and friction changes its response.",
        "Lower --amplitude, or raise the mean speed.")
    OTHER_PIPE = (
        43, "The string is not the declared pipe",
        "The measured response differs from the pipe in rig.yaml.",
        "Check the pipe's length and size in rig.yaml.")
    NO_WATCHDOG_ARMED = (
        44, "The run had no armed watchdog",
        "The operator accepted a drive that does not stop by itself if the host fails.",
        "Arm a watchdog in the drive before the next run.")
    WATCHDOG_SHARED = (
        45, "Other clients also feed the watchdog: it may not act if tdhil fails",
        "The watchdog of the drive acts only if all clients are silent.",
        "Disconnect the other Modbus clients before the next run.")
    SPEED_UNIT_UNSEEN = (
        46, "The unit of speed was accepted without a check",
        "The run used --accept-speed-unit, and a wrong unit changes J in proportion.",
        "Repeat the run with an operator watching the shaft.")
    SPEED_UNLIKE_ANGLE = (
        47, "Speed and angle of the shaft differ",
        "The reported angle moves faster or slower than the reported speed.",
        "Check the encoder resolution and the speed unit in the drive.")
    FOREIGN_TRAFFIC = (
        48, "Another device used the drive's bus",
        "Another master or tool transmitted frames or changed settings during the run.",
        "Disconnect it, and repeat the run.")
    TRACE_ASSUMPTION = (
        49, "An assumption about a CSV trace",
        "The trace does not state a unit, a column or a setting, or some rows were not usable.",
        "State it with --columns or beside the trace, and replay it again.")
    CALIBRATION_WARNING = (
        50, "Warning about the torque calibration",
        "The torque calibration does not fit this run, or was not applied.",
        "Calibrate the torque again with this drive, or leave the calibration out.")
    LOOP_BEYOND_RESPONSE = (
        55, "The tuned loop is faster than the measured frequency response",
        "The bandwidth lies above the highest excited frequency, where a resonance would not have been seen.",
        "Identify with a higher --frequency, or request a lower --bandwidth.")
    LOOP_LAGS_ASSUMED = (
        56, "The lags of the speed loop are assumed",
        "The speed filter, the torque loop and the dead time were neither measured nor stated.",
        "Measure them with tdhil identify --impedance, or state them with --inner-lags and --dead-time.")
    LOOP_ONE_MODE_ONLY = (
        57, "Only the lowest mode of the string is in the loop",
        "The shaft is a distributed string, and the loop is tuned for its lowest mode.",
        "Use tdhil tune soft-torque for the string.")
    LOOP_UNLIKE_RESPONSE = (
        58, "The measured response differs from the shaft model of the tuning",
        "At some excited frequencies, shaft and model differ by more than the intervals explain.",
        "Check the response with tdhil frf, and test the gains at a low bandwidth first.")
    PRESENT_GAINS_THIN = (
        59, "The present gains have thin margins",
        "In the worst case, the gains in the drive keep less margin than requested.",
        "Type in the tuned gains. Do not lower the present ones if they are unstable with a lower gain.")
    LOAD_MAY_STAY_BEHIND = (
        60, "The load may not follow the motor",
        "The excited frequencies do not show whether the load turns with the motor.",
        "Excite frequencies below the resonance of the load, or disconnect the load from the motor.")
    BACKLASH_FOUND = (
        61, "The coupling behind the motor has backlash",
        "When the torque on the load reverses, the motor turns through the play without the load.",
        "Check the coupling and the gear, or raise --offset so that the torque on the load keeps its sign.")
    SCALE_CHANGE_HIDDEN = (
        62, "A change of scale may not be detected",
        "With this drill string, no cross-check can be compared with J.",
        "Repeat the run, and compare the two results.")
    CALIBRATION_UNCHECKED = (
        63, "The torque calibration may belong to another drive",
        "The drive or the calibration has no serial number, as on Modbus, so tdhil cannot compare the two.",
        "Compare the nameplate of this drive with that of the calibrated one.")
    FACTOR_UNLIKE_SCALE = (
        64, "The calibration factor contradicts the stated torque scale",
        "The factor differs from 1 by more than the uncertainties of the stated scale and of the calibration allow.",
        "Check the body, the reference or the pipe, and torque_scale_rel_sd in rig.yaml.")
    GEAR_LOSS_IN_FACTOR = (
        65, "The calibration factor includes the loss of a gear",
        "The torque sensor is behind the gear, and the torque that the gear loses counts as an error of the drive.",
        "Measure at the motor shaft, or note pairs with rising and with falling torque at standstill.")
    LOOP_GAP_OPEN = (
        66, "The margins may not hold while the backlash is open",
        "The motor then turns alone. Its inertia is not known, so the worst case does not contain this motion.",
        "State the inertia of the motor side with --motor-inertia, or remove the backlash.")
    LOOP_DISTORTED = (
        67, "The result does not explain its nonlinear distortion",
        "The margins are those of a linear shaft. No backlash, friction or torque over the angle explains the rest.",
        "Look for the cause with tdhil frf, and start with half of P.")
    DISTORTION_FOUND = (
        68, "The response has nonlinear distortion of unknown cause",
        "Torque and speed have harmonics that no linear shaft makes, or the response differs between the mean speeds.",
        "Show the harmonics with tdhil frf. Check coupling and gear for play, and measure again with --realisations 2.")

    # --- 1xx: internal error -----------------------------------------------------------------------------------------
    INTERNAL_ERROR = (
        100, "Internal error",
        "tdhil met a case that it does not handle.",
        "Report it with the text of the message, the command and the log (tdhil support).")
    COMMAND_REJECTED = (
        101, "A setpoint was not sent",
        "tdhil computed a setpoint outside its own limits, and the guard refused it.",
        "If the shaft turned, read in the last lines whether standstill was confirmed. Report the log (tdhil support).")
    SYSTEM_REFUSED = (
        102, "The operating system refused a request",
        "Memory, disk space or open files are used up, or a device is gone.",
        "Free the resource that the message names, and try again.")
    WORKER_PROCESS_LOST = (
        103, "A worker process ended",
        "A process that computes in the background ended before its result.",
        "Check the memory of the computer, and start the same command again.")
    SIMULATOR_UNUSABLE = (
        104, "The simulated rig cannot start",
        "The port, the line or a setting of the simulator is not usable.",
        "Correct the setting that the message names.")
    LOG_PROBLEM = (
        107, "The log cannot be read or written",
        "The file is empty, is not an MCAP file, or holds no run of tdhil.",
        "Check the path. For a damaged log use tdhil recover.")
    LOG_TEXT_TOO_LARGE = (
        108, "A text does not fit into the log",
        "The text is too long, or cannot be written as JSON.",
        "Shorten --note and --operator.")

    # --- 2xx: use, files, configuration ------------------------------------------------------------------------------
    USAGE = (
        200, "The command cannot run as written",
        "An option or a value is wrong, or two options exclude each other.",
        "Correct what the message names. Show the options of the command with --help.")
    UNKNOWN_COMMAND = (
        201, "Unknown command",
        "tdhil has no command of this name.",
        "Show the commands with tdhil --help.")
    UNKNOWN_OPTION = (
        202, "Unknown option",
        "The command has no option of this name. Options are never abbreviated.",
        "Show all options with --help-all.")
    VALUE_NOT_ALLOWED = (
        203, "The value of an option is not allowed",
        "The value is outside its limits, has a wrong unit, or is not one of the choices.",
        "Use a value that the message lists.")
    FILE_NOT_FOUND = (
        204, "A file or folder does not exist",
        "The path is mistyped, or the file was moved.",
        "Check the path.")
    FILE_EXISTS = (
        205, "The file already exists",
        "tdhil does not overwrite a file that it should keep.",
        "Name another file, or move the old one.")
    FILE_NOT_WRITABLE = (
        206, "A file or folder cannot be written",
        "The folder does not exist, access is denied, or the disk is full.",
        "Choose another place, or change the permissions.")
    PACKAGE_MISSING = (
        207, "An optional package is not installed",
        "The command needs a Python package that this installation does not have.",
        "Install it with the command in the message.")
    WRONG_KIND_OF_FILE = (
        208, "The file has unexpected content",
        "The option takes another kind of file, such as a log, a result or a tuning.",
        "Name the file that the message asks for.")
    SAME_FILE_TWICE = (
        209, "Two options name the same file",
        "One output would overwrite another file of this run.",
        "Give each option its own file.")
    DATA_FILE_WRONG = (
        210, "A data file has errors",
        "A YAML, EDS or profile file has an unknown key, a wrong value or a wrong form.",
        "Correct the lines that the message lists.")
    PROFILE_UNKNOWN = (
        211, "Unknown profile",
        "No profile and no file has this name.",
        "List the profiles with tdhil profiles.")
    PROFILE_OTHER_BUS = (
        212, "The profile belongs to another bus",
        "--drive names one bus, and the profile describes a drive on another.",
        "Leave --drive out, or choose a profile of this bus.")
    OPTION_OF_ANOTHER_BUS = (
        213, "The option belongs to another bus",
        "The option is for one bus, and the drive is on another.",
        "Leave the option out, or change --drive.")
    BUS_NOT_CONFIGURED = (
        214, "No bus is configured",
        "The command needs a drive, and no interface, channel, serial line or address is given.",
        "Give the address of the drive with -i and -c (CANopen), -i (EtherCAT), or --host or --serial (Modbus).")
    BUS_OPTIONS_WRONG = (
        215, "The options of the bus are not valid",
        "python-can does not know the interface, or refuses one of its options.",
        "Correct --interface, --channel or --bitrate.")
    UNKNOWN_PROFILE_ENTRY = (
        216, "Unknown entry of the profile",
        "The profile has no entry of this name.",
        "List the entries with tdhil profiles show.")
    FAULTS_NEED_SIMULATOR = (
        217, "Faults can be scripted on the embedded simulator only",
        "--fault was given for a drive on a bus.",
        "Add --simulate, or leave --fault out.")
    STEPPED_NEEDS_SYNC = (
        218, "This line cannot run in stepped time",
        "Modbus has no SYNC, so a simulator in another process cannot be stepped.",
        "Leave --stepped out.")
    LOG_NEEDED = (
        219, "No log is named",
        "The command needs one log or more.",
        "Name the log, such as run.mcap.")
    OPTION_FOR_CSV_ONLY = (
        220, "The option is for CSV traces only",
        "A log of tdhil states this value itself.",
        "Leave the option out.")
    CSV_COLUMNS_UNCLEAR = (
        221, "A column of the CSV trace is not identified",
        "A column for time, speed or torque is missing, has no known unit, or several columns match.",
        "Give name and unit of each column, such as --columns time=t:ms speed=n:rpm torque=M:Nm.")
    RATED_TORQUE_MISSING = (
        222, "The torque at 100 % is not given",
        "The trace states torque as a share of the rated torque.",
        "Add --rated-torque in N·m, the rated or the reference torque, as the drive uses it.")
    STRING_MISSING = (
        223, "No drill string is named",
        "Tuning needs the string below the drive.",
        "Name it with --string, or under load in rig.yaml before the run.")
    LAGS_MISSING = (
        224, "A lag of the drive is not known",
        "The result does not state a lag that limits the gains.",
        "State it with --inner-lags, or identify with a motion that shows it.")
    NOT_A_TUNING = (
        225, "The file is not usable as a tuning",
        "The file was not written by tdhil tune, or belongs to another string.",
        "Run tdhil tune again, and name its JSON document.")
    NO_LOGS_FOUND = (
        226, "No logs were found",
        "The folder holds no .mcap file, and no .csv file with a .yaml file beside it.",
        "Check the folder.")
    FLEET_TABLE_WRONG = (
        227, "The table of the fleet is not usable",
        "The file is not a table that tdhil fleet wrote, or another process uses it.",
        "Name another file with --out, or wait for the other process.")
    CLUSTER_UNUSABLE = (
        228, "The Dask cluster is not usable",
        "No scheduler answers, or its workers have another version of tdhil.",
        "Start the scheduler, and install the same versions on all workers.")
    STUDY_SETTING_WRONG = (
        229, "A setting of a study is not valid",
        "The study, a section or a name is unknown, or the value is not allowed.",
        "Correct what the message names. tdhil study list shows the studies.")
    SERVICE_OPTION_WRONG = (
        230, "An option of the service is not valid",
        "An address, a host name, a certificate or a broker is not usable as written.",
        "Correct the option that the message names.")
    SERVICE_NEEDS_LOGIN = (
        231, "This address needs users and TLS",
        "Other computers can reach the address, and a request there could move a shaft.",
        "Add a user and a certificate, or use 127.0.0.1.")
    ACCOUNT_WRONG = (
        232, "The account or password is not accepted",
        "The name or password breaks a rule, or the account already exists or is not known.",
        "Follow the rule that the message states.")
    LOG_UNOPENED = (
        233, "The output file cannot be opened",
        "The folder does not exist, or access is denied.",
        "Choose another file.")
    NOT_FOUND = (
        234, "The service has no such item",
        "The rig, run, fleet or file does not exist.",
        "List what exists, and check the name.")
    REQUEST_WRONG = (
        235, "The service does not accept this request",
        "A field, a type or a value of the request is not allowed.",
        "Compare the request with the API's description.")
    NOT_READY = (
        236, "The service is in use or not ready",
        "Another process uses the folder, or the run has no finished log yet.",
        "Wait until it ends, and try again.")
    FAULT_SCRIPT_WRONG = (
        237, "A scripted fault is not valid",
        "--fault names an unknown fault, moment or value.",
        "Show the faults with --fault list.")
    TRACE_NOT_OURS = (
        238, "The trace file exists and is not a trace",
        "--trace names a file that tdhil did not write, so tdhil keeps it.",
        "Name another file.")
    EVIDENCE_STATEMENT = (
        239, "The publisher's statement is incomplete",
        "An archive of evidence needs the publisher, the parts that may be published, and a full reference inertia.",
        "Add the options that the message names, such as --publisher and --publish.")
    EVIDENCE_SIMULATED = (
        240, "The run is not evidence about a real drive",
        "The run used the simulated drive or rehearsed a fault, or --simulated does not match the log.",
        "Name the log of a run on a real drive, or mark an example with --simulated.")
    EVIDENCE_INCOMPLETE = (
        241, "The log is incomplete as evidence",
        "The run did not reach its end, or the log lacks the identity, the profile or the preflight of the drive.",
        "Name the log of a complete run.")
    EVIDENCE_LEAK = (
        242, "The archive would contain a private text",
        "A path, an address, a password or a key remains in a file of the archive after scrubbing.",
        "Correct the texts of the statement, or name the word with --remove.")

    # --- 3xx: partial result -----------------------------------------------------------------------------------------
    LOG_BROKEN = (
        300, "The log could not be completed",
        "The disk is full, the disk failed, or the file was moved during the run.",
        "After a run, read in the last lines whether standstill was confirmed, and use tdhil replay. Then make room.")
    OUTPUT_LOST = (
        301, "The standard output was lost",
        "The terminal is closed, or the disk behind a redirection is full.",
        "Write the output elsewhere. After a run, show the result with tdhil replay.")
    AUDIT_BROKEN = (
        302, "The audit was changed",
        "The hash chain of the audit's entries does not match.",
        "Compare the audit with a copy, and find out who changed it.")

    # --- 4xx: refused before motion ----------------------------------------------------------------------------------
    PREFLIGHT_REFUSED = (
        400, "Refused before motion",
        "A check before the motion of the run failed. Some checks turn the shaft a little. The last line then says so.",
        "Correct what the message names, and start again.")
    OBJECT_REFUSED = (
        401, "The drive refused an object or a register",
        "The drive does not have it, protects it, or does not accept the value.",
        "Compare the profile with the drive's manual and firmware.")
    DRIVE_HELD = (
        402, "Another process uses this drive",
        "Another run of tdhil on this computer holds the lock of the drive.",
        "Wait until that run ends, or stop it.")
    NOT_CONFIRMED = (
        403, "The motion was not confirmed",
        "The operator did not confirm, or no terminal is there to ask.",
        "Run it at a terminal and type the confirmation; or add --yes if a person stands at the emergency stop.")
    NO_LIMITS = (
        404, "No limits for a real drive",
        "A real drive needs limits of speed, torque and time.",
        "Write them into rig.yaml (tdhil rig new), and name the file with --rig.")
    UNVERIFIED_PROFILE = (
        405, "The profile has entries that are not verified",
        "The entries are not confirmed on this drive, and a wrong unit gives a wrong inertia.",
        "Compare them with the manual, then accept them with --accept-unverified.")
    SPEED_UNIT_NOT_SEEN = (
        406, "The unit of speed was not confirmed",
        "The drive reports no angle, and no operator confirmed the speed of the shaft.",
        "Run it at a terminal. Add --accept-speed-unit only after you measured the speed. All speed limits depend"
        " on it.")
    SPEED_UNIT_WRONG = (
        407, "The unit of speed is wrong",
        "The reported speed contradicts the position, or the speed that the operator saw.",
        "Time some turns of the shaft. Correct the entry that is wrong, speed scaling or counts per turn (position).")
    BUS_UNUSABLE = (
        408, "The bus or the line cannot be opened",
        "The device is missing, in use, down, or access is denied.",
        "Run tdhil doctor. It names each cause and its cure.")
    BIT_RATE_DIFFERS = (
        409, "The bit rate differs",
        "The CAN link runs at another bit rate than requested.",
        "Read the bit rate at the drive. Set the link's rate with ip link, or correct --bitrate.")
    NO_DRIVE_FOUND = (
        410, "No drive answers",
        "The drive is not powered, not connected, or has another address.",
        "Check power, cable and address. tdhil scan lists the drives on the bus.")
    ANOTHER_MASTER = (
        411, "Another master controls the drive",
        "The drive is enabled already, or another device can send setpoints to it.",
        "Stop the shaft with that master and disable the drive there. Then disconnect it. Without one: tdhil stop.")
    SHAFT_TURNS = (
        412, "The shaft turns before the run",
        "The shaft was not at standstill when the run began.",
        "Wait for standstill, and start again.")
    SHAFT_DID_NOT_MOVE = (
        413, "The shaft did not move",
        "The probe torque is below the breakaway torque, or a brake is applied.",
        "Release the brake, or raise limits.probe_torque_nm in rig.yaml.")
    DIRECTION_WRONG = (
        414, "The shaft turned backwards",
        "The sign of speed or torque is inverted.",
        "Check the encoder wiring and the direction settings of the drive.")
    SIGN_NOT_CLEAR = (
        415, "The direction of rotation is not clear",
        "The shaft moved without a clear direction during the probe.",
        "Check noise and scale of the speed signal. Raise limits.probe_travel_rad if the shaft may turn further.")
    BRAKING_UNCLEAR = (
        416, "The drive does not brake as commanded",
        "A negative torque setpoint did not decelerate the shaft, or this could not be tried.",
        "Check the sign of the torque setpoint, and whether the drive can brake. Or use --mode speed.")
    PREFLIGHT_TABLE = (
        417, "A setting of the drive is not as required",
        "A row of the preflight table shows another value than required.",
        "Change the setting in the drive, or correct the profile or rig.yaml.")
    DRIVE_LIMIT_TIGHTER = (
        418, "A limit in the drive is too low for the run",
        "The drive's own limit would clip the motion.",
        "Request less motion. If the machine permits more: --accept-wider-limit torque (speed, quick-stop).")
    NO_TORQUE_MODE = (
        419, "The drive has no usable torque mode",
        "The drive has no torque mode, or cannot enter it while it turns.",
        "Use --mode speed.")
    EXCITATION_NOT_POSSIBLE = (
        420, "This excitation is not possible here",
        "The drive's mode, the load or the speed window does not allow the excitation.",
        "Use the excitation that the message names, such as --excitation multisine.")
    STRING_NOT_SAFE = (
        421, "Not allowed with a drill string",
        "A drill string stores torque. Released without control, it could turn the shaft backwards.",
        "Follow the message, or run without the string.")
    PLAN_NOT_POSSIBLE = (
        422, "No motion fits the limits",
        "The speed window, the torque limit or the time leaves no room for the requested motion.",
        "Lower --amplitude. Widen a limit in rig.yaml only if the machine allows it.")
    IMPEDANCE_NOT_POSSIBLE = (
        423, "The impedance of the drive cannot be measured here",
        "The measurement needs the drive's speed loop, a free shaft and its own excitation.",
        "Leave out the options that the message names.")
    VIRTUAL_STRING_REFUSED = (
        424, "The virtual string cannot run on this rig",
        "The string, the controller, the limits or the shaft do not fit together.",
        "Correct what the message names. The virtual string was not started.")
    PDO_NOT_POSSIBLE = (
        425, "The PDO mapping is not accepted",
        "The drive has a fixed PDO mapping, or keeps another COB-ID or transmission type.",
        "Choose the profile of this drive, or change the mapping with the vendor's tool.")
    NODE_ID_CONFLICT = (
        426, "A node-ID is used twice",
        "Two devices on the bus have the same node-ID, or no free node-ID is left.",
        "Give each device its own node-ID.")
    WATCHDOG_NOT_ARMED = (
        427, "The watchdog of the drive is not armed",
        "The drive does not confirm the supervision of this host.",
        "Check the watchdog settings in the drive and in the profile.")
    NOT_THE_SIMULATOR = (
        428, "The peer is not the simulator",
        "Stepped time was requested, and the peer has no marker of the simulator.",
        "Leave --stepped out.")
    UNDO_FILE_PROBLEM = (
        429, "The undo file of the drive's settings is not usable",
        "tdhil cannot write or read its record of the settings that it changed in the drive.",
        "Make the folder of the log writable. If the file is damaged, compare all limits in the drive with your"
        " records.")
    NO_FEEDBACK = (
        430, "The drive sends no feedback",
        "The drive does not answer SYNC with its TPDO.",
        "Check that the node is operational, and that its TPDO is enabled.")
    SERIAL_LINE_REFUSED = (
        431, "The serial line is not usable",
        "The device does not exist, is in use, or does not accept the baud rate.",
        "Check --serial, --baud and --parity.")
    MODBUS_FUNCTIONS_MISSING = (
        432, "The profile lacks a Modbus function",
        "The profile allows no function that transfers this register in one request.",
        "If the drive's manual lists function 16 or 23, add it to cycle.functions in the profile.")
    LOG_DISK_FULL = (
        433, "Too little disk space for a log",
        "The disk has less free space than a run needs.",
        "Free some space, or log to another disk with --log.")
    NOT_ALLOWED = (
        434, "The service does not allow this request",
        "The user, the page, or the rules of the rig do not permit it.",
        "Log in with the role that the message names, or act at the rig.")
    CONFLICT = (
        435, "The request conflicts with the present state",
        "Another run uses the rig, or the run is in another state.",
        "Wait for the other run. If its stop was not confirmed, check the standstill at the shaft, then sign off.")
    CODE_REFUSED = (
        436, "The operator at the rig did not confirm the run",
        "The code is wrong, used or expired, or the page that confirmed the run is closed.",
        "Request the run again. Enter the new code, which tdhil serve or tdhil attend shows at the rig.")
    CHANGED_MEANWHILE = (
        437, "A file changed after the request",
        "The rig file or the profile is not the one that was confirmed.",
        "Check the change, and request the run again.")
    SERVICE_DISK_FULL = (
        438, "The disk of the service is full",
        "The service cannot record a run.",
        "Free some space on the disk.")
    PLAN_HOPELESS = (
        439, "The requested motion cannot determine the moment of inertia",
        "The cycle rate is too low for its spectral lines, or the motion cannot separate J from lags and friction.",
        "Leave out --frequency and --amplitude, or change them as the message says.")
    NO_RIG_NAME = (
        440, "No name for the rig of a real drive",
        "Results are kept and compared by the rig's name and its drive. A real drive does not move without a name.",
        "Write the key name into rig.yaml. tdhil rig new asks for it.")
    VERIFICATION_REFUSED = (
        441, "The steps of the set speed cannot run on this rig",
        "The tuning, the limits or the shaft do not fit together.",
        "Correct what the message names.")

    # --- 5xx: communication ------------------------------------------------------------------------------------------
    COMMUNICATION_LOST = (
        500, "Communication with the drive was lost",
        "The drive does not answer, or its data do not arrive.",
        "If the shaft turns, use the hard-wired emergency stop. Then check power, cable and bus load.")
    NODE_SILENT = (
        501, "The node does not answer",
        "No reply to an SDO request arrived in time.",
        "Check power, node-ID, bit rate, cable and termination.")
    FEEDBACK_LOST = (
        502, "Feedback of the drive is missing",
        "The TPDO, the heartbeat or the reply of the drive did not arrive for several cycles.",
        "Check supply, bus load and cable.")
    BUS_FAILED = (
        503, "The bus adapter failed",
        "The adapter was unplugged, went bus-off, or does not accept frames.",
        "Check adapter, bit rate, termination and cable.")
    BUS_FLOODED = (
        504, "Too many frames on the bus",
        "A device floods the bus, or the computer is too slow.",
        "Look at the traffic with candump, and disconnect the device.")
    HOST_LATE = (
        505, "The control loop was late",
        "This computer was busy, asleep or frozen.",
        "Lower --rate, close other programs, or add --real-time-priority.")
    WATCHDOG_ACTED = (
        506, "The watchdog of the drive acted",
        "The drive did not receive this host's frames in time, and stopped the shaft.",
        "Find out why the host was silent, or why its frames were lost.")
    FOREIGN_MASTER = (
        507, "Another master acted during the run",
        "Another device sent NMT commands, setpoints or settings to the drive.",
        "Disconnect it, and start again.")
    NO_REPLY = (
        508, "No Modbus reply",
        "The device did not answer a request in time.",
        "Check unit number, baud rate, parity and the polarity of the two wires.")
    BAD_REPLY = (
        509, "A Modbus reply is damaged",
        "The reply has a wrong checksum, length or address.",
        "Check cable, shielding, termination and baud rate.")
    LINK_LOST = (
        510, "The line to the drive was lost",
        "The serial adapter or the TCP connection is gone.",
        "Check the adapter, the cable and the gateway.")
    SERVER_UNREACHABLE = (
        511, "A server does not answer",
        "The socketcand server, the service or a run's process cannot be reached.",
        "If a shaft turns, use the hard-wired emergency stop. Check the address, and that the server runs.")
    RUN_NOT_REACTING = (
        512, "The run's process does not respond",
        "The process was suspended, and does not read requests.",
        "Use the hard-wired emergency stop. Do not rely on the drive's watchdog.")
    UPLOAD_WITHOUT_END = (
        513, "The drive sends an object that does not end",
        "A reply to an SDO request is longer than any object that tdhil reads, or its segments do not end in time.",
        "Compare the object with the drive's manual. Update the firmware of the drive or of the gateway.")
    FEEDBACK_REPEATS = (
        514, "The feedback repeats its last values",
        "The setpoint moves, but speed and torque do not. A gateway repeats old values, or the shaft is locked.",
        "Check gateway, drive and shaft.")

    # --- 6xx: drive --------------------------------------------------------------------------------------------------
    DRIVE_FAULT = (
        600, "The drive is in fault",
        "The drive reported a fault, or refused a request during motion.",
        "Read the drive's fault list, remove the cause, then start with --reset-fault.")
    MODE_NOT_CONFIRMED = (
        601, "The drive did not confirm its mode",
        "The displayed mode of operation did not follow the command in time.",
        "Check the profile's modes, and whether the drive changes modes while enabled.")
    REPORTS_CONTRADICT = (
        602, "Two reports of the drive contradict each other",
        "The reported speed, position and torque cannot all be correct.",
        "Check the encoder, its coupling, and the torque signal.")
    STATE_LEFT = (
        603, "The drive left its state",
        "The drive left the commanded state of its state machine without a request.",
        "Check safe torque off, interlocks and the drive's fault list.")
    DRIVE_RESTARTED = (
        604, "The drive restarted during the run",
        "The drive sent its boot-up message in the middle of the run.",
        "Check the power supply of the drive. tdhil does not enable it again.")
    FEEDBACK_NOT_FINITE = (
        605, "The feedback is not a number",
        "The drive reported a speed or torque that is not finite.",
        "Check the signal types in the profile.")
    NO_PLAUSIBLE_INERTIA = (
        606, "The speed ramp shows no plausible inertia",
        "Torque and acceleration of the ramp do not fit a rotating body.",
        "Check the torque signal, its scale and its sign.")
    ENABLE_FAILED = (
        607, "The drive did not become enabled",
        "The state machine did not reach operation enabled in time.",
        "Check the enable input, safe torque off, and the drive's display.")

    # --- 7xx: limit reached ------------------------------------------------------------------------------------------
    LIMIT_HIT = (
        700, "A limit was reached",
        "A limit of rig.yaml was reached, and tdhil stopped the run.",
        "Request less motion, or widen the limit if the machine allows it.")
    SPEED_LIMIT = (
        701, "The speed left its window",
        "The speed left, or was about to leave, the window in rig.yaml.",
        "Lower --amplitude. If the shaft was too fast, lower --offset, else raise it. Widen the window only if the"
        " machine allows it.")
    TORQUE_LIMIT = (
        702, "The torque exceeded its limit",
        "The reported torque exceeded limits.torque_nm in rig.yaml by more than a quarter.",
        "Lower --amplitude. Check drive_data.rated_torque_nm. Raise the limit only if the machine allows it.")
    TIME_LIMIT = (
        703, "The run exceeded its time",
        "The run took longer than limits.time_s in rig.yaml.",
        "Raise limits.time_s, or shorten the run with --max-time or --periods.")
    TURNED_BACKWARDS = (
        704, "The shaft turned backwards",
        "The speed was negative, or was about to be, and allow_reverse is false.",
        "Raise --offset or lower --amplitude.")
    NOT_SETTLED = (
        705, "The speed did not settle",
        "The speed did not reach a steady value in time.",
        "Check the load, the friction and the drive's speed loop.")
    STICK_SLIP = (
        706, "The drill string sticks and slips",
        "The string oscillates at this speed, and a softer speed control does not end it.",
        "Raise limits.speed_min_rad_s if the machine allows it, lift the bit off bottom, or reduce the weight on bit.")
    NO_ROOM_FOR_MOTION = (
        707, "No motion of stage 5 fits the limits",
        "The measured shaft leaves no motion that stays within speed, torque and time.",
        "Lower --amplitude. Widen a limit in rig.yaml only if the machine allows it.")
    SETPOINT_NOT_FOLLOWED = (
        708, "The shaft does not follow its setpoint",
        "The speed or torque does not reach its setpoint, often at an internal limit of the drive.",
        "Check the load, and the limits inside the drive.")
    BRAKING_HELD_BACK = (
        709, "Braking torque was held back",
        "The run is not allowed to brake by torque on this drive.",
        "Use --mode speed, or do what the message says.")
    DRIVE_TOO_HOT = (
        710, "The drive or motor is too hot",
        "A temperature reported by the drive exceeded its limit.",
        "Let it cool down. Lower --amplitude.")
    VIRTUAL_STRING_UNSTABLE = (
        711, "The loop of the virtual string is unstable",
        "The lags of the rig differ from those of the result.",
        "Identify again, and tune with the new result.")
    STEP_OVERSHOOTS = (
        712, "A step of the set speed overshoots far more than predicted",
        "The gains in the drive are not those that were tuned, or the shaft is not the identified one.",
        "Compare P, I, their units and filters with the tuned ones. If they agree, lower I first, or identify again.")

    SHAFT_CHANGED = (
        713, "The speed changes faster than this shaft allows",
        "The shaft became lighter during the run. A load was lost, or a coupling slipped.",
        "Check the coupling and the load before you start again. Do not widen a limit.")

    # --- 8xx: stop not confirmed -------------------------------------------------------------------------------------
    STOP_NOT_CONFIRMED = (
        800, "The stop was not confirmed",
        "The stop sequence ended without a confirmed standstill, so the shaft may still turn.",
        "Use the hard-wired emergency stop now. Approach only a shaft that you see stand still, with the drive"
        " locked out.")

    # --- 9xx: not identifiable, or the model was rejected ------------------------------------------------------------
    NOT_IDENTIFIABLE = (
        900, "The inertia is not identifiable from these data",
        "Other values of inertia, friction and lags explain the data equally well.",
        "Follow the advice beside the verdict.")
    MODEL_REJECTED = (
        901, "The data contradict every model",
        "The residual test rejects each model, or two measurements contradict each other.",
        "Follow the advice beside the verdict, and check the signals.")
    TOO_FEW_LINES = (
        902, "Too few excited frequencies",
        "The excited frequencies and mean speeds give fewer equations than there are unknowns.",
        "Use --excitation multisine, and leave --offset out: tdhil then uses two mean speeds.")
    NO_EXCITATION = (
        903, "The motion does not show the inertia",
        "Speed or torque did not change enough, or the shaft only coasted.",
        "Change the speed by torque several times, for example with --excitation multisine.")
    SIGNAL_CLIPPED = (
        904, "A signal was limited or clipped",
        "Torque or speed stayed at a limit for a part of the record.",
        "Lower --amplitude, or raise the limit if the machine allows it.")
    DATA_UNUSABLE = (
        905, "The recorded data are not usable",
        "Samples are missing, repeated, not numbers, or not in order.",
        "Check the recording, and repeat the run.")
    EXCITATION_MISDECLARED = (
        906, "The declared excitation does not fit the record",
        "Period, lines or times of the excitation differ from the recorded motion.",
        "Correct the description of the excitation.")
    STICK_SLIP_RECORDED = (
        907, "The record shows stick-slip",
        "The shaft stood still or oscillated during the excitation.",
        "Raise --offset, or run without the string.")
    SIGNALS_SWAPPED = (
        908, "Torque and speed are swapped, copied or inverted",
        "The two signals fit no positive inertia.",
        "Check the columns, signs and units of the signals.")
    ECHO_NOT_SEPARATED = (
        909, "The echo of the string is not separated",
        "The echo of the pipe returns before the inertia is visible, or the pipe is not known.",
        "State the pipe in rig.yaml, or use --excitation multisine.")
    SHAFT_TURNED_BACK = (
        910, "The shaft turned backwards in the record",
        "Friction reverses at standstill, so the model does not hold.",
        "Raise --offset, or lower --amplitude.")
    TOO_FEW_PERIODS = (
        911, "Too few usable periods",
        "The scatter between periods needs more periods than are usable.",
        "Raise --periods or --max-time.")
    TOO_FEW_SAMPLES = (
        912, "Too few samples",
        "The record is too short, or its sample rate is too low for the excitation.",
        "Record longer, or with a higher --rate.")
    SPEED_SCALE_DOUBTFUL = (
        913, "Speed and angle contradict each other",
        "The reported speed does not agree with the reported angle of the shaft.",
        "Check the encoder resolution and the unit of speed.")
    TORQUE_SCALE_DOUBTFUL = (
        914, "Torque signals contradict each other",
        "Reported torque differs from commanded torque by more than any torque scale.",
        "Check the rated torque, the sign and the unit of torque.")
    METHODS_CONTRADICT = (
        915, "Two methods contradict each other",
        "A cross-check of the same run finds a clearly different inertia.",
        "Check load, friction and torque scale, and repeat the run.")
    TORQUE_AT_SPEED_CHANGED = (
        916, "The torque at one speed changed during the run",
        "Steady rotation at the same speed takes far more or far less torque than before.",
        "Check that torque keeps one scale in all stages and that the load stays the same. Repeat the run.")
    STRING_IMPEDANCE_DIFFERS = (
        917, "The string's impedance is not that of the declared pipe",
        "The waves travel as in the pipe, but torque over speed differs by a constant factor.",
        "Check the pipe's diameters in rig.yaml, the rated torque and the speed unit.")
    SPEED_JUMPED = (
        918, "The reported speed jumped during the run",
        "Within 0.1 s the speed changed by more than torque and string can cause.",
        "Check the encoder, its cable and its scale. Repeat the run.")
    SEVERITY_REFUSED = (
        925, "The record does not show the string's torsional motion",
        "The record is too short, its sample rate is too low, it has too many gaps, or the string does not turn.",
        "Use a longer record of rotation, with at least sixteen samples in each period of the string.")

    # --- 10xx: nothing readable in a file ----------------------------------------------------------------------------
    NOTHING_RECOVERABLE = (
        1000, "Nothing can be read from the log",
        "The file is empty, damaged from its start, or not an MCAP file.",
        "Look for a copy, or repeat the run.")
    NOTHING_RECORDED = (
        1001, "The run of this log ended before motion",
        "The log holds no samples to identify from.",
        "Read why the run ended, and repeat it.")
    CSV_UNUSABLE = (
        1010, "The CSV trace is not usable",
        "The file holds no table of numbers with time, speed and torque in order.",
        "Export the trace again, as CSV with one header line.")

    # --- 11xx: tuning refused ----------------------------------------------------------------------------------------
    TUNING_REFUSED = (
        1100, "These gains are not recommended",
        "Within the intervals of the result, the requested gains could make the string oscillate.",
        "Choose values within the bounds that the message states.")
    NO_INERTIA_TO_TUNE = (
        1101, "The result has no inertia to tune for",
        "The verdict of the result is a refusal, or its interval includes zero.",
        "Identify again with the motion that the verdict advises.")

    # --- 12xx: rehearsal or acceptance not passed --------------------------------------------------------------------
    REHEARSAL_FAILED = (
        1200, "A rehearsed fault did not cause the required reaction",
        "The run did not end as the fault table requires, or its interval misses the true inertia. Or the simulated"
        " shaft was unsafe. It was too fast, was disabled while it turned, or was falsely reported at standstill.",
        "Compare the required reaction with what was seen. A weaker fault may stay below what tdhil detects.")
    ACCEPTANCE_FAILED = (
        1201, "An identified value contradicts the expected one",
        "The interval of the identified value does not overlap the tolerance of the expected value.",
        "Compare each row of the card. Correct the machine, or the expected value in rig.yaml.")
    EVIDENCE_FAILED = (
        1202, "An archive of evidence did not pass its check",
        "The archive was changed, is incomplete, contains a private text, or its result does not follow from its log.",
        "Request the archive and its SHA-256 from the publisher again.")

    # --- 13xx: interrupted -------------------------------------------------------------------------------------------
    INTERRUPTED = (
        1300, "The run was interrupted",
        "The operator pressed Ctrl-C, or the system ended the process.",
        "After a run, read in its last lines whether standstill was confirmed.")

    def __init__(self, number: int, title: str, cause: str, cure: str) -> None:
        self.number = number
        self.title = title
        self.cause = cause
        self.cure = cure

    @property
    def code(self) -> str:
        """Code as shown in messages: ``TDH-001``, ``TDH-412``, ``TDH-1010``."""
        return f"{PREFIX}{self.number:03d}"

    @property
    def group(self) -> int:
        """Exit code of the entry; 13 for all signals (130 and above)."""
        return self.number // 100


class CodedText(str):
    """A sentence with its entry of the table. It is a plain text that keeps its code."""

    __slots__ = ("entry",)
    entry: MessageCode

    def __new__(cls, text: str, entry: MessageCode) -> "CodedText":
        made = super().__new__(cls, text)
        made.entry = entry
        return made

    def __getnewargs__(self) -> tuple[Any, ...]:
        return str(self), self.entry


def entry_of(text: str, otherwise: MessageCode) -> MessageCode:
    """Return the entry that a text carries; ``otherwise`` for a plain text."""
    return text.entry if isinstance(text, CodedText) else otherwise


def with_code(text: str, code: str) -> str:
    """Return a text as shown to the user: with the code behind it in brackets."""
    return f"{text} [{code}]" if code else text


def message_of(code: str) -> MessageCode | None:
    """Return the entry of a code as a user types it: ``TDH-412``, ``tdh412`` or ``412``; None for no code."""
    digits = code.strip().upper().removeprefix("TDH").removeprefix("-")
    if not digits.isdecimal():
        return None
    return next((entry for entry in MessageCode if entry.number == int(digits)), None)
