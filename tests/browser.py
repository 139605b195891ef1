"""A headless browser, driven through its debugging pipe; needs nothing but Chromium itself."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

CHROMIUM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None
)


class Browser:
    """One page of a headless Chromium: ``js`` evaluates; ``click`` and ``wheel`` simulate user input.

    errors : exceptions of its scripts. complaints : errors logged by the browser. requests : requested URLs.
    """

    def __init__(self, profile: Path, page: Path | str, size: tuple[int, int] = (1400, 1000)) -> None:
        assert CHROMIUM is not None
        (in_read, in_write), (out_read, out_write) = os.pipe(), os.pipe()

        def wired() -> None:
            # Chromium reads commands from 3 and answers on 4.
            one, two = os.dup(in_read), os.dup(out_write)
            os.dup2(one, 3)
            os.dup2(two, 4)

        self.process = subprocess.Popen(
            [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe",
             f"--user-data-dir={profile}", f"--window-size={size[0]},{size[1]}", "about:blank"],
            preexec_fn=wired, close_fds=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(in_read)
        os.close(out_write)
        self.commands, self.answers = os.fdopen(in_write, "wb", 0), os.fdopen(out_read, "rb", 0)
        self.number, self.session, self.rest = 0, None, b""
        self.errors: list[str] = []
        self.complaints: list[str] = []
        self.requests: list[str] = []
        pages = [t for t in self.do("Target.getTargets")["targetInfos"] if t["type"] == "page"]
        self.session = self.do("Target.attachToTarget", targetId=pages[0]["targetId"], flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.do(f"{domain}.enable")
        self.do("Page.navigate", url=page if isinstance(page, str) else page.resolve().as_uri())
        self.until("document.body && document.body.dataset.ready === 'yes'")

    def do(self, method: str, **parameters: Any) -> dict[str, Any]:
        self.number += 1
        message: dict[str, Any] = {"id": self.number, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        self.commands.write(json.dumps(message).encode() + b"\0")
        while True:
            answer = self._answer()
            if answer.get("id") == self.number:
                assert "error" not in answer, answer
                return answer["result"]

    def _answer(self) -> dict[str, Any]:
        while b"\0" not in self.rest:
            part = os.read(self.answers.fileno(), 1 << 20)
            assert part, "the browser has ended"
            self.rest += part
        line, _, self.rest = self.rest.partition(b"\0")
        message = json.loads(line)
        if message.get("method") == "Runtime.exceptionThrown":
            self.errors.append(str(message["params"]["exceptionDetails"]))
        if message.get("method") == "Log.entryAdded" and message["params"]["entry"]["level"] == "error":
            self.complaints.append(str(message["params"]["entry"]["text"]))
        if message.get("method") == "Network.requestWillBeSent":
            self.requests.append(message["params"]["request"]["url"])
        return message

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

    def close(self) -> None:
        self.process.terminate()
        self.process.wait(10)
        self.commands.close()
        self.answers.close()
