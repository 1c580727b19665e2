"""An aborted run is not resumed: the next run begins with its own connection, preflight and stage 1."""

import subprocess
import sys
from pathlib import Path

import pytest

from drivers.drive import PowerState
from drivers.errors import DriveFault
from tdhil.cli.main import build_parser
from tdhil.runner.task import STAGES
from tests.runner.fake_drive import World

ROOT = Path(__file__).parents[2]


@pytest.mark.heavy
@pytest.mark.parametrize("stage", STAGES)
def test_after_an_abort_in_any_stage_a_run_begins_anew(world, stage):
    here = world()
    cause = DriveFault("EMCY 7305h")

    def fail(name, seen):
        if name == stage and seen == (120 if stage == "setup" else 20):
            raise cause

    here.display.on_cycle = fail
    aborted = here.runner().run()
    assert aborted.cause is cause
    assert aborted.stages[-1].name == stage
    assert here.drive.state is PowerState.OFF
    said = [call for call in here.drive.calls if call != "exchange"]
    assert said[-2:] == ["disable", "close"]          # the drive is not left enabled, so no run can be resumed

    again = World(here.drive)
    before = len(here.drive.calls)
    assert again.runner().run().cause is None
    calls = [call for call in here.drive.calls[before:] if call != "exchange"]
    assert calls[:3] == ["connect", "preflight", "enable torque"]
    assert [one.name for one in again.log.stages] == list(STAGES)
    assert len(again.display.preflights) == 1


def test_no_option_of_a_run_takes_up_an_older_one():
    parser = build_parser("identify")
    (commands,) = [action for action in parser._actions if action.dest == "command"]
    options = {flag for action in commands.choices["identify"]._actions for flag in action.option_strings}
    assert not [flag for flag in options for word in ("resume", "continue", "stage", "from") if word in flag]


@pytest.mark.heavy
def test_code_that_reads_the_log_of_an_aborted_run_has_no_access_to_a_drive(tmp_path):
    script = (
        "import sys\n"
        "from pathlib import Path\n"
        "from tests.recording.log_runs import make_run\n"
        "path = Path(sys.argv[1]); make_run(path, 200)\n"
        "path.write_bytes(path.read_bytes()[:-3000])\n"
        "from tdhil.cli.main import main\n"
        "codes = [main(['recover', str(path)]), main(['replay', str(path)])]\n"
        "drives = ('can', 'drivers.canopen.drive', 'drivers.modbus.drive')\n"
        "print(codes, [name for name in drives if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script, tmp_path / "run.mcap"], cwd=ROOT, capture_output=True,
                          text=True, timeout=600)
    assert done.stdout.splitlines()[-1] in ("[3, 9] []", "[3, 3] []"), done.stderr
