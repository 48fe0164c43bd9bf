"""``gripmon teach --page`` in a process of its own, and a real headless browser that looks at its page."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
DEADLINE_S = 60.0
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")


@dataclass(frozen=True)
class Page:
    """The process and the address that it printed."""

    process: subprocess.Popen[str]
    url: str

    def ended(self) -> tuple[int, str]:
        """Exit code and what it said on stderr, once it has ended."""
        _, said = self.process.communicate(timeout=DEADLINE_S)
        return self.process.returncode, said


@contextmanager
def page(*arguments: object, command: tuple[str, ...] = ("teach", "--page")) -> Iterator[Page]:
    """The command, until the context ends."""
    process = subprocess.Popen(
        [sys.executable, "-m", "gripmon", *command, "--no-browser", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        found = re.search(r"http://127\.0\.0\.1:\d+/[\w-]+/", line)
        if found is None:
            _, said = process.communicate(timeout=DEADLINE_S)
            raise AssertionError(line + said)
        yield Page(process, found.group())
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()


def browser(*flags: str) -> Any:
    """A headless browser, with some more flags; the test is skipped where there is none."""
    selenium = pytest.importorskip("selenium.webdriver", reason="selenium isn't installed")
    from selenium.webdriver.chrome.service import Service

    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    driver = shutil.which("chromedriver")
    if program is None or driver is None:
        pytest.skip(f"no headless browser: none of {', '.join(BROWSERS)} with chromedriver")
    options = selenium.ChromeOptions()
    options.binary_location = program
    for argument in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1400,900", *flags):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    return selenium.Chrome(service=Service(driver), options=options)


class Visitor:
    """What a person does on the page."""

    def __init__(self, driver: Any, url: str):
        self.driver = driver
        driver.get(url)
        self.wait(lambda: self.script("return document.body.dataset.ready === 'true'"), "the page to begin")
        self.settle()

    def script(self, text: str, *arguments: object) -> Any:
        return self.driver.execute_script(text, *arguments)

    def wait(self, condition: Callable[[], object], what: str) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < deadline, f"waited for {what}; the page says: {self.text('#status')}"
            time.sleep(0.02)

    def settle(self) -> None:
        """Until nothing is asked for and everything is drawn."""
        drawn = (
            "const done = arguments[0];"
            "const look = () => document.body.dataset.busy === 'true' ? setTimeout(look, 20)"
            " : requestAnimationFrame(() => requestAnimationFrame(() => done(document.body.dataset.busy !== 'true')));"
            "look();"
        )
        self.driver.set_script_timeout(DEADLINE_S)
        self.wait(lambda: self.driver.execute_async_script(drawn), "an answer")

    def find(self, selector: str) -> Any:
        return self.driver.find_element("css selector", selector)

    def text(self, selector: str) -> str:
        return str(self.find(selector).text)

    def click(self, selector: str) -> None:
        self.find(selector).click()

    def at(self, corner: str) -> tuple[float, float]:
        """Where a handle is, px of the image."""
        values = self.script(
            "const {u, v} = document.querySelector(`.handle[data-corner=${arguments[0]}]`).dataset; return [u, v]",
            corner,
        )
        return float(values[0]), float(values[1])

    def state(self, corner: str) -> str:
        return str(self.find(f".handle[data-corner={corner}]").get_attribute("data-state"))

    def drag(self, corner: str, u: float, v: float) -> None:
        """Take a handle to about (u, v): by whole pixels of the screen."""
        from selenium.webdriver.common.action_chains import ActionChains

        scale = float(self.text("#zoom").rstrip(" %")) / 100.0
        now_u, now_v = self.at(corner)
        handle = self.find(f".handle[data-corner={corner}] .hit")
        chain = ActionChains(self.driver, duration=60).move_to_element(handle).click_and_hold()
        chain.move_by_offset(round((u - now_u) * scale), round((v - now_v) * scale)).release().perform()
        self.settle()

    def put(self, corners: Mapping[str, Sequence[float]]) -> None:
        """Drag rough corners to about (u, v), the inner ones first: of the others those beside the chosen one show."""
        for corner, (u, v) in sorted(corners.items(), key=lambda each: ("_inner_" not in each[0], each[0])):
            if "_inner_" not in corner:
                self.click(f"#corners tr[data-corner={re.sub('_(outer|end|rise)_', '_inner_', corner)}]")
            self.drag(corner, u, v)

    def keys(self, *keys: str, control: bool = False, shift: bool = False) -> None:
        """Type, with the image in focus."""
        from selenium.webdriver.common.action_chains import ActionChains
        from selenium.webdriver.common.keys import Keys

        held = [key for key, on in ((Keys.CONTROL, control), (Keys.SHIFT, shift)) if on]
        chain = ActionChains(self.driver)
        for key in held:
            chain.key_down(key)
        for key in keys:
            chain.send_keys(key)
        for key in held:
            chain.key_up(key)
        chain.perform()
        self.settle()

    def complaints(self) -> list[str]:
        """What the browser's log holds."""
        return [entry["message"] for entry in self.driver.get_log("browser")]
