"""A headless Chromium, spoken to in its DevTools protocol through two pipes: no driver, no port, no package."""

import base64
import fcntl
import io
import json
import os
import select
import shutil
import time
from pathlib import Path

import numpy as np
from PIL import Image

COMMANDS = ("chromium", "chromium-browser", "google-chrome", "chrome-headless-shell")
CHROMIUM = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, COMMANDS)), None)
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--remote-debugging-pipe")
PATIENCE = 30.0  # seconds for an answer


class Browser:
    """One page of a browser; a context manager.

    Attributes:
        events: what the browser said without being asked, as (method, params).
    """

    def __init__(self, executable: str, profile: Path, size=(1000, 760)):
        self.events, self._count, self._rest = [], 0, b""
        # Chromium reads commands from its descriptor 3 and writes answers to its 4. Copies beyond these are moved
        # there: the pipes themselves may have either number.
        commands, self._write = os.pipe()
        self._read, answers = os.pipe()
        ends = [fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in (commands, answers)]
        moves = [(os.POSIX_SPAWN_DUP2, end, number) for end, number in zip(ends, (3, 4))]
        window = f"--window-size={size[0]},{size[1]}"
        line = [executable, *FLAGS, window, f"--user-data-dir={profile}", "about:blank"]
        self._process = os.posix_spawn(executable, line, os.environ, file_actions=moves)
        for end in (commands, answers, *ends):
            os.close(end)
        self._session = None
        target = self.call("Target.createTarget", url="about:blank", width=size[0], height=size[1])["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._send({"id": 0, "method": "Browser.close"})
        os.waitpid(self._process, 0)
        os.close(self._read)
        os.close(self._write)

    def _send(self, message) -> None:
        os.write(self._write, json.dumps(message).encode() + b"\0")

    def _receive(self, deadline: float):
        while b"\0" not in self._rest:
            ready, *_ = select.select([self._read], [], [], max(0.0, deadline - time.monotonic()))
            if not ready:
                raise TimeoutError(f"Chromium did not answer within {PATIENCE} s")
            chunk = os.read(self._read, 1 << 16)
            if not chunk:
                raise ConnectionError("Chromium ended")
            self._rest += chunk
        message, self._rest = self._rest.split(b"\0", 1)
        return json.loads(message)

    def call(self, method: str, **params):
        """The result of a command of the protocol."""
        self._count += 1
        session = {} if self._session is None else {"sessionId": self._session}
        self._send({"id": self._count, "method": method, "params": params} | session)
        deadline = time.monotonic() + PATIENCE
        while (message := self._receive(deadline)).get("id") != self._count:
            self.events.append((message["method"], message["params"]))
        if "error" in message:
            raise RuntimeError(f"{method}: {message['error']}")
        return message["result"]

    def open(self, path: Path) -> None:
        """Open a file, and wait until it is loaded."""
        self.call("Page.navigate", url=path.as_uri())
        deadline = time.monotonic() + PATIENCE
        while not any(method == "Page.loadEventFired" for method, _ in self.events):
            message = self._receive(deadline)
            self.events.append((message["method"], message["params"]))

    def ask(self, expression: str):
        """The value of an expression of JavaScript in the page."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        if "exceptionDetails" in found:
            raise RuntimeError(f"{expression}: {found['exceptionDetails']}")
        return found["result"].get("value")

    def picture(self) -> np.ndarray:
        """What is on the screen, shape (height, width, 3), 0 to 255."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)

    def mouse(self, kind: str, x: float, y: float, **more) -> None:
        """An event of the mouse: "mousePressed", "mouseMoved", "mouseReleased", "mouseWheel"."""
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def drag(self, *points: tuple[float, float]) -> None:
        """Press the mouse at the first point, move it through the others, release it at the last."""
        self.mouse("mousePressed", *points[0], button="left", buttons=1, clickCount=1)
        for point in points[1:]:
            self.mouse("mouseMoved", *point, button="left", buttons=1)
        self.mouse("mouseReleased", *points[-1], button="left", buttons=0, clickCount=1)
