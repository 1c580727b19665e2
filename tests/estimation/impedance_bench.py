"""Drive in its speed loop, excited by a torque offset or its reference, as a sum of closed-form linear responses.

It shares no code with the tested code or the simulated drive. The lines of the command, rounding included, pass
through the loop's transfer functions, as do load, ripple and sensor noise, drawn as spectra. Reports are sampled
and rounded.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from tdhil.estimation.case import Case, PeriodicCase
from tdhil.estimation.impedance import measure_impedance
from tdhil.estimation.periodic import measured
from tdhil.estimation.result import Options
from tdhil.estimation.samples import usable_samples
from tdhil.recording import Excitation, ImpedanceInput, LagPrior, Level, Segment
from tests.estimation.reporting import recorded
from tests.rigs import FieldRig

HARMONICS = np.array([1, 2, 3, 5, 7, 10, 14, 20, 30])
PHASES = np.array([0.4081, 5.3094, 1.6031, 0.07, 3.2103, 0.7969, 5.0826, 4.208, 5.651])
PERIOD_S, MEAN, LEVELS, LEVEL_S = 20.0, 5.0, (2.9, 7.15), 10.0
ZETA = 20.56                       # 5 inch pipe at this motor: 296.5 N·m·s/rad times 104/1500
SETTINGS = {                       # P and I at the motor: those of the reference case times 104/1500
    "soft, a = 1": (20.6, 69.3), "soft, a = 0.25": (82.2, 69.3), "the paper's": (300.0, 300.0),
    "stiff": (1406.0, 1834.0),
}


@dataclass(frozen=True)
class Machine(FieldRig):
    """Rig with its speed loop; white noise is per step of 2 ms."""

    gain: float = 300.0
    integral: float = 300.0
    speed_filter: float = 0.020
    reference_filter: float = 0.0
    speed_report: float = 0.40
    torque_report: float = 0.15
    speed_quantum: float = 0.1 * np.pi / 30.0
    period: float = 0.004
    late: float = 0.0              # of the command
    torque_scale: float = 1.0      # reported torque over commanded torque
    control: float = 0.0           # sampling period of the loop; 0: continuous

    def lag(self, time, s):
        """Return a first-order lag; with sampling y += (1 - exp(-h/time)) (x - y)."""
        if self.control == 0.0:
            return 1.0 / (1.0 + time * s)
        keep = np.exp(-self.control / time)
        return (1.0 - keep) / (1.0 - keep * np.exp(-s * self.control))

    def torque_loop(self, s):
        """Return torque per unit of demand; with sampling it is held from one step to the next."""
        step = s * self.control
        hold = 1.0 if self.control == 0.0 else (1.0 - np.exp(-step)) / step
        return self.lag(self.torque_lag, s) * hold

    @property
    def inner_lag(self):
        """Return the lag of torque behind speed in the loop at low frequencies. A sampled lag is shorter."""
        if self.control == 0.0:
            return self.torque_lag + self.speed_filter
        kept = [np.exp(-self.control / time) for time in (self.torque_lag, self.speed_filter)]
        return self.control * (0.5 + sum(keep / (1.0 - keep) for keep in kept))

    def law(self, s):
        """Return the control law; with sampling it integrates the errors before the present one."""
        summed = 1.0 / s if self.control == 0.0 else self.control / (np.exp(s * self.control) - 1.0)
        return (self.gain + self.integral * summed) * self.torque_loop(s)

    def impedance(self, hertz):
        s = 2j * np.pi * np.asarray(hertz)
        return self.inertia * s + self.viscous + self.law(s) * self.lag(self.speed_filter, s)

    def reflection(self, hertz, zeta=ZETA):
        z = self.impedance(hertz)
        return np.abs((z - zeta) / (z + zeta))

    def driven(self, by, s):
        """Return speed per unit of the command."""
        drive = self.torque_loop(s) if by == "offset" else self.law(s) / (1.0 + self.reference_filter * s)
        return drive * np.exp(-self.late * s) / self.impedance(s.imag / (2.0 * np.pi))

    def reported(self, speed, s):
        torque = self.torque_scale * (self.inertia * s + self.viscous) * speed
        return speed / (1.0 + self.speed_report * s), torque / (1.0 + self.torque_report * s)


@cache
def command(machine, by, peak=None, draw=1):
    """Return sizes and phases of the lines within the field rig's window (±4 rad/s) and torque (210 N·m).

    With the offset it uses the best of some random phases, as a run does. ``draw`` selects other phases.
    """
    hertz = HARMONICS / PERIOD_S
    s = 2j * np.pi * hertz
    if by == "offset":
        z = np.abs(machine.impedance(hertz))
        sizes = 2.0 * ZETA * z / (z**2 + ZETA**2)
    else:
        sizes = 1.0 / np.hypot(1.0, s.imag)
    speed = machine.driven(by, s)
    grid = np.exp(1j * np.outer(np.arange(0.0, PERIOD_S, 0.02), s.imag))

    def most(phases):
        def highest(lines):
            return np.max(np.abs((grid @ (sizes * lines * np.exp(1j * phases))).real))

        if peak is not None:
            return peak / highest(np.ones(len(s)))
        within = min(4.0 / highest(speed), 210.0 / highest((machine.inertia * s + machine.viscous) * speed))
        return min(within, 160.0 / highest(np.ones(len(s)))) if by == "offset" else within

    rng = np.random.default_rng(draw)
    drawn = [PHASES, *(rng.uniform(0.0, 2.0 * np.pi, (300 * (by == "offset" and peak is None), len(s))))]
    best = max(drawn, key=most)
    return sizes * most(best), best


def record(machine, by="offset", seed=0, *, peak=None, counted=24, prior=None, scale_sd=0.0, declared=0.0, draw=1):
    """Return a Recording with two operating points and then the counted periods."""
    rng = np.random.default_rng(seed)
    h = machine.period
    sizes, phases = command(machine, by, peak, draw)
    omega = 2.0 * np.pi * HARMONICS / PERIOD_S
    in_period, in_level = round(PERIOD_S / h), round(LEVEL_S / h)
    lines = np.cos(np.outer(np.arange(in_period) * h, omega) + phases) @ sizes
    count = machine.torque_quantum if by == "offset" else machine.speed_quantum
    sent = np.round((lines if by == "offset" else MEAN + lines) / count) * count
    # the command's spectrum, held from sample to sample, through the loop
    spectrum = np.fft.rfft(sent - sent.mean())
    s = 2j * np.pi * np.fft.rfftfreq(in_period, h)
    s[0] = 1e-9j
    held = (1.0 - np.exp(-s * h)) / (s * h)
    wave = [np.fft.irfft(part, in_period) for part in machine.reported(machine.driven(by, s) * held * spectrum, s)]
    total = 2 * in_level + counted * in_period
    noise = _noise(machine, total, rng)
    dither = 3.0 * machine.speed_quantum * np.sin(2.0 * np.pi * 0.3031 * np.arange(total) * h)
    start = 100.0
    time = np.concatenate([np.arange(in_level) * h, 40.0 + np.arange(in_level) * h,
                           start + np.arange(counted * in_period) * h])
    at = np.repeat([*LEVELS, MEAN], [in_level, in_level, counted * in_period])
    moving = [np.concatenate([np.zeros(2 * in_level), np.tile(part, counted)]) for part in wave]
    speed = at + dither + moving[0] + noise[0] + machine.speed_noise * rng.standard_normal(total)
    torque = machine.torque_scale * (machine.coulomb + machine.viscous * at) + moving[1] + noise[1]
    torque += machine.torque_noise * rng.standard_normal(total)
    segment = Segment(
        start, start + counted * PERIOD_S, PERIOD_S, 0, MEAN, tuple(HARMONICS / PERIOD_S),
        tuple(sizes) if by == "reference" else (0.0,) * len(sizes), tuple(phases),
        tuple(sizes) if by == "offset" else (),
    )
    return recorded(
        time, np.round(speed / machine.speed_quantum) * machine.speed_quantum,
        np.round(torque / machine.torque_quantum) * machine.torque_quantum,
        excitation=Excitation("multisine", "speed", (segment,)),
        levels=(Level(0.0, LEVEL_S - h), Level(40.0, 40.0 + LEVEL_S - h)), lag_prior=prior or LagPrior(),
        speed_resolution_rad_s=machine.speed_quantum, torque_resolution_nm=machine.torque_quantum,
        torque_scale_rel_sd=scale_sd, impedance=ImpedanceInput(by, count, declared, ZETA),
    )


def _noise(machine, total, rng):
    """Return the reported speed and torque of the disturbances, (2, total)."""
    h = machine.period
    s = 2j * np.pi * np.fft.rfftfreq(total, h)
    s[0] = s[1]
    white = np.sqrt(0.002 / h)
    keep = np.exp(-h / machine.load_time)
    load, ripple, sensor = (np.fft.rfft(rng.standard_normal(total)) for _ in range(3))
    load = load * machine.load_sd * np.sqrt(1.0 - keep**2) / (1.0 - keep * np.exp(-s * h))
    ripple, sensor = white * machine.ripple_sd * ripple, white * machine.sensor_sd * sensor
    z = machine.impedance(s.imag / (2.0 * np.pi))
    loop = machine.law(s) * machine.lag(machine.speed_filter, s)
    speed = (load + ripple - loop * sensor) / z
    torque = ripple - loop * (speed + sensor)
    torque = machine.torque_scale * torque / (1.0 + machine.torque_report * s)
    seen = (speed + sensor) / (1.0 + machine.speed_report * s), torque
    return [np.fft.irfft(part, total) for part in seen]


def found(recording):
    """Return the result for the impedance, without that for the inertia."""
    case = Case(recording, Options(), samples=usable_samples(recording))
    periodic = measured(case, recording.excitation)
    assert isinstance(periodic, PeriodicCase)
    return measure_impedance(periodic)
