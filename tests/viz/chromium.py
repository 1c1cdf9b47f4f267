"""A headless Chromium, driven by the DevTools protocol over a pipe: no other package is needed."""

import base64
import io
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FOUND = next(filter(None, map(shutil.which, NAMES)), None)
OPTIONS = (
    *("--headless", "--no-sandbox", "--hide-scrollbars", "--no-first-run", "--mute-audio"),
    *("--disable-dev-shm-usage", "--disable-background-networking", "--disable-extensions"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader"),  # WebGL without a GPU
    "--remote-debugging-pipe",
)
SECONDS = 60.0
"""Longest wait for an answer: so that a browser that hangs fails a test, and not the whole run."""


class Page:
    """A page of the browser.

    Attributes:
        faults: errors and warnings of the console, and exceptions that nothing caught.
    """

    def __init__(self, read: int, write: int) -> None:
        self.faults: list[str] = []
        self._read, self._write, self._rest, self._last = read, write, b"", 0
        self._session: dict[str, str] = {}
        target = self._ask("Target.createTarget", url="about:blank")["targetId"]
        attached = self._ask("Target.attachToTarget", targetId=target, flatten=True)
        self._session = {"sessionId": attached["sessionId"]}
        for domain in ("Page", "Runtime", "Log"):
            self._ask(f"{domain}.enable")
        size = {"width": 800, "height": 500, "deviceScaleFactor": 1, "mobile": False}
        self._ask("Emulation.setDeviceMetricsOverride", **size)

    def open(self, path: Path, fragment: str = "") -> None:
        self.faults.clear()
        self._ask("Page.navigate", url="about:blank")
        self._ask("Page.navigate", url=f"{path.as_uri()}{fragment}")
        self.run(
            "new Promise((done) => document.readyState === 'complete' ? done() : onload = done)"
        )

    def run(self, script: str) -> Any:
        """The value of an expression; a promise is waited for."""
        found = self._ask(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def picture(self, selector: str = "canvas") -> np.ndarray:
        """An element as it looks after two frames, shape (height, width, 3)."""
        self.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        data = base64.b64decode(self._ask("Page.captureScreenshot", format="png")["data"])
        left, top, width, height = map(round, self.place(selector))
        shot = np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)
        return shot[top : top + height, left : left + width]

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        self._ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def drag(self, x: float, y: float, to_x: float, to_y: float) -> None:
        self.mouse("mousePressed", x, y, button="left", buttons=1, clickCount=1)
        for part in (0.5, 1.0):
            at = x + part * (to_x - x), y + part * (to_y - y)
            self.mouse("mouseMoved", *at, button="left", buttons=1)
        self.mouse("mouseReleased", to_x, to_y, button="left", clickCount=1)

    def place(self, selector: str) -> tuple[float, float, float, float]:
        """Left, top, width and height of an element."""
        found = self.run(f"document.querySelector('{selector}').getBoundingClientRect().toJSON()")
        return found["x"], found["y"], found["width"], found["height"]

    def _ask(self, method: str, **params: Any) -> dict[str, Any]:
        self._last += 1
        message = {"id": self._last, "method": method, "params": params} | self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        end = time.monotonic() + SECONDS
        while True:
            told = self._next(end)
            self._note(told)
            if told.get("id") == self._last:
                assert "error" not in told, told
                return told["result"]

    def _next(self, end: float) -> dict[str, Any]:
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._read], [], [], max(0.0, end - time.monotonic()))
            assert ready, f"the browser has not answered in {SECONDS:g} s"
            data = os.read(self._read, 1 << 20)
            assert data, "the browser has ended"
            self._rest += data
        message, _, self._rest = self._rest.partition(b"\0")
        return json.loads(message)

    def _note(self, told: dict[str, Any]) -> None:
        params = told.get("params", {})
        wrong = {
            "Runtime.exceptionThrown": True,
            "Runtime.consoleAPICalled": params.get("type") in ("error", "warning", "assert"),
            "Log.entryAdded": params.get("entry", {}).get("level") in ("error", "warning"),
        }
        if wrong.get(told.get("method", "")):
            self.faults.append(json.dumps(params)[:500])


@contextmanager
def browser(folder: Path) -> Iterator[Page]:
    """A page of a browser that keeps its profile in a folder."""
    assert FOUND
    to_read, write = os.pipe()
    read, to_write = os.pipe()
    command = [FOUND, *OPTIONS, f"--user-data-dir={folder}"]
    process = subprocess.Popen(  # the browser reads from 3 and writes to 4
        ["bash", "-c", f'exec "$@" 3<&{to_read} 4>&{to_write}', "bash", *command],
        pass_fds=(to_read, to_write),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ | {"HOME": str(folder)},
    )
    os.close(to_read)
    os.close(to_write)
    try:
        yield Page(read, write)
    finally:
        process.terminate()
        process.wait(10)
        os.close(read)
        os.close(write)
