"""What a person does on the page of ``gripmon setup``, from nothing to a running monitor, on simulated images; and, run
as a program, the pictures of docs/tutorials/setup.md: ``cd tests && python -m support.setup_walk``.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from support import new_user
from support.loopback import wait_for_default_port
from support.teach_page_browser import ROOT, Visitor, browser, page

INNER = ("left_inner_near", "left_inner_far", "right_inner_near", "right_inner_far")
WIDTHS = (375, 768, 1280, 1920)
WIDE = 1150
"""Of the pictures, px."""
_CONTROLS = """
const seen = [...document.querySelectorAll("button, input, select, a, label.check, #legend")]
  .filter((node) => node.checkVisibility({visibilityProperty: true}) && node.getBoundingClientRect().width > 0);
const out = [], named = (node) => node.id || node.name || node.textContent, wide = document.documentElement.scrollWidth;
for (const [k, a] of seen.entries()) {
  const one = a.getBoundingClientRect();
  if (one.left < -0.5 || one.right > innerWidth + 0.5) out.push(`${named(a)} beyond the border`);
  for (const b of seen.slice(k + 1)) {
    if (a.contains(b) || b.contains(a)) continue;
    const other = b.getBoundingClientRect();
    const across = Math.min(one.right, other.right) - Math.max(one.left, other.left);
    const down = Math.min(one.bottom, other.bottom) - Math.max(one.top, other.top);
    if (across > 1 && down > 1) out.push(`${named(a)} lies over ${named(b)}`);
  }
}
if (wide > innerWidth) out.push(`wider than the window: ${wide}`);
return out;
"""


At = Callable[[str], object]


class Walker(Visitor):
    """A person before the page."""

    def text(self, selector: str) -> str:
        """Also of what is hidden, or drawn again at this moment."""
        return str(self.script("return document.querySelector(arguments[0])?.textContent ?? ''", selector))

    def press(self, name: str) -> None:
        """A button, once it can be pressed."""
        script = (
            "const b = document.querySelector(arguments[0]); if (!b || b.disabled) return false; b.click(); return true"
        )
        self.wait(lambda: self.script(script, f"#do-{name}"), f"the button {name}")

    def fill(self, **values: str) -> None:
        """Fields of the step, as typing does."""
        for name, value in values.items():
            self.script(
                "const i = document.querySelector(`[name=${arguments[0]}]`); i.value = arguments[1];"
                "i.dispatchEvent(new Event('input', {bubbles: true}))", name, value,
            )  # fmt: skip

    def go(self, step: str) -> None:
        """To a step of the list."""
        self.script("document.querySelector(`[data-step=${arguments[0]}]`).click()", step)

    def progress(self, step: str) -> str:
        return str(self.script("return document.querySelector(`[data-step=${arguments[0]}]`).dataset.progress", step))

    def done(self, step: str) -> None:
        """Wait until this step is."""
        rest = "return document.body.dataset.busy === 'false'"
        self.wait(lambda: self.progress(step) == "done" and self.script(rest), f"{step}")

    def refused(self, *words: str) -> None:
        """Wait for one line on the page that says these."""
        bad = "return document.querySelector('#status').dataset.kind === 'bad'"
        self.wait(lambda: self.script(bad) and all(word in self.text("#status") for word in words), " ".join(words))
        assert "\n" not in self.text("#status") and "Traceback" not in self.text("#status")

    def on_page(self, selector: str) -> None:
        self.wait(lambda: self.script("return Boolean(document.querySelector(arguments[0]))", selector), selector)

    def sized(self, width_px: int, height_px: int = 900) -> None:
        """The window, as a telephone or a screen has it."""
        sizes = {"width": width_px, "height": height_px, "deviceScaleFactor": 1, "mobile": False}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", sizes)
        self.driver.execute_async_script("requestAnimationFrame(() => requestAnimationFrame(arguments[0]))")

    def ugly(self) -> list[str]:
        """What doesn't fit at some width, or lies over something else."""
        out = []
        for width_px in WIDTHS:
            self.sized(width_px)
            out += [f"{width_px} px: {fault}" for fault in self.script(_CONTROLS)]
        self.sized(1400)
        return out


def walk(visitor: Walker, user: new_user.NewUser, at: At) -> None:
    """With a gripper that is inferred from the plate, to a monitor that has seen all images; ``at`` hears the name of
    each step done.
    """
    folder, rng = user.folder, np.random.default_rng(4)
    clicks = user.rough_px(rng, off_px=4.0)
    _camera_and_target(visitor, folder / "work", at)
    visitor.fill(plate_source=str(folder / "plate"))
    _take_all(visitor, "12 taken")
    at("plate")
    visitor.press("on")
    visitor.fill(model="paper")
    _do(visitor, "intrinsics", at)
    visitor.fill(jaw_range="0:0.06")
    _do(visitor, "gripper", at)
    visitor.fill(standing_source=str(folder / "standing"))
    _take_all(visitor, "3 taken")
    at("standing")
    visitor.press("on")
    _by_hand(visitor, {name: (float(u), float(v)) for name, (u, v) in clicks.items()}, at, "corners")
    visitor.done("corners")
    visitor.press("on")
    _do(visitor, "reference", at)
    _work_to_the_end(visitor, at)


def walk_with_a_model(
    visitor: Walker,
    work: Path,
    camera: Path,
    gripper: Mapping[str, str],
    reference: Mapping[str, str],
    at: At,
    **teaching: object,
) -> None:
    """The same with a lens from a file and a gripper from CAD or images: nothing stands on the target.

    ``gripper`` and ``reference``: what is said in these steps, of the latter nothing where it comes with the gripper;
    ``teaching`` as for the last steps.
    """
    _camera_and_target(visitor, work, at)
    visitor.go("intrinsics")
    visitor.fill(intrinsics_by="a file")
    visitor.fill(camera_file=str(camera))
    _do(visitor, "intrinsics", at)
    for name, value in gripper.items():
        visitor.fill(**{name: value})
    _do(visitor, "gripper", at)
    if reference:
        for name, value in reference.items():
            visitor.fill(**{name: value})
        visitor.press("step")
        visitor.wait(lambda: visitor.progress("standing") == "skipped", "a reference of another kind")
        visitor.press("on")
        _do(visitor, "reference", at)
    _work_to_the_end(visitor, at, **teaching)  # type: ignore[arg-type]


def _camera_and_target(visitor: Walker, work: Path, at: At) -> None:
    visitor.fill(source=str(work), robot="arm1")
    _do(visitor, "camera", at)
    _do(visitor, "target", at)


def _do(visitor: Walker, step: str, at: At) -> None:
    """A step, and on to the next one."""
    visitor.press("step")
    visitor.done(step)
    at(step)
    visitor.press("on")


def _work_to_the_end(visitor: Walker, at: At, *, opening_mm: str = "", taught: bool = True) -> None:
    """An image at work, teaching on it, forecast, and the monitor until the images end."""
    visitor.press("step")
    visitor.wait(lambda: "ready to be taken" in visitor.text("#status"), "the first image")
    visitor.press("take")
    visitor.wait(lambda: "1 taken" in visitor.text("#status"), "the image")
    at("teaching")
    visitor.press("stop")
    visitor.press("on")
    _by_hand(visitor, {}, at, "teach", opening_mm=opening_mm, taught=taught)
    visitor.done("teach")
    visitor.press("on")
    _do(visitor, "check", at)
    visitor.press("step")
    visitor.wait(lambda: visitor.script("return document.querySelector('#shown')?.naturalWidth > 0"), "the overlay")
    at("running")
    visitor.wait(lambda: "stopped after" in visitor.text("#log") and "ended" in visitor.text("#status"), "the end")
    at("run")


def _take_all(visitor: Walker, words: str) -> None:
    visitor.press("step")
    visitor.press("by-itself")
    visitor.wait(lambda: "no more images" in visitor.text("#status") and words in visitor.text("#status"), words)


def _by_hand(
    visitor: Walker,
    corners: dict[str, tuple[float, float]],
    at: At,
    name: str,
    *,
    opening_mm: str = "",
    taught: bool = True,
) -> None:
    """On the teaching page, and back."""
    visitor.press("step")
    visitor.on_page("#stage")
    visitor.wait(lambda: visitor.script("return document.body.dataset.ready === 'true'"), "the page to begin")
    visitor.settle()
    visitor.put(corners)
    if opening_mm:
        typed = "const i = document.querySelector('#opening'); i.value = arguments[0];"
        visitor.script(f"{typed} i.dispatchEvent(new Event('change'))", opening_mm)
        visitor.settle()
    at(name)
    if not taught:
        visitor.click("#save-taught")
    visitor.click("#save")
    visitor.wait(lambda: "next:" in visitor.text("#saved"), "the files")
    visitor.click("#done")
    visitor.on_page("#steps [data-step]")
    visitor.wait(lambda: visitor.script("return document.body.dataset.ready === 'true'"), "the page again")


def _draw(driver: Any, folder: Path, go: Callable[[Walker, At], None], **names: str) -> None:
    """Pictures of the page after these steps, by the names of their files."""
    out = ROOT / "docs" / "tutorials"
    wait_for_default_port()
    with page(folder, command=("setup",)) as running:
        visitor = Walker(driver, running.url)

        def at(step: str) -> None:
            if step not in names:
                return
            visitor.sized(WIDE, 760)
            time.sleep(0.5)
            height = visitor.script("return document.documentElement.scrollHeight")
            visitor.sized(WIDE, min(int(height), 1300))
            time.sleep(0.5)
            visitor.script("const f = document.querySelector('#folder'); if (f) f.textContent = '\\u200e/home/me/arm1'")
            shown = cv2.imdecode(np.frombuffer(driver.get_screenshot_as_png(), np.uint8), cv2.IMREAD_COLOR)
            cv2.imwrite(str(out / f"{names[step]}.jpg"), shown, [cv2.IMWRITE_JPEG_QUALITY, 70])
            visitor.sized(1400)

        go(visitor, at)


def main() -> None:
    """Draw the pictures."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.path.insert(0, str(ROOT / "tools"))  # of rounded fingers
    from support.other_grippers import rounded_tips

    driver = browser()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # Paths as someone types them beside the project.
        user = replace(new_user.make(folder), folder=Path(".."))
        shown = {step: f"setup_{step}" for step in ("plate", "corners", "check", "run")}
        _draw(driver, folder / "arm1", lambda visitor, at: walk(visitor, user, at), **shown)
        (folder / "round").mkdir()
        rounded_tips(folder / "round")
        work, camera = Path("../round/work"), Path("../arm1/camera.yaml")
        answers = {"gripper": "from images", "free_images": "../round/free", "distance": "0.115:0.0001"}

        def go(visitor: Walker, at: At) -> None:
            walk_with_a_model(visitor, work, camera, answers, {}, at)

        _draw(driver, folder / "arm2", go, gripper="setup_from_images", teach="setup_round")
    driver.quit()


if __name__ == "__main__":
    main()
