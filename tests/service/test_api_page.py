"""Page /docs: every route and object of the OpenAPI document, without other hosts."""

from __future__ import annotations

import re

from tdhil.service.api_page import api_page
from tdhil.service.schemas import document


def test_every_route_field_and_object_of_the_document_is_on_the_page():
    found, page = document(), api_page()
    wanted = [(path, one["operationId"]) for path, methods in found["paths"].items() for one in methods.values()]
    assert [(one.path, one.id) for one in page.routes] == wanted
    assert [one.name for one in page.schemas] == list(found["components"]["schemas"])
    start = next(one for one in page.routes if one.id == "start")
    assert (start.method, start.role) == ("POST", "operator")
    assert {"tolerance", "max_time_s", "excitation"} <= {one.name for one in start.body}
    assert [one.schema for one in start.answers] == ["RunView", "ErrorView"]
    assert all(one.schema in {other.name for other in page.schemas} for each in page.schemas for one in each.fields
               if one.schema)


def test_it_is_served_and_needs_no_other_host(client):
    text = client.get("/docs").text
    page = api_page()
    assert all(f'id="{one.id}"' in text for one in page.routes)
    assert all(f'id="schema-{one.name}"' in text for one in page.schemas)
    assert not re.findall(r'(?:src|href)="(?:https?:)?//', text)
    assert not [target for target in re.findall(r'href="#([\w-]+)"', text) if f'id="{target}"' not in text]
