"""How often the interval covers: seeded plants, identified by the hundred."""

from tdhil.studies.coverage.study import COVERAGE as COVERAGE
