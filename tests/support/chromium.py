"""A real browser for tests: Chromium without a window, spoken to through its pipe (DevTools protocol), no package."""

import base64
import itertools
import json
import os
import select
import shutil
import subprocess
import time
from contextlib import contextmanager

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
FLAGS = ("--headless", "--no-sandbox", "--remote-debugging-pipe", "--use-angle=swiftshader",
         "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run", "--disable-background-networking",
         "--disable-component-update", "--disable-sync", "--hide-scrollbars")


def found():
    """The browser's path, or None."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Page:
    """One tab; `value` runs JavaScript (promises are waited for)."""

    def __init__(self, to, back, limit=60.0):
        self._to, self._back, self._limit, self._kept = to, back, limit, b""
        self._numbers, self._session = itertools.count(1), None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]

    def call(self, method, **parameters):
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        until = time.monotonic() + self._limit
        while True:
            while b"\0" not in self._kept:
                if not select.select([self._back], [], [], max(0, until - time.monotonic()))[0]:
                    raise TimeoutError(f"the browser did not answer {method}")
                self._kept += os.read(self._back, 1 << 20)
            text, self._kept = self._kept.split(b"\0", 1)
            answer = json.loads(text)
            if answer.get("id") == number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]

    def open(self, path, width, height, phone=False):
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=phone)
        self.call("Page.navigate", url=path.resolve().as_uri())
        self.wait("document.readyState === 'complete'")

    def value(self, script):
        answer = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(f"{script}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def wait(self, condition, limit=30.0):
        until = time.monotonic() + limit
        while not self.value(condition):
            if time.monotonic() > until:
                raise TimeoutError(f"not so after {limit:g} s: {condition}")
            time.sleep(0.05)

    def drag(self, start, end):
        """Press at `start`, move to `end`, let go: pixels of the window."""
        for kind, (x, y) in (("mousePressed", start), ("mouseMoved", end), ("mouseReleased", end)):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def picture(self, path, whole=False):
        data = self.call("Page.captureScreenshot", captureBeyondViewport=whole)["data"]
        path.write_bytes(base64.b64decode(data))


@contextmanager
def browser(profile):
    """A Page in a new Chromium whose profile is the folder `profile`; the browser ends with the context."""
    to_read, to = os.pipe()
    back, back_write = os.pipe()

    def pipes():  # the protocol's two ends are 3 and 4; first out of the way, where they have these numbers
        ends = os.dup(to_read), os.dup(back_write)
        os.dup2(os.dup(ends[0]), 3)
        os.dup2(os.dup(ends[1]), 4)

    process = subprocess.Popen([found(), *FLAGS, f"--user-data-dir={profile}", "about:blank"], preexec_fn=pipes,
                               close_fds=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    os.close(to_read)
    os.close(back_write)
    try:
        yield Page(to, back)
    finally:
        process.kill()
        process.wait()
        os.close(to)
        os.close(back)
