"""Take the cockpit's pictures: `python -m tests.gateway.view.pictures docs`. Takes a minute."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from PIL import Image

from gateway import Goal
from tests.gateway.view.chromium import Tab, chromium, wait
from tests.gateway.view.test_cockpit_page import FRAMES, beside, opened, phone, running


def main(folder: Path) -> None:
    """Drive a robot, break it, and show two recordings."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as own, chromium(Path(own) / "p") as browser:
        with running("diffbot", "steer") as robot:
            tab = opened(browser, robot.url)
            tab.type("#line", "goal 5.6 1 -90")
            tab.run("document.activeElement.blur()")
            wait(lambda: robot.look()["pose"][0] > 3.6, "being on the way")
            picture(tab, folder / "cockpit.png")
            phone(tab)
            wait(lambda: robot.look()["pose"][0] > 4.2, "being further on the way")
            picture(tab, folder / "cockpit-phone.png")
            size = {"width": 1440, "height": 900, "deviceScaleFactor": 1, "mobile": False}
            tab.call("Emulation.setDeviceMetricsOverride", **size)
            tab.call("Emulation.setTouchEmulationEnabled", enabled=False)
            dark(tab)
            robot.do("provoke left")
            tab.until("document.querySelector('#faults article')")
            picture(tab, folder / "cockpit-dark.png")
        with running("arm", "steer") as robot:
            tab = opened(browser, robot.url)
            tab.type("#line", "position shoulder -0.3")
            tab.run("document.activeElement.blur()")
            tab.until("/shoulder -0.[34]/.test(document.querySelector('#figure-names').textContent)")
            picture(tab, folder / "cockpit-arm.png")
        with beside(Path(own), (Goal(5.6, 1.0), 14.0), (Goal(5.6, 0.4), 14.0)) as url:
            tab = browser.open(url, 1440, 900)
            tab.until(f"{FRAMES}.length === 2")
            for page in ("0", "1"):
                tab.until(f"{FRAMES}[{page}].querySelector('#prepared')?.textContent.startsWith('100 %')")
            tab.run(f"{FRAMES}[0].querySelector('#play').click()")
            tab.until(f"{FRAMES}[0].querySelector('#seek').value > 9")
            tab.run(f"{FRAMES}[0].querySelector('#play').click()")
            tab.until(f"{FRAMES}[0].querySelector('#play').textContent === 'Play'")
            picture(tab, folder / "cockpit-replay.png")


def dark(tab: Tab) -> None:
    """Show it as on a dark desktop."""
    tab.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "dark"}])


def picture(tab: Tab, file: Path) -> None:
    """Write what is seen, with as many colours as it needs."""
    tab.run("new Promise(done => setTimeout(done, 1000))")  # until it is drawn
    tab.picture(file)
    Image.open(file).convert("RGB").quantize(256, Image.Quantize.FASTOCTREE).save(file, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
