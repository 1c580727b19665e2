"""The paper's field experiments, run on the whole path: slopes, loops, gains and amplitudes."""
