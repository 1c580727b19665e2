"""The rigs of a site as a service: runs as processes of their own, their memory on files, and a web before them.

The web opens no drive's bus. A run is a process of its own, today's Runner with its guard and its stop; it writes
run.mcap, and the web reads that as it grows.
"""

from typing import TYPE_CHECKING

from profiles import lazy_face

if TYPE_CHECKING:
    from tdhil.service.accounts import ROLES as ROLES, AccountsFile as AccountsFile
    from tdhil.service.audit import Audit as Audit, ChainHead as ChainHead
    from tdhil.service.client import Client as Client, ServiceError as ServiceError
    from tdhil.service.console import attend as attend
    from tdhil.service.run_state import Conflict as Conflict, NotAllowed as NotAllowed, NotThere as NotThere
    from tdhil.service.server import (
        HOST as HOST, PORT as PORT, Tls as Tls, check_idle as check_idle, require_folder as require_folder,
        serve as serve,
    )
else:
    __getattr__, __dir__ = lazy_face(__name__)
