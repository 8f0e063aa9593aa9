"""A headless Chromium that does as it is told, over the pipe of its DevTools protocol.

Needs `chromium` (Debian: apt-get install chromium) and no library.
"""

import base64
import json
import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

PATIENCE_S = 60.0
_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def find_chromium() -> str | None:
    """Path of the program, or None."""
    return next((found for name in _NAMES if (found := shutil.which(name))), None)


class Browser:
    """One browser with one page; a context manager.

    `requests` holds the addresses of everything that the page asked for, `problems` what it complained about.
    """

    def __init__(self, width: int = 1280, height: int = 860, fineness: float = 1.0) -> None:
        program = find_chromium()
        if program is None:
            raise RuntimeError("there is no chromium here: apt-get install chromium")
        self.requests: list[str] = []
        self.problems: list[str] = []
        self._folder = tempfile.TemporaryDirectory(prefix="chromium-", ignore_cleanup_errors=True)
        theirs_in, ours_out = os.pipe()
        ours_in, theirs_out = os.pipe()
        arguments = [
            "--headless",
            "--no-sandbox",  # a container has none to give
            "--disable-gpu",
            "--disable-dev-shm-usage",
            "--no-first-run",
            "--disable-background-networking",
            "--remote-debugging-pipe",
            f"--user-data-dir={self._folder.name}",
            "about:blank",
        ]
        # The protocol is spoken on descriptors 3 and 4 of the browser.
        wiring = f'exec "$@" 3<&{theirs_in} 4>&{theirs_out}'
        self._process = subprocess.Popen(
            ["bash", "-c", wiring, "chromium", program, *arguments],
            pass_fds=(theirs_in, theirs_out),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        self._in, self._out = os.fdopen(ours_in, "rb", 0), os.fdopen(ours_out, "wb", 0)
        self._read, self._number, self._session = b"", 0, ""
        targets = self.ask("Target.getTargets")["targetInfos"]
        page = next(t["targetId"] for t in targets if t["type"] == "page")
        self._session = self.ask("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.ask(f"{domain}.enable")
        self.resize(width, height, fineness)

    def __enter__(self) -> "Browser":
        """Give the browser itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it, and what it kept on disk."""
        self._session = ""
        try:
            self.ask("Browser.close")
        except (OSError, RuntimeError):
            self._process.kill()
        self._in.close()
        self._out.close()
        self._process.wait(PATIENCE_S)
        self._folder.cleanup()

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol and wait for its result."""
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        self._out.write(json.dumps(message).encode() + b"\0")
        while (answer := self._next()).get("id") != self._number:
            self._note(answer)
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']['message']}")
        return answer["result"]

    def open(self, url: str) -> None:
        """Go to a page."""
        self.ask("Page.navigate", url=url)

    def resize(self, width: int, height: int, fineness: float = 1.0) -> None:
        """Give the page so many CSS pixels, with `fineness` pixels of the screenshot for each."""
        self.ask(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=fineness,
            mobile=False,
        )

    def prefer(self, scheme: str) -> None:
        """Be `light` or `dark`."""
        self.ask("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])

    def value(self, expression: str) -> Any:
        """Of a JavaScript expression; a promise is waited for."""
        asked = self.ask("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in asked:
            raise RuntimeError(f"{expression}: {asked['exceptionDetails']}")
        return asked["result"].get("value")

    def until(self, expression: str) -> Any:
        """Wait until an expression is true; a page that is still loading has none of its names."""
        limit = time.monotonic() + PATIENCE_S
        not_yet = "if (error instanceof ReferenceError) return false; throw error"
        tried = f"(() => {{ try {{ return {expression} }} catch (error) {{ {not_yet} }} }})()"
        while not (value := self.value(tried)):
            if time.monotonic() > limit:
                raise RuntimeError(f"{expression} did not become true; the page says {self.problems}")
            self.value("new Promise((done) => setTimeout(done, 20))")
        return value

    def settle(self) -> None:
        """Wait until the page has drawn what it knows."""
        self.value("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def screenshot(self, path: Path) -> None:
        """Write a PNG of what can be seen."""
        self.settle()
        path.write_bytes(base64.b64decode(self.ask("Page.captureScreenshot", format="png")["data"]))

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._read:
            more = os.read(self._in.fileno(), 1 << 16)
            if not more:
                raise RuntimeError("the browser has gone")
            self._read += more
        first, _, self._read = self._read.partition(b"\0")
        return json.loads(first)

    def _note(self, event: dict[str, Any]) -> None:
        about = event.get("params", {})
        if event["method"] == "Network.requestWillBeSent":
            self.requests.append(about["request"]["url"])
        elif event["method"] == "Network.webSocketCreated":
            self.requests.append(about["url"])
        elif event["method"] == "Runtime.exceptionThrown":
            self.problems.append(json.dumps(about["exceptionDetails"])[:500])
        elif event["method"] == "Log.entryAdded" and about["entry"]["level"] == "error":
            self.problems.append(about["entry"]["text"])
