"""Closed-form recordings of one rig with several bodies, as records with their own logs."""

from pathlib import Path

from tdhil.recording import Recording
from tdhil.session import CalibrationRun, RunRecord
from tests.estimation.analytic import closed_form

SCALE = 1.05
"""Reported over true torque."""
INERTIA = 104.0
IDENTITY = {"vendor": 1, "product": 402, "revision": 1, "serial": 17, "name": "drive", "simulated": True}


def recording(body: float, seed: int, scale: float = SCALE, **more: object) -> Recording:
    from dataclasses import replace

    settings = {"noise": 3.0, "viscous": 8.0, "unrecorded_s": 5.0, **more}
    found = closed_form(INERTIA + body, seed=seed, **settings)
    return replace(found, torque_nm=scale * found.torque_nm, torque_scale_rel_sd=0.02, simulated=True)


def run(folder: Path, name: str, body: float, found: Recording, sd: float | None = 0.0, **configuration: object,
        ) -> CalibrationRun:
    path = folder / name
    path.write_text(name)
    plain = {"identity": IDENTITY, "started": "2026-11-23T10:00:00+00:00"}
    return CalibrationRun(RunRecord(found, {**plain, **configuration}, str(path)), body, sd)


def two(folder: Path, body: float = 55.0, said: float | None = None, with_body: Recording | None = None,
        ) -> list[CalibrationRun]:
    """Return records without and with a body; ``said``: its stated inertia."""
    loaded = recording(body, 2) if with_body is None else with_body
    return [run(folder, "without.mcap", 0.0, recording(0.0, 1)),
            run(folder, "with.mcap", body if said is None else said, loaded)]
