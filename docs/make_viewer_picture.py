"""Make the README's picture of the viewer anew.

    make demo
    python docs/make_viewer_picture.py demo docs/viewer.png

Needs `pip install 'gscompleter[browser]'` and Debian's chromium, which draws in software.
"""

import shutil
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from playwright.sync_api import sync_playwright

from gscompleter.apps.commands.view import ViewOptions, run_view

SWITCHES = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
LINK = "#camera=target-2&mode=side&generated=show"


def main() -> None:
    demo, picture = Path(sys.argv[1]), Path(sys.argv[2])
    with TemporaryDirectory() as folder, sync_playwright() as playwright:
        page = Path(folder) / "page.html"
        shown, cameras = demo / "completion", demo / "scene"
        run_view(ViewOptions(scene=shown, cameras=cameras, save=page, quiet=True))
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=SWITCHES
        )
        tab = browser.new_page(viewport={"width": 1280, "height": 620})
        tab.set_default_timeout(300_000)
        tab.goto(page.as_uri() + LINK)
        tab.evaluate("gsc.ready")
        tab.screenshot(path=picture)


if __name__ == "__main__":
    main()
