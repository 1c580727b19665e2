"""Draws docs/images/service.png and docs/images/service-result.png: the pages of a run as it goes, and of its result.

::

    python benchmarks/service_pictures.py [FOLDER] [--width 900]

The run is a simulated one of `tdhil serve`, in stepped time. Chromium is $TDHIL_CHROMIUM, else the one on the PATH; it
is driven by playwright (extra `browser`). ``--width 390`` is a phone's, for whoever wants to look at that.
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

RIG, SEED = "simulated-canopen", 7
LIVE_PX, RESULT_PX = 760, 1180
MOVING = "() => document.getElementById('state').textContent.includes('acquire')"


def save(page: Any, path: Path) -> None:
    """With as few colours as such a page has: a third of the size."""
    picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    picture.quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)


def main() -> None:
    """One run, looked at twice."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path(__file__).parents[1] / "docs" / "images")
    parser.add_argument("--width", type=int, default=900, metavar="PX")
    parser.add_argument("--seconds", type=float, default=2.0,
                        help="of acquiring, by this computer's clock (default 2; more where it is busy)")
    asked = parser.parse_args()
    browser = os.environ.get("TDHIL_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
    with tempfile.TemporaryDirectory() as data, served(Path(data) / "data") as server, sync_playwright() as engine:
        chromium = engine.chromium.launch(executable_path=browser, args=["--no-sandbox", "--disable-dev-shm-usage"])
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
