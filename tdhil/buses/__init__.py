"""The buses of a drive, above their drivers: one file for each bus, behind one interface (`Bus`).

`tdhil.config.registry.BUSES` is the table of the buses.
"""

from tdhil.buses.bus import (
    Bus as Bus, Connection as Connection, FoundDrive as FoundDrive, Line as Line, Opening as Opening,
    PeerPlan as PeerPlan, ProfileTable as ProfileTable, ValueSeen as ValueSeen, all_buses as all_buses,
    bus_named as bus_named, examples as examples, keys_by_flag as keys_by_flag,
)
from tdhil.buses.doctor_finding import (
    DoctorFinding as DoctorFinding, bad as bad, note as note, of_error as of_error, ok as ok,
)
from tdhil.buses.profile_text import (
    MARKS as MARKS, counts as counts, facts_of as facts_of, modes_text as modes_text,
    row as row, sure_text as sure_text,
    watchdog_text as watchdog_text,
)
