"""Command line for users and scripts: stdout, stderr, exit codes, sources of options."""

import json
import subprocess
import sys

import can
import pytest

from sim_bus.canopen.simulator import EmbeddedSimulator
from sim_bus.params import RigParams
from tdhil.recording import RunLog, RunWriter
from tdhil.recording.log_reader import read_run, read_samples
from tests.path.path_runs import QUICK, SHORT, TOO_MUCH, Shaft, Terminal, clean_environment, identify, tdhil
from tests.rigs import plant_file, rig_file

KEYS = {
    "verdict", "model", "inertia_kg_m2", "inertia_main_shaft_kg_m2", "reference_inertia_kg_m2", "viscous_nm_s_rad",
    "coulomb_nm", "speed_lag_s", "torque_lag_s", "skew_s", "paper", "simulated", "log", "stages",
}
ESTIMATE = {"value", "low", "high"}


@pytest.mark.heavy
def test_stdout_is_one_json_document_with_the_promised_keys(tmp_path):
    rig = rig_file(tmp_path, "gear: {ratio: 2.0}\nreference_inertia_kg_m2: 104.0\nrate_hz: 50\n",
                   "run: {json: true, seed: 1, periods: 3}\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path)
        done = tdhil("identify", "--simulate", "--rig", rig)      # json, seed and periods from rig.yaml
    assert done.code == 0, done.err
    document = done.document
    assert document.keys() >= KEYS
    inertia = document["inertia_kg_m2"]
    assert inertia.keys() >= {*ESTIMATE, "low_total", "high_total", "confidence", "conditional_on"}
    assert inertia["low_total"] < inertia["low"] < inertia["value"] < inertia["high"] < inertia["high_total"]
    assert inertia["confidence"] == 0.95
    main_shaft = document["inertia_main_shaft_kg_m2"]
    assert {name: 4.0 * inertia[name] for name in main_shaft} == main_shaft
    assert document["reference_inertia_kg_m2"] == 104.0
    for name in ("viscous_nm_s_rad", "coulomb_nm", "speed_lag_s", "torque_lag_s", "skew_s"):
        assert document[name].keys() >= ESTIMATE
    assert document["paper"].keys() >= {"inertia_kg_m2", "intercept_nm", "r2", "raw_rate"}
    assert document["paper"]["raw_rate"].keys() >= {"inertia_kg_m2", "intercept_nm", "r2"}
    assert all(stage.keys() >= {"name", "outcome", "duration_s"} for stage in document["stages"])
    assert document["log"] == "run.mcap"
    assert (tmp_path / "run.mcap").exists()
    assert "rig.yaml:4" in done.err                               # the source of each value


@pytest.mark.heavy
def test_a_seed_repeats_result_and_samples(short_run, tmp_path):
    runs = [short_run, identify(tmp_path, *SHORT)]
    same = {"log": "", "date": ""}
    assert runs[0].document | same == runs[1].document | same
    assert list(read_samples(runs[0].log)) == list(read_samples(runs[1].log))
    assert runs[0].log.read_bytes() != b""


@pytest.mark.heavy
def test_without_a_seed_one_is_drawn_and_shown(tmp_path):
    runs = [identify(tmp_path, *QUICK, *TOO_MUCH, log=name) for name in ("a.mcap", "b.mcap")]
    seeds = [read_run(done.log).configuration["seed"] for done in runs]
    assert seeds[0] != seeds[1]
    for done, seed in zip(runs, seeds, strict=True):
        assert f"seed {seed}" in done.err.replace("\n", " ")
        assert "no CAN bus is configured" in done.err.replace("\n", " ")
    again = identify(tmp_path, *QUICK, *TOO_MUCH, "--seed", seeds[0], log="c.mcap")
    assert list(read_samples(again.log)) == list(read_samples(runs[0].log))


@pytest.mark.heavy
def test_an_older_log_is_kept(tmp_path):
    (tmp_path / "run.mcap").write_bytes(b"an older run")
    done = identify(tmp_path, "--simulate", *QUICK, *TOO_MUCH)
    (kept,) = [path for path in tmp_path.glob("run-*.mcap") if path.read_bytes() == b"an older run"]
    assert kept.name in done.err.replace("\n", "")
    assert read_run(done.log).complete


# -- errors of the command line ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--nodee", "5"), "--nodee"),
        (("--excitation", "sinus"), "sinus"),
        (("--node", "five"), "--node"),
        (("--profile", "generic/cia40"), "generic/cia402"),
        (("--profile", "no/such.yaml"), "no/such.yaml"),
        (("--node", "300"), "--node"),
        (("--periods", "0"), "--periods"),
        (("--frequency", "-1"), "--frequency"),
        (("--frequency", "nan"), "--frequency"),
        (("--amplitude", "inf"), "--amplitude"),
        (("--confidence", "95"), "--confidence"),
        (("--tolerance", "-1%"), "--tolerance"),
        (("--report", "report.txt"), "ends neither in .html nor in .pdf"),
        (("--real-time", "--stepped"), "exclude"),
        (("--drive", "profibus"), "--drive"),
        (("--drive", "modbus", "-i", "virtual"), "--interface: belongs to CANopen"),
        (("--drive", "canopen", "--host", "192.0.2.10"), "--host: belongs to Modbus"),
        (("--drive", "modbus", "--profile", "generic/cia402"), "--drive says modbus"),
        (("--serial", "/dev/ttyUSB0", "--unit", "300"), "--unit"),
        (("--serial", "/dev/ttyUSB0", "--parity", "X"), "--parity"),
        (("--host", "192.0.2.10", "--stepped"), "--stepped"),
        (("--accept-unverified", "wachdog"), "did you mean 'watchdog'?"),
        (("--rig", "no-rig.yaml"), "no-rig.yaml"),
        (("--plant", "no-plant.yaml"), "no-plant.yaml"),
        (("-i", "nosuch"), "nosuch"),
        (("-i", "socketcan"), "channel"),
    ],
)
def test_a_wrong_command_line_ends_with_2_and_names_what_is_wrong(tmp_path, arguments, said):
    done = tdhil("identify", "--log", tmp_path / "run.mcap", *arguments)
    assert done.code == 2, done.err
    assert said in done.err
    assert "Traceback" not in done.err
    assert "usage:" not in done.err           # two dozen lines that would hide the error
    assert done.out == ""


def test_a_bad_rig_shows_every_problem_with_its_line(tmp_path):
    rig = rig_file(
        tmp_path,
        "node: 1\n"
        "node: 2\n"
        "rate_hz: 1e3\n"
        "allow_reverse: off\n"
        "limits:\n"
        "  speed_max: 10.0\n"
        "  speed_min_rad_s: 0.5\n"
        "run:\n"
        "  periods: 010\n"
    )
    done = tdhil("identify", "--simulate", "--rig", rig)
    assert done.code == 2
    assert "Traceback" not in done.err
    for line in (2, 6, 9):
        assert f"rig.yaml:{line}" in done.err, done.err
    assert "speed_max" in done.err


def test_errors_are_json_too_if_json_is_requested(tmp_path):
    done = identify(tmp_path, "--profile", "generic/cia40")
    assert done.code == done.document["exit_code"] == 2
    assert "generic/cia402" in done.document["error"]["message"]


@pytest.mark.parametrize("size", [200, 2000])
def test_a_log_truncated_before_its_first_sample_is_reported(tmp_path, size):
    """The log has no data, as after an early kill -9. This is no finding about the motion."""
    writer = RunWriter(tmp_path / "whole.mcap", epoch_ns=0, block=True)
    RunLog(writer, {"tdhil": "1", "profile": {"text": "x" * 4000}}).close()
    log = tmp_path / "run.mcap"
    log.write_bytes((tmp_path / "whole.mcap").read_bytes()[:size])
    done = tdhil("replay", log)
    assert done.code == 10
    assert "cut off before its first sample" in done.err
    assert done.out == ""


@pytest.mark.parametrize("content", [b"", b"not a log", b"\x89MCAP0\r\n"])
def test_a_log_without_data_is_reported(tmp_path, content):
    log = tmp_path / "run.mcap"
    log.write_bytes(content)
    done = tdhil("replay", log)
    assert done.code == 10
    assert "Traceback" not in done.err
    assert "run.mcap" in done.err
    assert done.out == ""


def test_a_missing_log_is_a_usage_error(tmp_path):
    done = tdhil("replay", "--json", tmp_path / "none.mcap")
    assert done.code == done.document["exit_code"] == 2
    assert "none.mcap" in done.err
    done = tdhil("replay", tmp_path)
    assert done.code == 2
    step = f"Name one log in it, or identify all of them: tdhil fleet {tmp_path} --out fleet.csv"
    assert f"is a folder. {step}" in done.err


def test_a_missing_server(tmp_path):
    done = identify(tmp_path, "-i", "socketcand", "-c", "can0", "--bus-kwargs", "host=127.0.0.1", "port=1")
    assert done.code == 5
    assert "127.0.0.1:1" in done.err
    assert done.document["exit_code"] == 5


# -- buses from each source ------------------------------------------------------------------------


@pytest.mark.heavy
def test_the_environment_names_the_bus(tmp_path, monkeypatch):
    with EmbeddedSimulator(RigParams(), seed=1, stepped=True) as simulated:
        monkeypatch.setenv("CAN_INTERFACE", "virtual")
        monkeypatch.setenv("CAN_CHANNEL", simulated.channel)
        done = identify(tmp_path, "--stepped", *QUICK, *TOO_MUCH)
    assert done.code == 7, done.err                                # it reached the plan
    assert done.outcomes[1] == ("speed", "ok")
    lines = [" ".join(line.split()) for line in done.err.splitlines()]
    assert "bus interface virtual (CAN_INTERFACE)" in lines
    assert any(line.startswith("bus channel tdhil-") for line in lines)
    assert read_run(done.log).configuration["bus"]["interface"] == {"value": "virtual", "source": "CAN_INTERFACE"}


def test_a_bus_without_a_drive_is_refused_with_the_likely_causes(tmp_path, monkeypatch):
    monkeypatch.setenv("CAN_INTERFACE", "virtual")
    done = identify(tmp_path)
    assert done.code == 4
    assert done.document["error"]["kind"] == "PreflightRefused"
    assert "node-ID" in done.document["error"]["message"]
    assert "bit rate" in done.document["error"]["message"]
    assert "nothing has moved" in done.err


@pytest.mark.heavy
def test_simulate_takes_precedence_over_a_configured_bus(tmp_path, monkeypatch):
    monkeypatch.setenv("CAN_INTERFACE", "virtual")
    done = identify(tmp_path, "--simulate", *QUICK, *TOO_MUCH)
    assert done.code == 7
    assert "SIMULATED" in done.err


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("node", "code", "said"), [(5, 7, "amplitude of 3 rad/s"), (6, 4, "node 6 does not answer")]
)
def test_the_node_is_the_requested_one(tmp_path, node, code, said):
    with EmbeddedSimulator(RigParams(), node_id=5, stepped=True) as simulated:
        done = identify(tmp_path, "-i", "virtual", "-c", simulated.channel, "--stepped", "--node", node,
                        *QUICK, *TOO_MUCH)
    assert done.code == code, done.err
    assert said in done.err


# -- runs with other ends ------------------------------------------------------------------------------------


@pytest.mark.heavy
def test_a_plan_that_does_not_fit_ends_at_standstill(tmp_path):
    trace = tmp_path / "shaft.csv"
    done = identify(tmp_path, "--simulate", "--seed", 1, "--trace", trace, *QUICK, *TOO_MUCH)
    assert done.code == 7
    assert "amplitude of 3 rad/s" in done.err
    assert "before anything moved" not in done.err
    assert "the shaft is at standstill" in done.document["stop"]
    shaft = Shaft.read(trace)
    shaft.assert_enabled(True)
    shaft.assert_stopped_within_settings()


@pytest.mark.heavy
def test_a_drive_in_fault_is_reset_on_the_operator_s_word_only(tmp_path):
    trace = tmp_path / "shaft.csv"
    with EmbeddedSimulator(RigParams(), seed=1, trace=trace, stepped=True) as simulated:
        simulated.simulator.node.application.fault()
        options = ("-i", "virtual", "-c", simulated.channel, "--stepped")
        done = identify(tmp_path, *options, log="a.mcap")
        assert done.code == 4
        assert "--reset-fault" in done.err
        assert "nothing has moved" in done.err
        bus = can.Bus(interface="virtual", channel=simulated.channel)      # keeps the channel for the second run
        again = identify(tmp_path, *options, "--reset-fault", *QUICK, *TOO_MUCH, log="b.mcap")
        bus.shutdown()
    assert again.outcomes[:2] == [("setup", "ok"), ("speed", "ok")]
    assert any(event.kind == "reset" for event in read_run(again.log).events)
    assert "reset" not in {event.kind for event in read_run(done.log).events}
    shaft = Shaft.read(trace)
    enabled_s, reset_s = shaft.events("operation enabled")[0], shaft.events("state: switch on disabled")[0]
    assert reset_s <= enabled_s


@pytest.mark.heavy
def test_one_tone_is_not_identifiable_and_the_paper_s_estimate_is_shown(tmp_path):
    done = identify(tmp_path, "--simulate", "--seed", 1, *QUICK, "--excitation", "sine", "--frequency", 0.5,
                    "--periods", 20)
    assert done.code == 9
    document = done.document
    assert document["verdict"] == "not_identifiable"
    assert document["inertia_kg_m2"] is None
    assert document["advice"]
    assert document["paper"]["inertia_kg_m2"] == pytest.approx(137.0, rel=0.05)
    card = tdhil("replay", done.log)
    assert card.code == 9
    assert "not_identifiable" in card.out
    assert "regression (Xu 2026)" in card.out


@pytest.mark.heavy
def test_speed_mode_skips_the_stages_of_torque_mode(tmp_path):
    done = identify(tmp_path, *SHORT, "--mode", "speed")
    assert done.code in (0, 9), done.err
    assert done.outcomes == [
        ("setup", "ok"), ("speed", "ok"), ("torque", "skipped"), ("hold", "skipped"), ("acquire", "ok")
    ]
    assert read_run(done.log).recording.excitation.mode == "speed"
    assert done.document["inertia_kg_m2"]["value"] == pytest.approx(104.0, rel=0.05)


@pytest.mark.heavy
def test_another_plant_is_another_result(tmp_path):
    plant = plant_file(tmp_path, "plant: {inertia_kg_m2: 60.0}\n")
    done = identify(tmp_path, *SHORT, "--plant", plant)
    assert done.code == 0, done.err
    assert done.document["inertia_kg_m2"]["value"] == pytest.approx(60.0, rel=0.03)


# -- the terminal --------------------------------------------------------------------------------------------


@pytest.mark.heavy
def test_eighty_columns_are_sufficient(tmp_path):
    command = (sys.executable, "-m", "tdhil", "identify", *SHORT)
    with Terminal(*command, columns=80, cwd=tmp_path) as terminal:
        assert terminal.finish() == 0
        lines = [line for part in terminal.plain.split("\n") for line in part.rstrip("\r").split("\r")]
    assert max(map(len, lines)) <= 80
    shown = terminal.plain
    for wanted in ("SIMULATED drive and rig: nothing real turns", "acquire", "rad/s", "left", "verdict", "kg·m²"):
        assert wanted in shown
    assert "moment of inertia at the motor shaft · SIMULATED" in shown


def test_help_is_quick_without_imports(tmp_path):
    code = (
        "import sys, json\n"
        "from tdhil.cli.main import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit as end:\n    assert end.code == 0\n"
        "heavy = {'numpy', 'scipy', 'can', 'canopen', 'pydantic', 'rich', 'mcap', 'yaml', 'pymodbus', 'matplotlib'}\n"
        "print(json.dumps(sorted(heavy & set(sys.modules))), file=sys.stderr)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=clean_environment(), cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert "identify" in done.stdout
    assert "replay" in done.stdout
    assert json.loads(done.stderr) == []


def test_every_command_has_its_help():
    for command in ("identify", "replay", "profiles", "scan", "doctor", "simulate"):
        done = tdhil(command, "--help")
        assert done.code == 0
        assert done.out.startswith("usage: tdhil")
    assert tdhil().code == 2
    assert tdhil("--version").out.startswith("tdhil ")
