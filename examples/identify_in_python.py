"""A simulated drive run and identified from Python; with a rig.yaml it is the same on a real one.

Run it with ``python examples/identify_in_python.py``: half a minute, no hardware. It writes run.mcap where it is run.
"""

import tdhil

# On a real drive: tdhil.open_drive("rig.yaml"). What will move is then shown, and typed at the terminal.
with tdhil.simulate(seed=7) as drive:
    recording = tdhil.run(drive, tdhil.Multisine(frequency_hz=0.2, periods=6), log="run.mcap")

result = tdhil.identify(recording)
print(result)                                           # the card; in a notebook, `result` alone shows it

inertia = result.inertia
if inertia is None:
    print(f"no number: {result.reason}")
else:
    print(f"J = {inertia.value:.1f} kg·m², {inertia.low_total:.1f} to {inertia.high_total:.1f}")

again = tdhil.identify(tdhil.read("run.mcap"), confidence=0.99)     # what ``tdhil replay`` does
print(f"at 99 %: {again.to_dict()['inertia_kg_m2']['low_total']:.1f} kg·m² at least")
