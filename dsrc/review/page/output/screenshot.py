"""Screenshots of a page by headless Chromium over the DevTools protocol."""

import base64
import json
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

from sim.errors import SettingsError

PATIENCE_S = 300.0
"""Longest time for which a browser is waited for, s: one that draws in software on a busy machine is slow."""

# Software rendering by name: a later Chromium may otherwise have no WebGL.
_FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--no-first-run",
    "--remote-debugging-port=0",
)
_NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")


def find_chromium() -> str | None:
    """Path of an installed Chromium, None without one."""
    return next((path for name in _NAMES if (path := shutil.which(name))), None)


class BrowserPage:
    """Open page of a browser, by its DevTools connection."""

    def __init__(self, socket: Any) -> None:
        self._socket = socket
        self._ids = count(1)

    def send(self, method: str, timeout_s: float = PATIENCE_S, **parameters: Any) -> dict[str, Any]:
        """Call a DevTools method and return its result."""
        number = next(self._ids)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=timeout_s))
            if message.get("id") == number:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error'].get('message')}")
                return message["result"]

    def evaluate(self, script: str) -> Any:
        """Run JavaScript and return its value."""
        result = self.send("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in result:
            raise RuntimeError(f"script failed: {result['exceptionDetails'].get('text')}")
        return result["result"].get("value")

    def wait_for(self, script: str, timeout_s: float) -> None:
        """Wait until a JavaScript expression is true; TimeoutError after `timeout_s`."""
        end = time.monotonic() + timeout_s
        while not self._holds(script):
            if time.monotonic() > end:
                raise TimeoutError(f"the page did not get ready: {script}")
            time.sleep(0.1)

    def _holds(self, script: str) -> bool:
        try:
            return bool(self.evaluate(f"Boolean({script})"))
        except RuntimeError as error:
            # A page that goes elsewhere takes the script with it.
            if "navigated" not in str(error) and "context" not in str(error):
                raise
            return False

    def png(self) -> bytes:
        """PNG of the page."""
        return base64.b64decode(self.send("Page.captureScreenshot", format="png")["data"])


@contextmanager
def open_page(address: str, size: tuple[int, int] = (1280, 720)) -> Iterator[BrowserPage]:
    """Open an address in a new browser, closed at the end of the block.

    Args:
        size: width and height of the page in pixels.

    Raises:
        SettingsError: no Chromium is installed, or it does not start.
    """
    from websockets.sync.client import connect

    program = find_chromium()
    if program is None:
        raise SettingsError(f"screenshot: no browser found; install one of: {', '.join(_NAMES)}")
    with tempfile.TemporaryDirectory(prefix="review-", ignore_cleanup_errors=True) as profile:
        arguments = [
            program,
            *_FLAGS,
            f"--user-data-dir={profile}",
            f"--window-size={size[0]},{size[1]}",
            "about:blank",
        ]
        browser = subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            # A browser that draws in software may leave a ping unanswered for minutes.
            with connect(_page_socket(browser, Path(profile)), max_size=None, ping_interval=None) as socket:
                page = BrowserPage(socket)
                page.send("Page.enable")
                page.send("Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1,
                          mobile=False)  # fmt: skip
                page.send("Page.navigate", url=address)
                yield page
        finally:
            browser.terminate()
            try:
                browser.wait(timeout=10.0)
            except subprocess.TimeoutExpired:
                browser.kill()
                browser.wait()


def _page_socket(browser: subprocess.Popen, profile: Path) -> str:
    """DevTools address of the browser's one page; SettingsError where the browser ends or does not start."""
    import urllib.request

    note = profile / "DevToolsActivePort"
    end = time.monotonic() + 60.0
    while time.monotonic() < end:
        if browser.poll() is not None:
            raise SettingsError(f"screenshot: the browser ended with code {browser.returncode}")
        lines = note.read_text().splitlines() if note.exists() else []
        if len(lines) >= 2:
            with urllib.request.urlopen(f"http://127.0.0.1:{lines[0]}/json/list", timeout=30.0) as answer:
                pages = [target for target in json.load(answer) if target["type"] == "page"]
            if pages:
                return str(pages[0]["webSocketDebuggerUrl"])
        time.sleep(0.05)
    raise SettingsError("screenshot: the browser did not start")
