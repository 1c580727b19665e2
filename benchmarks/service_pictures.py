"""Draws docs/images/service.png and docs/images/service-result.png: the pages of a run as it goes, and of its result.

::

    python benchmarks/service_pictures.py [FOLDER] [--width 900]
    python benchmarks/service_pictures.py FOLDER --every

The run is a simulated one of `tdhil serve`, in stepped time. Chromium is $TDHIL_CHROMIUM, else the one on the PATH; it
is driven by playwright (extra `browser`). ``--width 390`` is a phone's, for whoever wants to look at that. ``--every``
draws each page of the service at 1280 and 390 px, in light and dark, to be looked at before and after a change.
"""

from __future__ import annotations

import argparse
import io
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from PIL import Image
from playwright.sync_api import sync_playwright

from tests.service.test_serve import served

DOCS = Path(__file__).parents[1] / "docs" / "images"
RIG, SEED = "simulated-canopen", 7
LIVE_PX, RESULT_PX = 760, 1180
ALL_PICTURES = """Promise.all([...document.images].filter((one) => one.src).map((one) => {
  one.loading = 'eager';
  return one.decode();
}))"""
MOVING = "() => document.getElementById('state').textContent.includes('acquire')"


def save(page: Any, path: Path, *, whole: bool = False) -> None:
    """With as few colours as such a page has: a third of the size. ``whole``: also what is below the window."""
    picture = Image.open(io.BytesIO(page.screenshot(full_page=whole))).convert("RGB")
    picture.quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)


PAGES = {
    "rigs": "/", "new-rig": "/new-rig", "start": f"/start/{RIG}", "calibrate": f"/calibrate/{RIG}",
    "rehearse": f"/rehearse/{RIG}", "history": f"/rigs/{RIG}", "file": f"/rigs/{RIG}/file", "runs": "/runs",
    "result": "/runs/{run}", "recorded": "/runs/{run}/live", "upload": "/upload", "fleets": "/fleets",
    "audit": "/audit", "accounts": "/accounts", "docs": "/docs", "letterhead": "/letterhead",
}
"""Pages that ``--every`` draws, by the name of their picture. ``{run}``: the run that has ended."""
WIDTHS, COLOURS = (1280, 390), ("light", "dark")


def every_page(chromium: Any, server: Any, folder: Path) -> None:
    """Draw each page after a run, whole, at each width and in each colour, and the live page before."""
    folder.mkdir(parents=True, exist_ok=True)
    run = server.client.start(RIG, seed=SEED)["id"]
    contexts = {f"{width}-{scheme}": chromium.new_context(
        base_url=server.url, color_scheme=scheme, viewport={"width": width, "height": LIVE_PX}).new_page()
        for width in WIDTHS for scheme in COLOURS}
    for name, page in contexts.items():
        page.set_default_timeout(600_000)
        page.goto(f"/runs/{run}/live")
        page.locator("#state").wait_for()
        save(page, folder / f"live-{name}.png")
    server.client.wait(run, timeout_s=600.0)
    for name, page in contexts.items():
        page.wait_for_url(f"**/runs/{run}")            # the live page of a run that has ended becomes its result
        for title, path in PAGES.items():
            page.goto(path.format(run=run))
            page.wait_for_timeout(1500)                # pages ask again and again: the network is never idle
            page.evaluate(ALL_PICTURES)
            save(page, folder / f"{title}-{name}.png", whole=True)


def main() -> None:
    """One run, looked at twice."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=DOCS)
    parser.add_argument("--width", type=int, default=900, metavar="PX")
    parser.add_argument("--seconds", type=float, default=2.0,
                        help="of acquiring, by this computer's clock (default 2; more where it is busy)")
    parser.add_argument("--every", action="store_true", help="draw each page at both widths and in both colours")
    asked = parser.parse_args()
    if asked.every and asked.folder == DOCS:
        parser.error("--every needs a FOLDER of its own")
    browser = os.environ.get("TDHIL_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
    with tempfile.TemporaryDirectory() as data, served(Path(data) / "data") as server, sync_playwright() as engine:
        chromium = engine.chromium.launch(executable_path=browser, args=["--no-sandbox", "--disable-dev-shm-usage"])
        if asked.every:
            every_page(chromium, server, asked.folder)
            chromium.close()
            return
        page = chromium.new_page(base_url=server.url, viewport={"width": asked.width, "height": LIVE_PX})
        page.set_default_timeout(600_000)
        run = server.client.start(RIG, seed=SEED)["id"]
        page.goto(f"/runs/{run}/live")
        page.wait_for_function(MOVING)
        page.wait_for_timeout(1e3 * asked.seconds)
        save(page, asked.folder / "service.png")
        server.client.wait(run, timeout_s=600.0)
        page.set_viewport_size({"width": asked.width, "height": RESULT_PX})
        page.goto(f"/runs/{run}")
        page.get_by_text("Speed and torque").first.wait_for()
        page.wait_for_load_state("networkidle")
        save(page, asked.folder / "service-result.png")
        chromium.close()


if __name__ == "__main__":
    main()
