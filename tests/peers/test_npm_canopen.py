"""The npm package `canopen`, an independent CANopen stack: master of the simulated drive, and slave of the driver.

How to get it and run these: tests/peers/conftest.py. Its frames are its own; socketcand_channel.mjs only carries them
to our hub. What the package leaves out is typed in the .mjs files and said there: the state machine of CiA 402, the
shaft, the boot-up message, the reaction to a lost heartbeat.
"""

import json
import math
import subprocess

import can
import pytest

from drivers.canopen.drive import CanopenDrive
from drivers.clock import MonotonicClock, SteppedClock
from drivers.drive import Command, DriveLimits, Mode, Outcome, PowerState
from profiles.library import load_canopen_profile
from tdhil.recording.log_reader import read_frames
from tests.path.path_runs import HANGS_S, STAGES, identify, peer, process, tdhil
from tests.peers.hub_thread import open_hub

NODE = 5
RPM = math.pi / 30.0
NO_OBJECT, NO_SUB, READ_ONLY, TOO_HIGH = 0x06020000, 0x06090011, 0x06010002, 0x06090031
"""SDO abort codes (CiA 301)."""
SLAVE_INERTIA, SLAVE_VISCOUS, SLAVE_COULOMB = 60.0, 6.0, 40.0      # npm_slave.mjs


# -- as a master ---------------------------------------------------------------------------------------------


@pytest.fixture
def steps(node_program, tmp_path):
    """Return the findings of the foreign master, step by step, and the motion of the simulated shaft."""
    command, environment = node_program("npm_master.mjs")
    with peer(tmp_path, "--seed", 1, "--node", NODE) as drive:
        port = dict(option.split("=") for option in drive.options if "=" in option)["port"]
        with process(*command, "127.0.0.1", port, NODE, env=environment, stdout=subprocess.PIPE,
                     stderr=subprocess.PIPE) as master:
            out, err = master.communicate(timeout=HANGS_S)
        assert master.returncode == 0, err
        found = [json.loads(line) for line in out.splitlines()]
        drive.child.terminate()
        drive.child.wait(HANGS_S)
        return {step.pop("step"): step for step in found}, drive.shaft


def test_a_foreign_master_drives_our_simulated_drive(steps):
    found, shaft = steps
    assert list(found) == ["sdo", "mode", "nmt", "pdo", "watchdog"]

    sdo = found["sdo"]
    assert sdo["device_type"] & 0xFFFF == 402
    assert sdo["name"]
    assert sdo["marker"] == "tdhil simulated drive"            # a segmented transfer
    assert sdo["identity"] == [0, 402, 0x00010000]             # profiles/generic/cia402.eds
    assert sdo["modes"] & 0x30C == 0x30C
    assert (sdo["no_object"], sdo["no_sub"]) == (NO_OBJECT, NO_SUB)
    assert (sdo["read_only"], sdo["beyond_its_range"]) == (READ_ONLY, TOO_HIGH)
    assert sdo["block"] == sdo["marker"]                       # and a block transfer, with its CRC
    assert found["mode"]["shown"] == 3

    nmt = found["nmt"]
    assert nmt["boot_up"] == 0
    assert nmt["states"] == [5, 4, True, 127]                  # True: in STOPPED no SDO is served

    pdo = found["pdo"]
    assert pdo["walked"] == [True, True, True]
    assert pdo["turning"]["velocity"] == pytest.approx(300, abs=5)
    assert pdo["turning"]["torque"] == pytest.approx(60.0 + 8.0 * 30.0 * RPM, abs=8)    # per mille of 1000 N·m
    assert pdo["stopping"] == 0x07
    assert abs(pdo["stopped"]["velocity"]) <= 5
    assert pdo["stopped"]["state"] == 0x07
    assert pdo["disabled"]

    watchdog = found["watchdog"]
    assert watchdog["before"] > 200
    assert abs(watchdog["after"]) <= 5
    assert watchdog["state"] == 0x07                           # quick stop active: held (6007h = 3)
    assert 0x8130 in watchdog["emergencies"]                   # life guard or heartbeat error (CiA 301)
    assert watchdog["error_code"] == 0x8130

    assert shaft.speed_rad_s.max() == pytest.approx(30.0 * RPM, rel=0.1)
    lost_s = shaft.events("host heartbeat lost")[-1]
    assert shaft.at_rest_from() > lost_s
    shaft.assert_never_let_go()


# -- as a slave ----------------------------------------------------------------------------------------------


@pytest.fixture
def slave(node_program):
    """Yield (hub, process of the slave): a foreign drive on its own hub."""
    command, environment = node_program("npm_slave.mjs")
    with open_hub() as hub, process(*command, hub.host, hub.port, NODE, env=environment, stdout=subprocess.PIPE,
                                    stderr=subprocess.PIPE) as child:
        ready = child.stdout.readline()
        assert "ready" in ready, child.stderr.read()
        yield hub, child


def bus_options(hub):
    return {"interface": "socketcand", "channel": hub.channel, "host": hub.host, "port": hub.port, "tcp_tune": True}


def driver(hub, clock, **options):
    bus = can.Bus(**bus_options(hub))
    return CanopenDrive(bus, load_canopen_profile("generic/cia402"), clock, node=NODE, **options)


def last_words(child):
    child.terminate()
    out, err = child.communicate(timeout=HANGS_S)
    assert not err, err
    return [json.loads(line) for line in out.splitlines()]


def cycles(drive, seconds, mode=Mode.SPEED, speed=0.0, torque=0.0):
    samples = [drive.exchange(Command(mode, speed, torque)) for _ in range(round(seconds / drive.period_s))]
    assert all(sample.fresh for sample in samples)
    return samples[-1]


def test_our_driver_drives_a_foreign_slave(slave):
    hub, child = slave
    drive = driver(hub, SteppedClock(), rate_hz=100.0)
    identity = drive.connect()
    assert (identity.vendor, identity.product, identity.revision, identity.serial) == (0, 402, 0x10000, 7)
    assert identity.name == "npm canopen drive"
    assert identity.simulated
    found = drive.preflight(DriveLimits(speed_rad_s=10.0, torque_nm=300.0, quick_stop_rad_s2=2.0, watchdog_s=5.0))
    wrong = [check for check in found.checks if check.outcome is Outcome.REFUSED]
    assert found.refused == (), wrong
    assert found.rated_torque_nm == pytest.approx(1000.0)
    assert found.modes == {Mode.SPEED, Mode.TORQUE}

    drive.enable(Mode.SPEED)
    steady = cycles(drive, 6.0, speed=4.0)
    assert steady.state is PowerState.ENABLED
    assert steady.mode is Mode.SPEED
    assert steady.speed_rad_s == pytest.approx(4.0, abs=0.02)
    friction = SLAVE_COULOMB + SLAVE_VISCOUS * 4.0
    assert steady.torque_nm == pytest.approx(friction, abs=3.0)

    cycles(drive, 0.5, Mode.TORQUE, 4.0, steady.torque_nm)
    faster = cycles(drive, 1.0, Mode.TORQUE, 4.0, steady.torque_nm + 60.0)
    assert faster.mode is Mode.TORQUE
    assert faster.speed_rad_s - 4.0 == pytest.approx(
        60.0 / SLAVE_VISCOUS * (1.0 - math.exp(-SLAVE_VISCOUS / SLAVE_INERTIA)), rel=0.05)

    drive.quick_stop()
    stopped = cycles(drive, 4.0, Mode.TORQUE, 4.0, 100.0)
    assert stopped.state is PowerState.QUICK_STOP
    assert stopped.standstill
    drive.disable()
    assert cycles(drive, 0.2).state is PowerState.OFF
    assert drive.close() == ()
    (end,) = [line for line in last_words(child) if line["event"] == "end"]
    assert end["speed"] == 0.0
    assert end["syncs"] == drive.counters.cycles


def test_a_foreign_slave_loses_our_heartbeat(slave):
    """The driver arms it over SDO, and the timer of the package detects the loss, in real time."""
    hub, child = slave
    drive = driver(hub, MonotonicClock(), rate_hz=50.0)
    drive.connect()
    assert drive.preflight(DriveLimits(10.0, 300.0, 2.0, watchdog_s=3.0)).refused == ()
    drive.enable(Mode.SPEED)
    for _ in range(100):
        drive.exchange(Command(Mode.SPEED, 2.0, 0.0))
    lost = json.loads(child.stdout.readline())      # no more exchange: the watchdog must act
    assert lost["event"] == "heartbeat lost"
    assert lost["node"] == 127
    assert lost["turning"] > 0.5
    assert (lost["speed"], lost["state"]) == (0.0, 0x07)
    drive.close()


def test_the_five_stages_on_a_foreign_slave(slave, tmp_path):
    """The whole of `tdhil identify` runs without the simulator: J of the package's drive, and its replay."""
    hub, child = slave
    done = identify(
        tmp_path, "-i", "socketcand", "-c", hub.channel, "--bus-kwargs", f"host={hub.host}", f"port={hub.port}",
        "--node", NODE, "--stepped", "--rate", 50, "--periods", 3,
    )
    assert done.code == 0, done.err
    assert done.outcomes == [(name, "ok") for name in STAGES]
    inertia = done.document["inertia_kg_m2"]
    assert inertia["value"] == pytest.approx(SLAVE_INERTIA, rel=0.03)
    assert done.document["simulated"] is True
    assert {0x080, 0x180 + NODE, 0x200 + NODE, 0x700 + NODE, 0x77F} <= {
        frame.identifier for frame in read_frames(done.log)
    }
    assert tdhil("replay", "--json", done.log).document == done.document
    (end,) = [line for line in last_words(child) if line["event"] == "end"]
    assert (end["speed"], end["state"]) == (0.0, 0x40)
