"""A page in a headless browser: drags, clicks, drawn frames, requests and errors."""

import base64
import io
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
# Without a graphics card the browser draws in software.
_FLAGS = [
    "--no-sandbox",
    "--ignore-gpu-blocklist",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]


def why_no_browser() -> str | None:
    try:
        import playwright.sync_api  # noqa: F401, PLC0415 - may be missing
    except ImportError:
        return "playwright is not installed"
    if not any(map(shutil.which, BROWSERS)):
        return f"none of {', '.join(BROWSERS)} is installed"
    return None


@contextmanager
def open_page(url: str, width: int = 1000, height: int = 700) -> "Iterator[Page]":
    from playwright.sync_api import sync_playwright  # noqa: PLC0415

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=next(filter(None, map(shutil.which, BROWSERS))), args=_FLAGS
        )
        try:
            page = Page(browser.new_page(viewport={"width": width, "height": height}))
            page.tab.goto(url)
            yield page
        finally:
            browser.close()


class Page:
    def __init__(self, tab: Any) -> None:
        self.tab = tab
        tab.set_default_timeout(120_000)  # ms: it draws without a GPU, next to other tests
        self.requests: list[str] = []
        self.errors: list[str] = []
        tab.on("request", lambda request: self.requests.append(request.url))
        tab.on("pageerror", lambda error: self.errors.append(str(error)))
        tab.on("console", lambda said: self.errors.append(said.text) if said.type == "error" else None)
        self._frames: list[tuple[float, str]] = []
        self._session: Any = None

    def screenshot(self) -> NDArray[np.uint8]:
        return _pixels(self.tab.screenshot())

    def screenshot_of(self, selector: str) -> NDArray[np.uint8]:
        return _pixels(self.tab.locator(selector).screenshot())

    def start_recording(self) -> None:
        self._session = self.tab.context.new_cdp_session(self.tab)

        def on_frame(event: Any) -> None:
            self._frames.append((time.perf_counter(), event["data"]))
            self._session.send("Page.screencastFrameAck", {"sessionId": event["sessionId"]})

        self._session.on("Page.screencastFrame", on_frame)
        self._session.send("Page.startScreencast", {"format": "png", "everyNthFrame": 1})

    def stop_recording(self) -> list[tuple[float, NDArray[np.uint8]]]:
        self._session.send("Page.stopScreencast")
        frames, self._frames = self._frames, []
        return [(at_s, _pixels(base64.b64decode(data))) for at_s, data in frames]

    def pause(self, seconds: float) -> None:
        self.tab.wait_for_timeout(1000 * seconds)

    def wait_until(self, done: Callable[[], bool], timeout_s: float = 60.0) -> None:
        until_s = time.monotonic() + timeout_s
        while not done():
            if time.monotonic() > until_s:
                msg = f"it did not come in {timeout_s} s"
                raise TimeoutError(msg)
            self.pause(0.1)

    def settle(self, pause_s: float = 0.5) -> NDArray[np.uint8]:
        last, seen = None, self.screenshot()
        while last is None or not np.array_equal(last, seen):
            self.pause(pause_s)
            last, seen = seen, self.screenshot()
        return seen

    def drag(self, start: tuple[float, float], end: tuple[float, float], steps: int, step_s: float) -> None:
        mouse = self.tab.mouse
        mouse.move(*start)
        self.pause(step_s)
        mouse.down()
        for i in range(1, steps + 1):
            mouse.move(*(a + (b - a) * i / steps for a, b in zip(start, end, strict=True)))
            self.pause(step_s)
        mouse.up()

    def click(self, at: tuple[float, float]) -> None:
        self.tab.mouse.click(*at)

    def text(self) -> str:
        return str(self.tab.inner_text("body"))


def camera_of(server: Any, timeout_s: float = 30.0) -> Any:
    until_s = time.monotonic() + timeout_s
    while time.monotonic() < until_s:
        for client in server.get_clients().values():
            return client.camera
        time.sleep(0.05)
    msg = f"no page connected in {timeout_s} s"
    raise TimeoutError(msg)


def pixel_of(camera: Any, point: NDArray[np.float64]) -> tuple[float, float]:
    R_page_camera = Rotation.from_quat(np.roll(camera.wxyz, -1))
    right, down, forward = R_page_camera.inv().apply(point - camera.position)
    focal = camera.image_height / 2 / np.tan(camera.fov / 2)
    return (
        float(camera.image_width / 2 + focal * right / forward),
        float(camera.image_height / 2 + focal * down / forward),
    )


def drawn(frame: NDArray[np.uint8]) -> int:
    scene = frame[:, : frame.shape[1] * 2 // 3]
    return int((scene.min(axis=2) < 235).sum())


def _pixels(png: bytes) -> NDArray[np.uint8]:
    from PIL import Image  # noqa: PLC0415 - comes with viser

    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))
