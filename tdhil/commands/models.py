"""Which shafts may be asked for: `tdhil.identify.options.MODELS`, without what importing that costs."""

MODELS = ("auto", "rigid", "two-mass", "string", "paper")
