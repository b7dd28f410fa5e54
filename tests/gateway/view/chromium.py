"""Chromium without a window, driven by its DevTools protocol: pages as tabs of one process."""

from __future__ import annotations

import base64
import json
import os
import re
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

from tests.gateway.processes import PATIENCE

FRAME = "new Promise(requestAnimationFrame)"
PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
OPTIONS = [f"--{option}" for option in (
    "headless=new", "no-sandbox", "disable-dev-shm-usage", "disable-gpu", "no-first-run", "disable-sync",
    "disable-quic", "disable-background-networking", "disable-component-update", "remote-debugging-port=0",
    "enable-unsafe-swiftshader",
)]  # fmt: skip


def program() -> str:
    """Return Chromium; skip, or fail where it is required, if there is none."""
    found = next(filter(None, map(shutil.which, PROGRAMS)), None)
    if found is None:
        required = "browser" in re.split(r"[,\s]+", os.environ.get("MOTOR_GATEWAY_REQUIRE", ""))
        (pytest.fail if required else pytest.skip)("NOT RUN: the page in a browser: install chromium")
    return found


def wait(for_what: Callable[[], Any], what: str) -> Any:
    """Return what a function returns once that is true."""
    until = time.monotonic() + PATIENCE
    while not (value := for_what()):
        assert time.monotonic() < until, f"{what} did not come about"
        time.sleep(0.02)
    return value


class Tab:
    """One page. `problems` are what its console, its policy and its scripts complained about."""

    def __init__(self, chromium: Chromium, session: str, target: str) -> None:
        self.chromium, self.session, self.target = chromium, session, target
        self.problems: list[str] = []
        self.fingers = 0

    def call(self, method: str, **parameters: Any) -> Any:
        """Call a method of the protocol."""
        return self.chromium.call(method, self.session, **parameters)

    def run(self, script: str) -> Any:
        """Return what an expression is."""
        result = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def until(self, script: str) -> None:
        """Wait until an expression is true, as its own language sees it."""
        wait(lambda: self.run(f"Boolean({script})"), script)

    def text(self, selector: str) -> str:
        """Return the text of an element."""
        return str(self.run(f"document.querySelector({selector!r}).innerText"))

    def drawn(self) -> None:
        """Wait until what has come is drawn: a canvas is in the next frame, and elements have their sizes."""
        self.run(f"(async () => {{ await {FRAME}; await {FRAME}; }})()")

    def middle(self, selector: str) -> tuple[float, float]:
        """Return where the middle of an element is, scrolled into view, once that has rested for a frame."""
        box = f"""(async () => {{
          for (let before;;) {{
            const element = document.querySelector({selector!r});
            element.scrollIntoView({{block: 'nearest'}});
            const b = element.getBoundingClientRect();
            const now = [b.x + b.width / 2, b.y + b.height / 2];
            if (`${{now}}` === before) return now;
            before = `${{now}}`;
            await {FRAME};
          }}
        }})()"""
        x, y = self.run(box)
        return x, y

    def mouse(self, kind: str, at: tuple[float, float]) -> None:
        """Press the left button, move it while it is pressed, or release it."""
        button = {"button": "left", "buttons": int(kind != "mouseReleased"), "clickCount": 1}
        self.call("Input.dispatchMouseEvent", type=kind, x=at[0], y=at[1], **button)

    def select(self, begin: tuple[float, float], end: tuple[float, float]) -> None:
        """Select a part of a plot as a person does: the mouse moves until the selection is drawn, only then
        the button is released. uPlot takes no selection that it has not drawn, and leaves out a move by
        nothing, as which the browser may report the first."""

        def drawn() -> Any:
            self.mouse("mouseMoved", (end[0] - 1, end[1]))
            self.mouse("mouseMoved", end)
            return self.run(
                "[...document.querySelectorAll('.u-select')].some(one => parseFloat(one.style.width) > 0)"
            )

        self.mouse("mousePressed", begin)
        wait(drawn, "a selection")
        self.mouse("mouseReleased", end)

    def touch(self, *fingers: tuple[float, float]) -> None:
        """Have so many fingers on the screen, where they are; none: the last is lifted."""
        points = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(fingers)]
        now = len(points)
        kind = "touchStart" if now > self.fingers else "touchEnd" if now < self.fingers else "touchMove"
        self.fingers = now
        self.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)

    def click(self, selector: str) -> None:
        """Click on the middle of an element, once it has stood for two frames where it is."""
        frames = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"

        def stands() -> tuple[float, float] | None:
            before = self.middle(selector)
            self.run(frames)
            return before if self.middle(selector) == before else None

        at = wait(stands, f"{selector} that stands")
        self.mouse("mousePressed", at)
        self.mouse("mouseReleased", at)

    def key(self, kind: str, code: str, key: str = "") -> None:
        """Press ("keyDown") or release ("keyUp") a key."""
        text = {"text": key} if kind == "keyDown" and len(key) == 1 else {}
        self.call("Input.dispatchKeyEvent", type=kind, code=code, key=key or code, **text)

    def type(self, selector: str, text: str, *, enter: bool = True) -> None:
        """Type into an element, in place of what is in it."""
        self.run(f"document.querySelector({selector!r}).focus(), document.activeElement.select()")
        self.call("Input.insertText", text=text)
        if enter:
            self.call("Input.dispatchKeyEvent", type="keyDown", code="Enter", key="Enter", text="\r")
            self.key("keyUp", "Enter", "Enter")

    def picture(self, file: Path) -> None:
        """Write what is seen as a PNG."""
        self.call("Page.bringToFront")
        file.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))

    def close(self) -> None:
        """Close the page at once."""
        self.chromium.call("Target.closeTarget", targetId=self.target)
        del self.chromium.tabs[self.session]


class Chromium:
    """The browser."""

    def __init__(self, connection: ClientConnection) -> None:
        self.connection, self.number = connection, 0
        self.tabs: dict[str, Tab] = {}

    def call(self, method: str, session: str = "", **parameters: Any) -> Any:
        """Call a method of the protocol, and note what comes in between."""
        self._send(method, session, **parameters)
        until = time.monotonic() + PATIENCE
        while (answer := json.loads(self.connection.recv(timeout=PATIENCE))).get("id") != self.number:
            assert time.monotonic() < until, f"{method} is not answered"
            self._note(answer)
        assert "error" not in answer, answer
        return answer["result"]

    def _send(self, method: str, session: str, **parameters: Any) -> None:
        self.number += 1
        message = {"id": self.number, "method": method, "params": parameters}
        self.connection.send(json.dumps(message | ({"sessionId": session} if session else {})))

    def _note(self, event: Any) -> None:
        tab, method, given = (
            self.tabs.get(event.get("sessionId", "")),
            event.get("method"),
            event.get("params"),
        )
        if tab is None:
            return
        if method == "Log.entryAdded" and given["entry"]["level"] in ("error", "warning"):
            if "GL Driver Message" in given["entry"]["text"]:
                return  # of how fast a browser without a graphics card draws
            tab.problems.append(given["entry"]["text"])
        elif method == "Runtime.exceptionThrown":
            tab.problems.append(json.dumps(given["exceptionDetails"]))
        elif method == "Runtime.consoleAPICalled" and given["type"] in ("error", "warning", "assert"):
            tab.problems.append(json.dumps(given["args"]))

    def open(self, url: str, width: int = 1440, height: int = 900, *, before: str = "") -> Tab:
        """Open a page; `before` is a script that runs before its own."""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        tab = self.tabs[session] = Tab(self, session, target)
        for domain in ("Log", "Runtime", "Page"):
            tab.call(f"{domain}.enable")
        self.call("Target.activateTarget", targetId=target)
        tab.call("Emulation.setFocusEmulationEnabled", enabled=True)
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        tab.call("Emulation.setDeviceMetricsOverride", **size)
        if before:
            tab.call("Page.addScriptToEvaluateOnNewDocument", source=before)
        self._send("Page.navigate", session, url=url)  # its answer waits for the server: nobody waits for it
        return tab


@contextmanager
def chromium(profile: Path) -> Iterator[Chromium]:
    """Run Chromium with a profile that does not exist yet."""
    with subprocess.Popen(
        [program(), *OPTIONS, f"--user-data-dir={profile}"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as process:
        try:
            port = profile / "DevToolsActivePort"
            number, path = wait(
                lambda: port.exists() and port.read_text().split("\n")[1:] and port.read_text(), "a port"
            ).split("\n")
            # Its own limits of time would end all tests: it reads nothing while a test does something else.
            limits: Any = {"open_timeout": PATIENCE, "ping_interval": None, "proxy": None, "max_size": None}
            with connect(f"ws://127.0.0.1:{number}{path}", **limits) as connection:
                yield Chromium(connection)
        finally:
            process.terminate()
