"""A headless Chromium, driven over its DevTools protocol; tests that need one are skipped where there is none."""

import itertools
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome")
_FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--remote-debugging-port=0", "--no-first-run", "--disable-background-networking",
)  # fmt: skip
_LONG = 240  # seconds, on a machine that has other work
_FILE_INPUT = "[...document.querySelectorAll('input[type=file]')].find(e => e.getClientRects().length)"

_MIDDLE = """(() => { e.scrollIntoView({block: 'center'});
    const r = e.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2] })()"""
"""Of an element e, which is brought into view."""


class Browser:
    """One tab."""

    def __init__(self, socket: Any, downloads: Path) -> None:
        self._socket, self._numbers = socket, itertools.count(1)
        self.downloads, self.requests, self.clicks = downloads, list[str](), 0
        for domain in ("Page", "Runtime", "DOM", "Network"):
            self.call(f"{domain}.enable")
        self.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(downloads))

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The answer to one DevTools command; the addresses that pages ask for meanwhile are noted."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while (said := json.loads(self._socket.recv(timeout=300))).get("id") != number:
            if said.get("method") == "Network.requestWillBeSent":
                self.requests.append(said["params"]["request"]["url"])
        assert "error" not in said, said
        answer: dict[str, Any] = said["result"]
        return answer

    def run(self, script: str) -> Any:
        """What a JavaScript expression is."""
        said = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in said, said
        return said["result"].get("value")

    def open(self, url: str, *, size: tuple[int, int] = (1440, 900)) -> None:
        """Go to a page, in a window of so many pixels."""
        self.call(
            "Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=False
        )
        self.call("Page.navigate", url=url)

    def text(self) -> str:
        """All that can be read on the page."""
        return str(self.run("document.body ? document.body.innerText : ''"))

    def wait(self, until: Callable[[], Any]) -> Any:
        """Wait until something is so, and return it."""
        end = time.monotonic() + _LONG
        while not (found := until()):
            assert time.monotonic() < end, f"{_LONG} s passed; the page says: {self.text()}"
            time.sleep(0.1)
        return found

    def wait_for_text(self, words: str) -> None:
        """Wait until the page says so."""
        self.wait(lambda: words in self.text())

    def click(self, words: str, *, among: str = "button, label, [role=tab], [role=option]") -> None:
        """Click the innermost visible element of exactly these words, of those that a CSS selector names."""
        place = self.run(
            f"""(() => {{ const found = [...document.querySelectorAll({json.dumps(among)})]
            .filter(e => e.innerText.trim() === {json.dumps(words)} && e.getClientRects().length);
            const e = found[found.length - 1]; return e ? {_MIDDLE} : null }})()"""
        )
        assert place, f"nothing to click is called {words!r}: {self.text()}"
        self.click_at(*place)

    def choose(self, label: str, option: str) -> None:
        """Choose an option of the visible dropdown of that label."""

        def is_offered() -> bool:
            return bool(
                self.run(f"""[...document.querySelectorAll('[role=option]')]
                .some(e => e.innerText.trim() === {json.dumps(option)} && e.getClientRects().length)""")
            )

        def opened() -> bool:
            """Whether it is open; a click that missed, as the page moved below it, is made again."""
            place = self.run(
                f"""(() => {{ let e = [...document.querySelectorAll('label')]
                .filter(e => e.innerText.trim() === {json.dumps(label)} && e.getClientRects().length).pop();
                while (e && !e.querySelector('input')) e = e.parentElement;
                if (!e) return null; e = e.querySelector('input'); return {_MIDDLE} }})()"""
            )
            if not place:
                return False
            self.click_at(*place)
            end = time.monotonic() + 20
            while not is_offered() and time.monotonic() < end:
                time.sleep(0.1)
            return is_offered()

        self.wait(opened)
        self.click(option)

    def click_at(self, x: float, y: float) -> None:
        """Press and release the left button there."""
        self.clicks += 1
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def choose_file(self, path: Path) -> None:
        """Give a file to the page's file input, as soon as one is visible."""
        self.wait(lambda: self.run(f"!!{_FILE_INPUT}"))
        self.call("DOM.getDocument")
        found = self.call("Runtime.evaluate", expression=_FILE_INPUT)
        self.call("DOM.setFileInputFiles", files=[str(path)], objectId=found["result"]["objectId"])

    def drop_file(self, path: Path) -> None:
        """Drag a file onto the page's file input and let it go there, as soon as one is visible."""
        place = self.wait(lambda: self.run(f"(() => {{ const e = {_FILE_INPUT}; return e && {_MIDDLE} }})()"))
        data = {"items": [], "files": [str(path)], "dragOperationsMask": 1}
        for kind in ("dragEnter", "dragOver", "drop"):
            self.call("Input.dispatchDragEvent", type=kind, x=place[0], y=place[1], data=data)


@contextmanager
def chromium(folder: Path) -> Iterator[Browser]:
    """A browser whose profile and downloads are in a folder."""
    program = next((found for name in _NAMES if (found := shutil.which(name))), None)
    if program is None:
        pytest.skip(f"no Chromium here ({', '.join(_NAMES)})")
    from websockets.sync.client import connect

    profile, downloads = folder / "profile", folder / "downloads"
    downloads.mkdir(parents=True)
    command = [program, *_FLAGS, f"--user-data-dir={profile}", "about:blank"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            with connect(_tab(profile), max_size=None, ping_interval=None) as socket:
                yield Browser(socket, downloads)
        finally:
            process.terminate()


def _tab(profile: Path) -> str:
    """The address of the first tab's DevTools."""
    note = profile / "DevToolsActivePort"
    for _ in range(10 * _LONG):
        if note.exists() and (lines := note.read_text().split()):
            with urllib.request.urlopen(f"http://127.0.0.1:{lines[0]}/json") as answer:
                tabs = [tab for tab in json.load(answer) if tab["type"] == "page"]
            if tabs:
                return str(tabs[0]["webSocketDebuggerUrl"])
        time.sleep(0.1)
    raise AssertionError("Chromium did not start")
