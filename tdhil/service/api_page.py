"""The page /docs: the OpenAPI document of the service as a readable page. It loads nothing from another host."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

Part = Mapping[str, Any]


@dataclass(frozen=True)
class ApiField:
    """A parameter, or a field of a body or a reply. ``schema``: name of a schema on the same page, '' for none."""

    name: str
    kind: str
    text: str
    required: bool = False
    schema: str = ""


@dataclass(frozen=True)
class ApiAnswer:
    """Reply with its HTTP statuses."""

    statuses: str
    text: str
    schema: str


@dataclass(frozen=True)
class ApiRoute:
    """One route. ``body``: fields of the request's object; ``body_text``: meaning of the object."""

    id: str
    method: str
    path: str
    summary: str
    role: str
    parameters: tuple[ApiField, ...]
    body: tuple[ApiField, ...]
    body_text: str
    answers: tuple[ApiAnswer, ...]


@dataclass(frozen=True)
class ApiSchema:
    """A named object of bodies and replies."""

    name: str
    text: str
    fields: tuple[ApiField, ...]


@dataclass(frozen=True)
class ApiPage:
    """Content of the page /docs."""

    version: str
    routes: tuple[ApiRoute, ...]
    schemas: tuple[ApiSchema, ...]


@lru_cache(maxsize=1)
def api_page() -> ApiPage:
    """Return the page for this version of the service."""
    from tdhil.service.schemas import document

    found = document()
    schemas = found["components"]["schemas"]
    routes = tuple(
        _route(path, method, one, schemas)
        for path, methods in found["paths"].items() for method, one in methods.items()
    )
    return ApiPage(found["info"]["version"], routes, tuple(
        ApiSchema(name, one.get("description", ""), tuple(_fields(one))) for name, one in schemas.items()))


def _route(path: str, method: str, one: Part, schemas: Part) -> ApiRoute:
    parameters = tuple(
        ApiField(each["name"], f"{each['in']}, {_kind(each['schema'])[0]}", each.get("description", ""),
                 bool(each.get("required"))) for each in one.get("parameters", ()))
    content = one.get("requestBody", {}).get("content", {})
    body = content.get("application/json", {}).get("schema", {})
    if content and not body:
        body = {"description": f"the bytes of the file ({next(iter(content))})"}
    named = body.get("$ref", "").rpartition("/")[2]
    body = schemas[named] if named else body
    what = "WebSocket" if "x-websocket" in one else method.upper()
    return ApiRoute(one["operationId"], what, path, one.get("summary", ""), one.get("x-role", "") or "", parameters,
                    tuple(_fields(body)), body.get("description", ""), tuple(_answers(one.get("responses", {}))))


def _answers(responses: Part) -> Iterator[ApiAnswer]:
    same: dict[tuple[str, str], list[str]] = {}
    for status, answer in responses.items():
        kind, schema = "", ""
        for media, body in answer.get("content", {}).items():
            kind, schema = _kind(body.get("schema", {})) if media == "application/json" else (media, "")
        text = ", ".join(part for part in (answer.get("description", ""), "" if schema else kind) if part)
        same.setdefault((text, schema), []).append(status)
    for (text, schema), statuses in same.items():
        yield ApiAnswer(", ".join(statuses), text, schema)


def _fields(schema: Part) -> Iterator[ApiField]:
    required = schema.get("required", ())
    for name, one in schema.get("properties", {}).items():
        kind, link = _kind(one)
        unit = one.get("x-unit")
        text = one.get("description", "")
        if (default := one.get("default")) is not None:
            text = f"{text}; default {default}" if text else f"default {default}"
        yield ApiField(name, f"{kind}, {unit}" if unit and unit != "1" else kind, text, name in required, link)


def _kind(schema: Part) -> tuple[str, str]:
    """Return the type of a value in words, and the name of its schema."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return name, name
    if "anyOf" in schema:
        found = [_kind(one) for one in schema["anyOf"]]
        return " or ".join(kind for kind, _ in found), next((link for _, link in found if link), "")
    if "enum" in schema or "const" in schema:
        return " | ".join(str(one) for one in schema.get("enum", [schema.get("const")])), ""
    kind = schema.get("type", "any")
    if kind == "array":
        inner, link = _kind(schema.get("items", {}))
        return f"list of {inner}", link
    return " or ".join(kind) if isinstance(kind, list) else str(kind), ""
