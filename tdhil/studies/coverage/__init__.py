"""How often the interval covers: seeded plants, identified by the hundred."""

from typing import TYPE_CHECKING

from profiles import lazy_face

if TYPE_CHECKING:
    from tdhil.studies.coverage.study import COVERAGE as COVERAGE
else:
    __getattr__, __dir__ = lazy_face(__name__)
