"""`tdhil stop` on drives in their own process: turned by another master, dead, or faulty."""

import signal
import socket
import sys

import can
import pytest

from tests.path.path_runs import HANGS_S, QUICK, host, peer, process, tdhil, wait_for
from tests.rigs import PATIENT_LIMITS, rig_file

pytestmark = pytest.mark.real_time

NODE = 1
SENTENCE = "STOP NOT CONFIRMED: use the hard-wired emergency stop now"
REAL_TIME = ("--seed", 1)


def stop(drive, *arguments):
    return tdhil("stop", *drive.options, "--node", NODE, *arguments)


class Master:
    """Other master that enables and turns the shaft. With ``stubborn`` it never stops its RPDO and SYNC."""

    def __init__(self, drive):
        from drivers.canopen.bus import CanLink
        from drivers.canopen.sdo import SdoObjects
        from drivers.clock import MonotonicClock

        options = dict(text.split("=") for text in drive.options if "=" in text)
        self.bus = can.Bus(interface="socketcand", channel=drive.options[3], host=options["host"],
                           port=int(options["port"]), tcp_tune=True)
        self.link = CanLink(self.bus, MonotonicClock())
        self.objects = SdoObjects(self.link, NODE)
        self.patient = self.objects.answered_within(30.0)       # a drive on a busy computer replies late

    def __enter__(self):
        self.patient.__enter__()
        return self

    def __exit__(self, *exc):
        self.patient.__exit__(*exc)
        self.bus.shutdown()

    def turn(self, speed_lsb=400, option=6):
        write = self.objects.write
        write(0x605A, 0, option, 16)
        write(0x6085, 0, 300, 32)                     # 0.1 rpm/s: 3.1 rad/s²
        write(0x6060, 0, 9, 8)
        for word in (0x06, 0x07, 0x0F):
            write(0x6040, 0, word, 16)
        write(0x60FF, 0, speed_lsb, 32)
        assert wait_for("speed", lambda: self.objects.read(0x606C, signed=True) > 0.5 * speed_lsb)

    def state(self):
        return self.objects.read(0x6041) & 0x6F


@pytest.fixture
def turning(tmp_path):
    with peer(tmp_path, *REAL_TIME) as drive, Master(drive) as master:
        yield drive, master


def test_a_turning_shaft_is_stopped_and_never_disabled(turning):
    drive, master = turning
    master.turn()
    done = stop(drive, "--json")
    assert done.code == 0, done.err + done.out
    assert "NO emergency stop" in done.err
    assert (done.document["ended"], done.document["emergency_stop"]) == ("at rest", False)
    assert done.document["first"]["speed"] > 2.0
    assert abs(done.document["last"]["speed"]) < 0.1
    assert "quick stop active" in done.document["last"]["state"]
    assert master.state() == 0x07
    shaft = drive.shaft
    assert abs(shaft.speed_rad_s[-1]) < 0.05
    assert shaft.state[-1] == "quick stop active"      # enabled, not disabled


@pytest.mark.heavy
def test_a_drive_that_is_already_disabled_is_not_changed(turning):
    drive, _ = turning
    done = stop(drive)
    assert done.code == 0
    assert "switch on disabled" in done.out
    assert "at standstill" in done.out.splitlines()[-1]
    assert drive.shaft.state[-1] == "switch on disabled"


@pytest.mark.heavy
def test_a_quick_stop_that_would_coast_is_replaced_first(turning):
    drive, master = turning
    master.turn(option=0)
    done = stop(drive)
    assert done.code == 0
    assert "605Ah was changed from 0 to 6" in done.out
    assert drive.shaft.state[-1] == "quick stop active"


@pytest.mark.heavy
def test_a_stop_during_a_run_of_tdhil(tmp_path):
    """With two masters in three processes, the run finds the other master and ends with its own stop."""
    rig = rig_file(tmp_path, "rate_hz: 4\n", PATIENT_LIMITS)
    with peer(tmp_path, *REAL_TIME) as drive, host(tmp_path, *drive.options, "--rig", rig, "--yes") as running:
        assert running.wait_for_line("stage speed …"), running.err
        turns = wait_for("speed", lambda: max(drive.shaft.speed_rad_s, default=0.0) > 1.0, running.child)
        assert turns, running.err
        done = stop(drive)
        ended = running.finish()
        shaft = drive.shaft
    assert done.code == 0, done.out
    assert "another master is on the bus" in done.out
    assert ended.code in (5, 6, 8), ended.err        # 5: the run found another master
    assert abs(shaft.speed_rad_s[-1]) < 0.05
    shaft.assert_never_let_go()


STUBBORN = """
import sys, time, can
channel, host, port = sys.argv[1:4]
bus = can.Bus(interface="socketcand", channel=channel, host=host, port=int(port), tcp_tune=True)
send = lambda identifier, data=b"": bus.send(
    can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
send(0x000, bytes((1, 1)))
print("on", flush=True)
while True:
    send(0x201, (0x0F).to_bytes(2, "little"))
    send(0x080)
    while bus.recv(0.0) is not None:
        pass
    time.sleep(0.005)
"""


@pytest.mark.heavy
def test_a_master_that_enables_repeatedly_loses_its_rpdo(turning):
    drive, master = turning
    master.objects.write(0x1400, 1, 0x80000201, 32)
    master.objects.write(0x1600, 0, 0, 8)
    master.objects.write(0x1600, 1, 0x60400010, 32)
    master.objects.write(0x1600, 0, 1, 8)
    master.objects.write(0x1400, 2, 1, 8)
    master.objects.write(0x1400, 1, 0x201, 32)
    master.turn()
    found = dict(text.split("=") for text in drive.options if "=" in text)
    with process(sys.executable, "-c", STUBBORN, drive.options[3], found["host"], found["port"],
                 stdout=-1) as other:
        assert other.stdout.readline() == "on\n"
        done = stop(drive)
    assert done.code == 0, done.out
    assert "another master is on the bus" in done.out
    assert "1400h:1 = 80000201h" in done.out
    assert drive.shaft.state[-1] == "quick stop active"


@pytest.mark.heavy
def test_no_reply(tmp_path):
    with peer(tmp_path, *REAL_TIME) as drive:
        done = tdhil("stop", *drive.options, "--node", 5)
    assert done.code == 8
    assert "NO ANSWER" in done.out
    assert SENTENCE in done.out


MODBUS_TCP = ("--host", "127.0.0.1", "--port")
HUB = ("-i", "socketcand", "-c", "can0", "--bus-kwargs", "host=127.0.0.1")


def test_without_an_address_it_says_that_nothing_was_sent():
    done = tdhil("stop")
    text = done.err.replace("\n", " ")
    assert done.code == 2
    assert "nothing was sent, and the shaft may still turn" in text and "hard-wired emergency stop" in text
    assert "tdhil stop --rig rig.yaml" in text


@pytest.mark.parametrize("dead", [
    "closed Modbus port", pytest.param("silent Modbus host", marks=pytest.mark.heavy), "closed hub",
    "hub that says nothing", "no serial device"])
@pytest.mark.parametrize("as_json", [
    pytest.param((), id="text"), pytest.param(("--json",), id="json", marks=pytest.mark.heavy),
])
def test_where_nobody_is_reached(dead, as_json, no_bus_of_the_user):
    """Any fault of the connection gives exit 8 and the message on the stop, not only a connection error."""
    with socket.create_server(("127.0.0.1", 0)) as listening, socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))           # and no other server uses this port
        mute, closed = listening.getsockname()[1], taken.getsockname()[1]
        line = {
            "closed Modbus port": (*MODBUS_TCP, closed), "silent Modbus host": (*MODBUS_TCP, mute),
            "closed hub": (*HUB, f"port={closed}"), "hub that says nothing": (*HUB, f"port={mute}"),
            "no serial device": ("--serial", "/dev/there-is-none"),
        }[dead]
        done = tdhil("stop", *line, *as_json)
    assert done.code == 8, done.err + done.out
    assert SENTENCE in done.out
    assert "Traceback" not in done.err
    if as_json:
        assert done.document["exit_code"] == 8 and SENTENCE in done.document["said"]


@pytest.mark.heavy
def test_a_hub_that_dies_while_it_stops(turning):
    drive, master = turning
    master.turn()
    master.objects.write(0x6085, 0, 120, 32)
    with process(sys.executable, "-m", "tdhil", "stop", *drive.options, "--node", NODE, stdout=-1, stderr=-1) as child:
        assert wait_for("stop", lambda: master.state() == 0x07)
        drive.child.kill()
        out, err = child.communicate(timeout=HANGS_S)
    assert child.returncode == 8, err
    assert SENTENCE in out + err and "Traceback" not in err


@pytest.mark.heavy
def test_a_drive_that_can_not_brake_is_still_turning(turning, monkeypatch):
    from drivers import quick_stop

    monkeypatch.setattr(quick_stop, "NO_SLOWER_S", 1.0)
    drive, master = turning
    master.turn(speed_lsb=800)
    master.objects.write(0x6085, 0, 1, 32)             # nearly no deceleration: 0.1 rpm/s
    monkeypatch.setattr(quick_stop, "SLOWER", 0.5)
    done = stop(drive)
    assert done.code == 8
    assert "Standstill was NOT observed" in done.out and SENTENCE in done.out
    assert drive.shaft.state[-1] == "quick stop active"


@pytest.mark.heavy
def test_a_stepped_drive_whose_host_has_died_is_stopped_too(tmp_path):
    with peer(tmp_path, *REAL_TIME, "--stepped") as drive, host(
        tmp_path, *drive.options, "--stepped", *QUICK, "--periods", 40
    ) as running:
        assert running.wait_for_line("stage torque …"), running.err
        running.signal(signal.SIGKILL)
        running.child.wait()
        done = stop(drive)
    assert done.code == 0, done.out


def test_without_a_bus_it_names_the_required_options():
    done = tdhil("stop")
    assert done.code == 2
    assert "--host" in done.err


@pytest.mark.heavy
@pytest.mark.parametrize("number", [signal.SIGINT])
def test_ctrl_c_ends_the_watching_only(turning, number):
    drive, master = turning
    master.turn()
    master.objects.write(0x6085, 0, 120, 32)           # slowly, so that the watch lasts
    with process(sys.executable, "-m", "tdhil", "stop", *drive.options, "--node", NODE, stderr=-1) as child:
        assert wait_for("stop", lambda: master.state() == 0x07)
        child.send_signal(number)
        assert child.wait(HANGS_S) in (8, -2)      # not confirmed: a script must not count it as a stop
    assert wait_for("rest", lambda: abs(master.objects.read(0x606C, signed=True)) < 5)
