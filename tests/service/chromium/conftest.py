"""Fixtures of the pages in Chromium, with a service whose runs are simulated by `fake_run`.

Skipped where there is no Chromium (`TDHIL_CHROMIUM` names one, else the PATH) or no playwright (extra `browser`).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.service.chromium.pages import CHROMIUM, HOSTILE, Served
from tests.service.conftest import Service


@pytest.fixture
def served(service: Service, rigs: Path) -> Iterator[Served]:
    (rigs / "hostile.yaml").write_text(f"name: '{HOSTILE}'\nrun: {{simulate: true}}\n")
    found = Served(service)
    yield found
    found.end()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as engine:
        found = engine.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-dev-shm-usage"])
        yield found
        found.close()


@pytest.fixture
def page(browser: Any, served: Served) -> Iterator[Any]:
    """Page that loads no external resources, and whose script raises no errors."""
    context = browser.new_context(base_url=served.url)
    context.set_default_timeout(60_000)
    found = context.new_page()
    trouble: list[str] = []
    found.on("pageerror", lambda error: trouble.append(str(error)))
    found.on("console", lambda said: trouble.append(said.text) if "Content Security" in said.text else None)
    found.on("request", lambda asked: trouble.append(asked.url) if not asked.url.startswith(served.url) else None)
    yield found
    context.close()
    assert trouble == []
