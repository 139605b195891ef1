"""Pages of a headless browser, driven through its debugging pipe; needs nothing but Chromium itself."""

from __future__ import annotations

import atexit
import base64
import json
import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any, ClassVar, Self

CHROMIUM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None
)


class _Chromium:
    """The browser of this process, which all its pages share: it takes longer to start than most pages to test."""

    current: ClassVar[_Chromium | None] = None

    def __init__(self) -> None:
        assert CHROMIUM is not None
        (in_read, in_write), (out_read, out_write) = os.pipe(), os.pipe()

        def wired() -> None:
            # Chromium reads commands from 3 and answers on 4.
            one, two = os.dup(in_read), os.dup(out_write)
            os.dup2(one, 3)
            os.dup2(two, 4)

        self.profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        self.process = subprocess.Popen(
            [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe",
             f"--user-data-dir={self.profile.name}", "about:blank"],
            preexec_fn=wired, close_fds=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(in_read)
        os.close(out_write)
        self.commands, self.answers = os.fdopen(in_write, "wb", 0), os.fdopen(out_read, "rb", 0)
        self.number, self.rest = 0, b""
        atexit.register(self.end)

    @classmethod
    def running(cls) -> _Chromium:
        if cls.current is None or cls.current.process.poll() is not None:
            cls.current = cls()
        return cls.current

    def send(self, method: str, session: str | None, parameters: dict[str, Any]) -> int:
        """The number of the command, which its answer has, too."""
        self.number += 1
        message: dict[str, Any] = {"id": self.number, "method": method, "params": parameters}
        if session:
            message["sessionId"] = session
        self.commands.write(json.dumps(message).encode() + b"\0")
        return self.number

    def message(self) -> dict[str, Any]:
        while b"\0" not in self.rest:
            part = os.read(self.answers.fileno(), 1 << 20)
            assert part, "the browser has ended"
            self.rest += part
        line, _, self.rest = self.rest.partition(b"\0")
        return json.loads(line)

    def end(self) -> None:
        self.process.terminate()
        self.process.wait(10)
        self.commands.close()
        self.answers.close()
        self.profile.cleanup()


class Browser:
    """One page of a headless Chromium, with cookies and storage of its own, until the end of a ``with``.

    ``js`` evaluates; ``click`` and ``wheel`` simulate user input. errors : exceptions of its scripts. complaints :
    errors logged by the browser. requests : requested URLs.
    """

    def __init__(self, page: Path | str, size: tuple[int, int] = (1400, 1000)) -> None:
        self.chromium, self.session = _Chromium.running(), None
        self.errors: list[str] = []
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.context = self.do("Target.createBrowserContext")["browserContextId"]
        blank = self.do("Target.createTarget", url="about:blank", browserContextId=self.context)["targetId"]
        self.session = self.do("Target.attachToTarget", targetId=blank, flatten=True)["sessionId"]
        width, height = size
        self.do("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.do(f"{domain}.enable")
        self.do("Page.navigate", url=page if isinstance(page, str) else page.resolve().as_uri())
        self.until("document.body && document.body.dataset.ready === 'yes'")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.session = None
        self.do("Target.disposeBrowserContext", browserContextId=self.context)

    def do(self, method: str, **parameters: Any) -> dict[str, Any]:
        number = self.chromium.send(method, self.session, parameters)
        while (answer := self.chromium.message()).get("id") != number:
            self.note(answer)
        assert "error" not in answer, answer
        return answer["result"]

    def note(self, event: dict[str, Any]) -> None:
        if event.get("sessionId") != self.session:  # of the page before
            return
        method, given = event["method"], event["params"]
        if method == "Runtime.exceptionThrown":
            self.errors.append(str(given["exceptionDetails"]))
        if method == "Log.entryAdded" and given["entry"]["level"] == "error":
            self.complaints.append(str(given["entry"]["text"]))
        if method == "Network.requestWillBeSent":
            self.requests.append(given["request"]["url"])

    def js(self, expression: str) -> Any:
        result = self.do("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def settle(self) -> None:
        """Wait until what was asked is drawn: a click meets what the last picture showed, not what came after it."""
        frame = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
        self.do("Runtime.evaluate", expression=f"{frame}.then(() => true)", awaitPromise=True, returnByValue=True)

    def until(self, expression: str, patience_s: float = 20.0) -> None:
        end = time.monotonic() + patience_s
        while not self.js(expression):
            assert time.monotonic() < end, f"never true: {expression}"
            time.sleep(0.05)

    def click(self, x: float, y: float) -> None:
        for kind in ("mousePressed", "mouseReleased"):
            self.do("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def wheel(self, x: float, y: float, delta: float) -> None:
        self.do("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=delta)

    def picture(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self.do("Page.captureScreenshot")["data"]))
