"""Coverage of the interval, measured on hundreds of seeded simulated plants."""

from tdhil.studies.coverage.study import COVERAGE as COVERAGE
