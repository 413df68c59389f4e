"""A headless Chromium, driven over its DevTools protocol: real pointer, wheel, touch and key events."""

import json
import shutil
import subprocess
import tempfile
import time
from base64 import b64decode
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
KEYS = {"+": 187, "-": 189, "ArrowUp": 38, "ArrowDown": 40, "ArrowLeft": 37, "ArrowRight": 39, "Home": 36, "Tab": 9}


class Page:
    """A tab: what it does, and what went wrong in it."""

    def __init__(self, socket: Any, address: str, size: tuple[int, int]) -> None:
        self.socket, self.session, self.number = socket, None, 0
        self.errors: list[str] = []
        self.requests: list[str] = []
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for name in ("Runtime", "Log", "Network", "Page"):
            self.send(f"{name}.enable")
        self.resize(*size)
        self.send("Page.navigate", url=address)

    def send(self, method: str, **words: Any) -> Any:
        """Send a command, and return its result; events that arrive in the meantime are noted."""
        self.number += 1
        number = self.number
        message = {"id": number, "method": method, "params": words}
        self.socket.send(json.dumps(message | ({"sessionId": self.session} if self.session else {})))
        while True:
            found = json.loads(self.socket.recv(timeout=60))
            if found.get("id") == number and found.get("sessionId") == self.session:
                assert "error" not in found, found["error"]
                return found["result"]
            self._note(found.get("method"), found.get("params", {}))

    def _note(self, event: str | None, facts: dict[str, Any]) -> None:
        if event == "Runtime.exceptionThrown":
            self.errors.append(str(facts["exceptionDetails"]))
        elif event == "Runtime.consoleAPICalled" and facts["type"] in ("error", "warning", "assert"):
            self.errors.append(str(facts["args"]))
        elif event == "Log.entryAdded" and facts["entry"]["level"] in ("error", "warning"):
            self.errors.append(facts["entry"]["text"])
        elif event == "Network.requestWillBeSent":
            self.requests.append(facts["request"]["url"])

    def run(self, code: str) -> Any:
        """Return what a JavaScript expression gives."""
        found = self.send("Runtime.evaluate", expression=code, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def wait(self, condition: str, seconds: float = 30) -> None:
        """Wait until a JavaScript expression holds."""
        end = time.monotonic() + seconds
        while not self.run(condition):
            assert time.monotonic() < end, f"not within {seconds} s: {condition}"
            time.sleep(0.02)

    def settle(self) -> None:
        """Wait until the page has answered all events and, by its own account, is ready."""
        self.wait("document.body?.dataset.state !== undefined")
        self.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))")
        self.wait("document.body.dataset.state === 'ready'")

    def resize(self, width: int, height: int, scale: float = 1, touch: bool = False) -> None:
        """Set the size of the window [CSS pixels], and pixels per CSS pixel."""
        self.send(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=scale, mobile=False
        )
        self.send("Emulation.setTouchEmulationEnabled", enabled=touch)

    def mouse(self, kind: str, x: float, y: float, **words: Any) -> None:
        """Send an event of the mouse: mouseMoved, mousePressed, mouseReleased, mouseWheel."""
        if kind in ("mousePressed", "mouseReleased"):
            words = {"button": "left", "clickCount": 1, "buttons": 1} | words
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **words)

    def touch(self, kind: str, *places: tuple[float, float]) -> None:
        """Send an event of fingers: touchStart, touchMove, touchEnd."""
        points = [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(places)]
        self.send("Input.dispatchTouchEvent", type=kind, touchPoints=points)

    def key(self, key: str, shift: bool = False) -> None:
        """Press and release a key."""
        code = KEYS.get(key) or ord(key.upper())
        words = {"key": key, "windowsVirtualKeyCode": code, "modifiers": 8 * shift}
        text = {"text": key} if len(key) == 1 else {}
        self.send("Input.dispatchKeyEvent", type="keyDown", **words, **text)
        self.send("Input.dispatchKeyEvent", type="keyUp", **words)

    def picture(self) -> np.ndarray:
        """Return what is shown, (rows, columns, 3) uint8."""
        data = self.send("Page.captureScreenshot", format="png")["data"]
        return np.asarray(Image.open(BytesIO(b64decode(data))).convert("RGB"))


@contextmanager
def open_chromium() -> Iterator[Any]:
    """Start the browser, and yield a function that opens a page in it; skip the test where there is none."""
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip(f"no browser on the path: none of {', '.join(BROWSERS)}")
    client = pytest.importorskip("websockets.sync.client", reason="websockets drives the browser")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        words = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run"]
        words += ["--remote-debugging-port=0", f"--user-data-dir={folder}", "about:blank"]
        with subprocess.Popen([program, *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as browser:
            try:
                port, path = _address(Path(folder) / "DevToolsActivePort", browser)
                with client.connect(f"ws://127.0.0.1:{port}{path}", max_size=None) as socket:
                    yield lambda address, size=(1200, 800): Page(socket, address, size)
                    socket.send(json.dumps({"id": 0, "method": "Browser.close"}))
                browser.wait(10)
            finally:
                browser.kill()


def _address(file: Path, browser: subprocess.Popen) -> tuple[str, str]:
    """Return port and path at which the browser is driven."""
    end = time.monotonic() + 30
    while not (file.exists() and len(lines := file.read_text().splitlines()) == 2):
        assert browser.poll() is None, "the browser stopped"
        assert time.monotonic() < end, "the browser did not start within 30 s"
        time.sleep(0.05)
    return lines[0], lines[1]
