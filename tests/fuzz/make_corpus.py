"""Write the valid files of the corpus again: python tests/fuzz/make_corpus.py. Files found by fuzzing are kept."""

import random
import struct
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT)]

STUDIES = {
    "slopes": "study: figure9\nsettings:\n  seed: 3\n",
    "coverage": "study: coverage\nsettings:\n  seeds: 20\n  plants: [field, servo]\n  confidence: 0.9\n",
}
EXCITATION = """\
kind: multisine
mode: torque
segments:
  - {start_s: 1.0, periods: 3, period_s: 10.0, settle_periods: 1, offset_rad_s: 3.0, lines_hz: [0.1, 0.3]}
  - start_s: 40.0
    end_s: 80.0
    period_s: 10.0
    offset_rad_s: 5.0
    lines_hz: [0.1, 0.5]
    amplitudes_rad_s: [0.5, 0.2]
    phases_rad: [0.0, 1.5]
levels:
  - {start_s: 85.0, end_s: 95.0}
"""


def traces() -> dict[str, bytes]:
    rng = random.Random(1)
    rows = [(0.01 * k, 3.0 + 0.5 * rng.random(), 100.0 + rng.random()) for k in range(40)]
    usual = "time_s,speed_rad_s,torque_nm\n" + "".join(f"{t:.3f},{w:.4f},{m:.3f}\n" for t, w, m in rows)
    foreign = "\ufeffDrive tool export;;\r\n;;\r\nt;n_rpm;m_pct\r\n[ms];[1/min];[%]\r\n" + "".join(
        f"{1000 * t:.0f};{9.5 * w:.2f};{m / 4.8:.2f}\r\n".replace(".", ",") for t, w, m in rows)
    return {"usual": usual.encode(), "foreign": foreign.encode()}


def can_scripts() -> dict[str, bytes]:
    """Return records of after, kind, identifier, length, data."""
    record = struct.Struct("<BBBB8s").pack
    return {
        "nothing": b"",
        "emergency": record(185, 0, 2, 8, bytes.fromhex("0573010000000000")),
        "boot_up": record(190, 0, 8, 1, bytes(8)),
        "stopped": record(180, 0, 8, 1, b"\x05" + bytes(7)) + record(9, 0, 8, 1, b"\x04" + bytes(7)),
        "abort": record(20, 5, 0, 8, b"\x80\0\0\0\0\0\0\0") + record(30, 3, 0, 0, bytes(8)),
        "late": record(40, 4, 0, 0, bytes(8)) * 3,
        "short": record(60, 7, 0, 3, bytes(8)) + record(20, 0, 3, 2, bytes(8)),
        "segment": record(5, 0, 6, 8, bytes.fromhex("4108100020000000")),
    }


def modbus_scripts() -> dict[str, bytes]:
    from drivers.modbus.rtu import FramerRTU
    from tests.fuzz import replies

    found = {}
    known = replies.modbus_requests()
    answers = (b"\x03\x04\0\1\0\2", b"\x04\xfa" + bytes(250), known[2], known[3][:5], b"\x17\x06\0\1\0\2\0\3")
    for number, answer in enumerate((*answers, b"\x83\x02")):
        body = b"\x01" + answer
        rtu = body + FramerRTU.compute_CRC(body).to_bytes(2, "big")
        tcp = struct.pack(">HHHB", 1, 0, len(answer) + 1, 1) + answer
        for kind, said in (("pdu", answer), ("rtu", rtu), ("tcp", tcp)):
            found[f"{kind}_{number}"] = bytes((number % len(known), kind == "pdu")) + said
    return found


def main() -> None:
    from tests.fuzz.parsers import CORPUS
    from tests.recording.log_runs import make_run

    def put(parser: str, name: str, data: bytes) -> None:
        path = CORPUS / parser / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)

    for path in sorted((ROOT / "profiles" / "generic").glob("*.yaml")):
        put("profile", f"valid_{path.name}", path.read_bytes())
    put("eds", "valid_cia402.eds", (ROOT / "profiles" / "generic" / "cia402.eds").read_bytes())
    put("rig", "valid_rig.yaml", (ROOT / "examples" / "rig.yaml").read_bytes())
    for path in sorted((ROOT / "examples").glob("plant*.yaml")):
        put("plant", f"valid_{path.name}", path.read_bytes())
    for name, text in STUDIES.items():
        put("study", f"valid_{name}.yaml", text.encode())
    put("excitation", "valid_excitation.yaml", EXCITATION.encode())
    for name, data in traces().items():
        put("csv", f"valid_{name}.csv", data)
    make_run(CORPUS / "run.mcap", 30)
    run = (CORPUS / "run.mcap").read_bytes()
    (CORPUS / "run.mcap").unlink()
    put("mcap", "valid_run.mcap", run)
    put("mcap", "valid_cut.mcap", run[:len(run) // 2])
    for name, data in can_scripts().items():
        put("can", f"valid_{name}.bin", data)
    for name, data in modbus_scripts().items():
        put("modbus", f"valid_{name}.bin", data)


if __name__ == "__main__":
    main()
