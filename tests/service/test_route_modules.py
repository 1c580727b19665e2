"""Agreement of route table and handler modules: each declared route is served once, under its own name."""

from __future__ import annotations

from collections import Counter

from starlette.routing import Route

from tdhil.service.limits import API
from tdhil.service.schemas import ROUTES, SOCKETS


def test_every_declared_route_is_served_once_and_no_other_is(service):
    sockets = {f"{API}{one.path}" for one in SOCKETS}
    served = Counter(
        (one.path, method, one.name)
        for one in service.web.app.routes if isinstance(one, Route) and one.path not in sockets
        for method in (one.methods or set()) - {"HEAD"} if one.path.startswith(API)
    )
    assert served == Counter((f"{API}{one.path}", one.method, one.name) for one in ROUTES)
