"""Headless Chromium, driven by its own protocol over a pipe."""

import base64
import contextlib
import fcntl
import json
import os
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from packages import not_run

SECONDS = 60  # to wait for anything
OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--hide-scrollbars",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-extensions",
    "--disable-sync",
    "--mute-audio",
)


def chromium() -> str:
    """The program; without it, the test is not run."""
    found = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    return found or not_run("chromium")


class Tab:
    """A tab of a browser, and what it has written to its console."""

    def __init__(self, to: IO[bytes], source: IO[bytes]) -> None:
        self._to, self._source = to, source
        self._rest, self._number, self._session = b"", 0, ""
        self.events: list[dict[str, Any]] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The result of a method of the protocol."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        self._to.write(json.dumps(message).encode() + b"\0")
        while True:
            answer = self._receive()
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]
            self.events.append(answer)

    def _receive(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            part = self._source.read(2**16)
            assert part, "the browser has ended"
            self._rest += part
        message, _, self._rest = self._rest.partition(b"\0")
        return json.loads(message)

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression, awaited."""
        found = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def wait_for(self, expression: str) -> Any:
        """The value of an expression, once it is true."""
        end = time.monotonic() + SECONDS
        while time.monotonic() < end:
            value = self.evaluate(expression)
            if value:
                return value
            time.sleep(0.02)
        raise AssertionError(f"{expression} did not become true; the console says {self.errors()}")

    def open(self, url: str, width: int = 1280, height: int = 1100, dark: bool = False) -> None:
        """Load a page in a window of this size, until its videos are drawn."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.call("Emulation.setEmulatedMedia", features=scheme)
        self.call("Page.navigate", url=url)
        self.wait_for("document.documentElement?.dataset.complete === 'true'")

    def press(self, key: str) -> None:
        """Press a key."""
        text = {"text": key} if len(key) == 1 else {}
        self.call("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=key)

    def screenshot(self, path: Path, whole: bool = False) -> None:
        """Write a PNG of the window, or of the whole page."""
        found = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(found["data"]))

    def errors(self) -> list[str]:
        """Errors and warnings of the console so far, and uncaught exceptions."""
        self.evaluate("0")  # everything before has arrived
        found = []
        for event in self.events:
            parameters = event.get("params", {})
            if event.get("method") == "Runtime.exceptionThrown":
                found.append(str(parameters["exceptionDetails"]))
            if event.get("method") == "Runtime.consoleAPICalled" and parameters["type"] in ("error", "warning"):
                found.append(str(parameters["args"]))
            if event.get("method") == "Log.entryAdded" and parameters["entry"]["level"] in ("error", "warning"):
                found.append(parameters["entry"]["text"])
        return found

    def requests(self) -> list[str]:
        """URLs that the page has asked for, apart from those that hold their own data."""
        self.evaluate("0")
        sent = [event["params"]["request"]["url"] for event in self.events if event.get("method") == REQUEST]
        return [url for url in sent if not url.startswith(("data:", "blob:"))]


REQUEST = "Network.requestWillBeSent"


@contextlib.contextmanager
def browser(folder: Path) -> Iterator[Tab]:
    """A new browser whose files are in this folder."""
    program = chromium()
    command_source, command_to = os.pipe()
    answer_source, answer_to = os.pipe()
    # The browser reads commands from descriptor 3 and writes answers to 4.
    high = [fcntl.fcntl(one, fcntl.F_DUPFD_CLOEXEC, 10) for one in (command_source, answer_to)]
    actions = [(os.POSIX_SPAWN_DUP2, one, target) for one, target in zip(high, (3, 4), strict=True)]
    actions += [(os.POSIX_SPAWN_OPEN, target, os.devnull, os.O_RDWR, 0) for target in (0, 1, 2)]
    arguments = [program, *OPTIONS, f"--user-data-dir={folder}", "--remote-debugging-pipe"]
    process = os.posix_spawn(program, arguments, os.environ, file_actions=actions, setsid=True)
    for one in (command_source, answer_to, *high):
        os.close(one)
    with os.fdopen(command_to, "wb", 0) as to, os.fdopen(answer_source, "rb", 0) as source:
        try:
            yield Tab(to, source)
        finally:
            os.killpg(process, signal.SIGKILL)  # with the processes that it has started
            os.waitpid(process, 0)
