"""Which shafts may be asked for, and which motions of stage 5.

They are `tdhil.estimation.options.MODELS` and the kinds of `tdhil.run.settings`, without what importing those costs.
"""

MODELS = ("auto", "rigid", "two-mass", "string", "paper")
EXCITATIONS = ("multisine", "sine", "step", "pulses", "coast-down")
