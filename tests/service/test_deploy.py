"""Installation: systemd unit, container, and an upgrade that is refused while a shaft moves."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tdhil.cli.main import build_parser, main
from tdhil.errors import ExitCode
from tdhil.service.limits import STOP_S
from tdhil.service.run_channel import lives
from tdhil.session import hold, holder_of, holders
from tdhil.session.drive_lock import FOLDERS
from tdhil.session.real_time import PRIORITY
from tests.service.conftest import wait_for

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"


# -- is anything moving?


@pytest.fixture(autouse=True)
def locks(tmp_path, monkeypatch):
    """Use an own folder for locks, since other tests may use this computer."""
    folder = tmp_path / "lock"
    folder.mkdir()
    folder.chmod(0o1777)
    monkeypatch.setattr("tdhil.session.drive_lock.FOLDERS", (str(folder),))


def idle(data: Path) -> int:
    return main(["serve", "--check-idle", "--data", str(data)])


def test_a_live_run_prevents_an_upgrade_with_or_without_its_web(service, capsys):
    assert idle(service.store.folder) == ExitCode.OK
    run = service.supervisor.start_run("a", {"note": "hold"}, "test").request.id
    assert idle(service.store.folder) == ExitCode.REFUSED                  # from its request on
    assert f"run {run} has not ended" in capsys.readouterr().err
    service.wait(run, "moving")
    service.supervisor.close()
    assert idle(service.store.folder) == ExitCode.REFUSED
    service.supervisor.stop(run, "test")
    wait_for("the end", lambda: idle(service.store.folder) == ExitCode.OK)


def test_an_unconfirmed_stop_prevents_an_upgrade_until_the_sign_off(service, capsys):
    run = service.supervisor.start_run("a", {"note": "unseen"}, "test").request.id
    service.wait(run, "stop_not_confirmed")
    wait_for("its end", lambda: not lives(service.store.place(run)))
    assert idle(service.store.folder) == ExitCode.REFUSED
    assert "neither confirmed nor signed off" in capsys.readouterr().err
    service.supervisor.sign_off(run, "test", "it stands")
    assert idle(service.store.folder) == ExitCode.OK


def test_a_drive_in_use_by_a_terminal_prevents_an_upgrade(tmp_path, capsys, nobody_s_port):
    assert holders() == []
    one, other = (f"modbus 127.0.0.1:{nobody_s_port} unit {unit}" for unit in (1, 2))
    with hold(one), hold(other):
        assert sorted(map(str, holders())) == sorted(str(holder_of(address)) for address in (one, other))
        assert idle(tmp_path / "none") == ExitCode.REFUSED
        assert f"a drive is held by process {os.getpid()}" in capsys.readouterr().err
    assert idle(tmp_path / "none") == ExitCode.USAGE       # a misspelt command gives no answer
    assert not (tmp_path / "none").exists()


@pytest.fixture
def host(tmp_path):
    """Return an installation whose commands only record their calls; tdhil returns the ``codes``."""
    home, called = tmp_path / "home", tmp_path / "called.txt"
    (home / "bin").mkdir(parents=True)

    def command(name: str, body: str = "") -> None:
        path = home / "bin" / name
        path.write_text(f'#!/bin/sh\necho "{name} $*" >>"{called}"\n{body}\n')
        path.chmod(0o755)

    def upgrade(*codes: int, pip: int = 0) -> tuple[int, list[str]]:
        (tmp_path / "codes").write_text("".join(f"{one}\n" for one in codes))
        command("tdhil", f'code=$(head -n1 "{tmp_path}/codes"); sed -i 1d "{tmp_path}/codes"; exit "$code"')
        command("systemctl")
        command("pip", f"exit {pip}")
        environment = {"PATH": f"{home / 'bin'}:{os.environ['PATH']}", "TDHIL_HOME": str(home), "TDHIL_DATA": "/d"}
        done = subprocess.run([DEPLOY / "upgrade", "tdhil.whl"], env=environment, capture_output=True, text=True)
        return done.returncode, [line.replace("serve --check-idle --data /d", "idle?")
                                 for line in called.read_text().splitlines()]

    return upgrade


@pytest.mark.parametrize(("codes", "pip", "exits", "did"), [
    ((0, 0), 0, 0, ["tdhil idle?", "systemctl stop tdhil.service", "tdhil idle?", "pip install --upgrade tdhil.whl",
                    "systemctl start tdhil.service"]),
    ((4,), 0, 4, ["tdhil idle?"]),
    ((0, 4), 0, 4, ["tdhil idle?", "systemctl stop tdhil.service", "tdhil idle?", "systemctl start tdhil.service"]),
    ((0, 0), 1, 1, ["tdhil idle?", "systemctl stop tdhil.service", "tdhil idle?", "pip install --upgrade tdhil.whl",
                    "systemctl start tdhil.service"]),
])
def test_an_upgrade_while_something_moves_is_refused(host, codes, pip, exits, did):
    assert host(*codes, pip=pip) == (exits, did)


# -- systemd


def settings() -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for line in (DEPLOY / "tdhil.service").read_text().splitlines():
        if re.match(r"\w+=", line):
            name, _, value = line.partition("=")
            found.setdefault(name, []).append(value)
    return found


def test_the_unit_stops_as_the_service_does():
    unit = settings()
    assert unit["KillMode"] == ["process"]                 # runs outlive their web server, and brake normally
    assert unit["KillSignal"] == ["SIGTERM"]
    assert float(unit["TimeoutStopSec"][0]) > STOP_S + 10.0
    assert "ExecStop" not in unit
    assert "ExecStartPre" not in unit                      # a web server that died is restarted, even during motion
    assert unit["RestartPreventExitStatus"] == [str(int(ExitCode.USAGE))]


def test_the_unit_allows_what_a_run_needs():
    unit = settings()
    assert int(unit["LimitRTPRIO"][0]) >= PRIORITY
    assert unit["LimitMEMLOCK"] == ["infinity"]
    assert unit["ReadWritePaths"] == [f"-{FOLDERS[0]}"]     # one lock for terminals and service
    assert {"AF_UNIX", "AF_INET", "AF_INET6", "AF_CAN"} <= set(unit["RestrictAddressFamilies"][0].split())
    program, *words = shlex.split(unit["ExecStart"][0].replace("$TDHIL_OPTIONS", "--mqtt mqtts://broker.example/site"))
    assert program == "/opt/tdhil/bin/tdhil"
    options = build_parser("serve").parse_args(words)
    assert options.data == Path("/var/lib") / unit["StateDirectory"][0]
    assert options.rigs.parent == Path("/etc") / unit["ConfigurationDirectory"][0]


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd here (apt-get install systemd)")
def test_systemd_accepts_the_unit(tmp_path):
    copy = tmp_path / "tdhil.service"
    copy.write_text((DEPLOY / "tdhil.service").read_text().replace("/opt/tdhil/bin/tdhil", sys.executable))
    done = subprocess.run(["systemd-analyze", "verify", copy], capture_output=True, text=True)
    assert (done.returncode, done.stderr + done.stdout) == (0, "")
    done = subprocess.run(["systemd-analyze", "security", "--offline=true", "--threshold=30", "--no-pager", copy],
                          capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-300:] + done.stderr


@pytest.mark.heavy
@pytest.mark.skipif(sys.platform != "linux", reason="oom_score_adj is Linux's")
def test_computation_is_killed_first_if_memory_runs_out():
    code = ("import pathlib, sys; from tdhil.service import worker; worker.main(['plan']);"
            "print(pathlib.Path('/proc/self/oom_score_adj').read_text(), file=sys.stderr)")
    done = subprocess.run([sys.executable, "-c", code], input=b"{}", capture_output=True)
    assert int(done.stderr.split()[-1]) == 500


# -- a container


def test_the_recipe_of_the_container_names_existing_files_and_no_foreign_registry():
    text = (DEPLOY / "Dockerfile").read_text()
    steps = [line.split(maxsplit=1) for line in text.replace("\\\n", " ").splitlines() if re.match(r"[A-Z]+ ", line)]
    images = [rest.split()[0] for word, rest in steps if word == "FROM"]
    assert images
    assert not [one for one in images if re.search(r"[./].*/|@", one)]
    assert not re.search(r"--(extra-)?index[-]url|https?:/{2}", text)
    copied = [part for word, rest in steps if word == "COPY" and not rest.startswith("--from")
              for part in rest.split()[:-1]]
    assert [one for one in copied if not (ROOT / one).exists()] == []
    needed = tomllib.loads((ROOT / "pyproject.toml").read_text())
    built = needed["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert {*built["packages"], *built["force-include"]} <= set(copied)
    extras = re.search(r"'\.\[([\w,]+)\]'", text).group(1).split(",")
    assert set(extras) <= set(needed["project"]["optional-dependencies"])
    (entry,) = [rest for word, rest in steps if word == "ENTRYPOINT"]
    assert build_parser("serve").parse_args(re.findall(r'"([^"]+)"', entry)[1:]).data == Path("/data")
    (check,) = [rest for word, rest in steps if word == "HEALTHCHECK"]
    code = re.findall(r'"([^"]+)"', check)[2]
    for address in ("http://127.0.0.1:1", "https://127.0.0.1:1"):      # no service: unhealthy, without another error
        done = subprocess.run([sys.executable, "-c", code.replace(":8420", ":1")], capture_output=True, text=True,
                              env={**os.environ, "TDHIL_HEALTH": address.partition(":")[0]})
        assert (done.returncode, "refused" in done.stderr) == (1, True), done.stderr
    assert ("STOPSIGNAL", signal.SIGTERM.name) in [tuple(one) for one in steps]
