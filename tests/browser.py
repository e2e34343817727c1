"""A headless Chromium behind chromedriver, by the WebDriver protocol over HTTP: nothing but the standard library."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

DRIVER, CHROMIUM = shutil.which("chromedriver"), shutil.which("chromium")
MISSING = "no Chromium and chromedriver here (Debian: chromium, chromium-driver)"
_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
PATIENCE_S = 20.0


class Browser:
    """One window; a context manager."""

    def __init__(self, profile: Path, size: tuple[int, int] = (1280, 1000)):
        """profile: a fresh folder for what the browser keeps."""
        self._process = subprocess.Popen([str(DRIVER), "--port=0"], stdout=subprocess.PIPE, text=True)
        self._base = ""
        while self._process.stdout and not self._base:
            line = self._process.stdout.readline()
            if not line:
                raise RuntimeError("chromedriver ended")
            if "started successfully on port" in line:
                self._base = f"http://127.0.0.1:{line.rstrip().rstrip('.').rsplit(' ', 1)[1]}/session"
        flags = [*_FLAGS, f"--user-data-dir={profile}", f"--window-size={size[0]},{size[1]}"]
        wanted = {"browserName": "chrome", "goog:chromeOptions": {"binary": CHROMIUM, "args": flags}}
        wanted["goog:loggingPrefs"] = {"browser": "ALL"}
        found = self._call("POST", "", {"capabilities": {"alwaysMatch": wanted}})
        self._base += f"/{found['sessionId']}"

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._call("DELETE", "", None)
        finally:
            self._process.terminate()
            self._process.communicate()

    def open(self, url: str) -> None:
        self._call("POST", "/url", {"url": url})

    def run(self, script: str) -> Any:
        """What a script's `return` gives."""
        return self._call("POST", "/execute/sync", {"script": script, "args": []})

    def text(self, element: str) -> str:
        """Text of the element with an id."""
        return str(self.run(f"return document.getElementById({json.dumps(element)}).textContent"))

    def until(self, script: str, done: Callable[[Any], bool] = bool) -> Any:
        """What a script returns once it is as wanted."""
        end = time.monotonic() + PATIENCE_S
        while True:
            value = self.run(script)
            if done(value):
                return value
            if time.monotonic() > end:
                raise AssertionError(f"after {PATIENCE_S:g} s: {script} gives {value!r}; console: {self.console()}")
            time.sleep(0.05)

    def press(self, keys: str, element: str = "map") -> None:
        """Keys to an element with an id; WebDriver's codes for special ones."""
        found = self._call("POST", "/element", {"using": "css selector", "value": f"#{element}"})
        self._call("POST", f"/element/{next(iter(found.values()))}/value", {"text": keys})

    def console(self) -> list[str]:
        """Errors and warnings of the page since the last call."""
        entries = self._call("POST", "/se/log", {"type": "browser"})
        return [entry["message"] for entry in entries if entry["level"] in ("SEVERE", "WARNING")]

    def screenshot(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self._call("GET", "/screenshot", None)))

    def _call(self, method: str, path: str, body: Any) -> Any:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self._base + path, data, {"Content-Type": "application/json"}, method=method)
        with urllib.request.urlopen(request, timeout=60.0) as answer:
            return json.load(answer)["value"]
