"""The system's Chromium without a window, driven by the system's chromedriver; nothing is downloaded."""

import io
import json
import os
import shutil
from pathlib import Path

import numpy as np
from PIL import Image
from selenium import webdriver

COMMANDS = ("chromium", "chromium-browser", "google-chrome", "chrome-headless-shell")
DRIVER = shutil.which("chromedriver")
CHROMIUM = DRIVER and (os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, COMMANDS)), None))
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
os.environ["SE_OFFLINE"] = "true"


class Browser:
    """One page of a browser; a context manager."""

    def __init__(self, executable: str, profile: Path, size=(1000, 760)):
        options = webdriver.ChromeOptions()
        options.binary_location = executable
        for flag in (*FLAGS, f"--window-size={size[0]},{size[1]}", f"--user-data-dir={profile}"):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        self._driver = webdriver.Chrome(options, webdriver.ChromeService(executable_path=DRIVER))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._driver.quit()

    def open(self, path: Path) -> None:
        """Open a file, and wait until it is loaded."""
        self._driver.get(path.as_uri())

    def complaints(self) -> list[str]:
        """What the page or the browser has written to the console, exceptions among it."""
        return [entry["message"] for entry in self._driver.get_log("browser")]

    def requests(self) -> list[str]:
        """The addresses that the page has asked for."""
        messages = [json.loads(entry["message"])["message"] for entry in self._driver.get_log("performance")]
        sent = [message["params"] for message in messages if message["method"] == "Network.requestWillBeSent"]
        page = self._driver.current_url  # others are those of the tab that the browser opens by itself
        return [request["request"]["url"] for request in sent if request["documentURL"] == page]

    def ask(self, expression: str):
        """The value of an expression of JavaScript in the page; of a promise what it promises."""
        return self._driver.execute_script(f"return {expression}")

    def picture(self) -> np.ndarray:
        """What is on the screen, shape (height, width, 3), 0 to 255."""
        return np.asarray(Image.open(io.BytesIO(self._driver.get_screenshot_as_png())).convert("RGB")).astype(int)

    def mouse(self, kind: str, x: float, y: float, **more) -> None:
        """An event of the mouse: "mousePressed", "mouseMoved", "mouseReleased", "mouseWheel"."""
        self._driver.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": kind, "x": x, "y": y} | more)

    def drag(self, *points: tuple[float, float]) -> None:
        """Press the mouse at the first point, move it through the others, release it at the last."""
        self.mouse("mousePressed", *points[0], button="left", buttons=1, clickCount=1)
        for point in points[1:]:
            self.mouse("mouseMoved", *point, button="left", buttons=1)
        self.mouse("mouseReleased", *points[-1], button="left", buttons=0, clickCount=1)
