"""Multisine: four lines in one period, phased for a low crest of speed and of torque.

Why these lines (notes of the design; figures for the field-like rig, J 104 kg·m², lags 0.40 s and 0.15 s):

- G(jω) = (J s + B)(1 + τ_w s)/(1 + τ_T s) e^(−d s) is J s (1 + s(τ_w − τ_T − d) + O(s²)) at low frequency: its phase
  tells the lags' difference, its magnitude J and, at order ω², what the lags add to it. J is the limit of |G|/ω
  towards zero, so the strongest lines belong low; the weaker, higher ones tell the slope that has to be taken out.
- Lines above 0.4 to 0.5 Hz make the filters' *structure* matter: were the speed filtered by a moving average and not
  by a first-order lag, lines up to 0.5 Hz would bias J by 1.2 %, lines up to 0.4 Hz by 0.8 %, and three lines up to
  0.3 Hz by 0.4 % at a third more scatter.
- A period of 10 s with lines from 0.1 Hz gives twice the periods of 20 s with lines from 0.05 Hz, hence weights that
  are better known (degrees of freedom) and half the time lost to settling, at the same Cramér-Rao bound.

The phases minimise (crest of speed + crest of torque), found by a search over 60 starts with growing p-norms; the crest
of torque is 1.31 (a single sine: 1.41), speed spans 3.13 times its rms from peak to peak (a sine: 2.83).
"""

from tdhil.run.excitation.signals import Shape, unit_peak

DEFAULT_FREQUENCY_HZ = 0.1   # of the lowest line
DEFAULT_PERIODS = 11         # at each mean speed, the first of them for settling


def multisine_shape() -> Shape:
    """Harmonics 1 to 4, peak deviation 1."""
    return unit_peak(
        Shape(
            harmonics=(1, 2, 3, 4),
            amplitudes=(1.58, 0.85, 0.24, 0.24),
            phases_rad=(5.38116627, 1.33755537, 0.43554371, 5.81670456),
        )
    )
