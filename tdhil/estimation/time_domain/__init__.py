"""Route of the time domain: identification of any recording, periodic or not."""

from tdhil.estimation.time_domain.fit import (
    CLEAR as CLEAR, LEAST_BINS as LEAST_BINS, NARROW as NARROW, smoothed as smoothed,
)
from tdhil.estimation.time_domain.identify import identify_record as identify_record, recorded as recorded
from tdhil.estimation.time_domain.solve import LEAST_DOF as LEAST_DOF
from tdhil.estimation.time_domain.taylor import ComplexArray as ComplexArray, polynomial as polynomial
from tdhil.estimation.time_domain.windows import (
    Bins as Bins, OneWayStretch as OneWayStretch, joined as joined, measure as measure, place_windows as place_windows,
    thinned as thinned,
)
