"""The rigs of a site as a service: runs as separate processes, files as storage, and a web interface.

The web opens no drive's bus. A run is a process of its own, with the same Runner, guard and stop as on the command
line. It writes run.mcap, and the web reads this file as it grows.
"""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from tdhil.service.accounts import ROLES as ROLES, AccountsFile as AccountsFile
    from tdhil.service.audit import Audit as Audit, ChainHead as ChainHead
    from tdhil.service.client import Client as Client, ServiceError as ServiceError
    from tdhil.service.console import attend as attend
    from tdhil.service.limits import MEBIBYTE as MEBIBYTE, MOST_UPLOAD as MOST_UPLOAD, UPLOAD_LIMIT as UPLOAD_LIMIT
    from tdhil.service.run_state import Conflict as Conflict, NotAllowed as NotAllowed, NotThere as NotThere
    from tdhil.service.server import (
        HOST as HOST, PORT as PORT, Receivers as Receivers, Tls as Tls, check_idle as check_idle,
        require_folder as require_folder, serve as serve,
    )
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "accounts": "ROLES AccountsFile",
        "audit": "Audit ChainHead",
        "client": "Client ServiceError",
        "console": "attend",
        "limits": "MEBIBYTE MOST_UPLOAD UPLOAD_LIMIT",
        "run_state": "Conflict NotAllowed NotThere",
        "server": "HOST PORT Receivers Tls check_idle require_folder serve",
    })
