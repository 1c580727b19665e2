"""Guard with the usual limits, and the samples for it."""

from dataclasses import replace

from drivers.drive import Command, Mode, PowerState, Sample
from tdhil.runner.excitation import RigGuess
from tdhil.runner.guard import Guard
from tdhil.runner.settings import ControlAssumptions
from tests.runner.fake_drive import LIMITS, PERIOD_S, SPEED_RESOLUTION, TORQUE_RESOLUTION

REST = Command(Mode.SPEED, 0.0, 0.0)
OFFSET = Command(Mode.SPEED, 5.0, 0.0, 20.0)
REVERSIBLE = replace(LIMITS, allow_reverse=True)
MODEL = RigGuess(inertia_kg_m2=100.0, viscous_nm_s_rad=10.0, coulomb_nm=50.0)


def guard(limits=LIMITS, **assumptions):
    return Guard(limits, PERIOD_S, SPEED_RESOLUTION, TORQUE_RESOLUTION, ControlAssumptions(**assumptions))


def sample(speed=0.0, torque=0.0, *, time_s=0.0, fresh=True, state=PowerState.ENABLED):
    return Sample(time_s, 0.0, 0.0, fresh, speed, torque, None, Mode.SPEED, state, False, False, 0x27)
