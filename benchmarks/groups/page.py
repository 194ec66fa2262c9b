"""The live page with 100 robots: what its server computes, and what a real browser receives."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Iterator

import numpy as np
from playwright.sync_api import sync_playwright

from benchmarks.report import Aim, Row
from benchmarks.settings import Settings, Watch
from benchmarks.timing import Spread
from triform.control import ControllerSpec
from triform.evaluation.scenario import Scenario
from triform.types import TriformError
from triform.viewer.live import LivePage
from triform.viewer.server import close_server, open_server
from triform.viewer.session import Session, Setup

_ROBOTS = 100
#: A message of a picture is longer; others tell of single controls [bytes].
_PICTURE = 2000
#: Counts the pictures that a browser draws.
_COUNT = "() => { shown = 0; const count = () => { shown++; requestAnimationFrame(count); }; count(); }"
_FLAGS = ("--no-sandbox", "--no-first-run", "--enable-unsafe-swiftshader", "--use-angle=swiftshader")


def measure(settings: Settings, watch: Watch) -> Iterator[Row]:
    """Processor time of a picture and of a control period, then pictures per second and the pace of time."""
    session = Session(Setup(Scenario(), ControllerSpec("policy"), _ROBOTS, 7), settings.cores)
    server = open_server("127.0.0.1", 8590, "triform")
    try:
        page = LivePage(server, session)
        turns = 5 if settings.quick else 100
        steps, pictures = np.empty(turns), np.empty(turns)
        for turn in range(turns):
            watch("steps and pictures", turn, turns)
            began = time.process_time()
            session.step()
            between = time.process_time()
            page.drawing.show(session.picture())
            steps[turn], pictures[turn] = between - began, time.process_time() - between
        period = 1000 * session.period
        yield Row(
            f"one control period of {_ROBOTS} robots with the default policy, processor time",
            Spread.of(1000 * steps, "ms"),
            Aim("<=", period),
            note=f"World, policy and measures; the clock allows {period:g} ms.",
        )
        yield Row(
            f"one picture of {_ROBOTS} robots, from the team to the messages, processor time",
            Spread.of(1000 * pictures, "ms"),
            Aim("<=", 50.0),
            note="20 pictures a second leave 50 ms.",
        )
        yield from _received(page, session, f"http://127.0.0.1:{server.get_port()}", 3.0 if settings.quick else 20.0)
    finally:
        close_server(server)


def _received(page: LivePage, session: Session, address: str, seconds: float) -> Iterator[Row]:
    """Let a browser watch the team for a while."""
    chromium = shutil.which("chromium")
    if chromium is None:
        raise TriformError("there is no chromium to watch the page")
    stopped, sizes = threading.Event(), list[int]()
    drawing = threading.Thread(target=page.run, args=(stopped.is_set,))
    drawing.start()
    # Steps by hand have paused it.
    session.pause(False)
    session.start()
    try:
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=chromium, args=_FLAGS)
            tab = browser.new_page(viewport={"width": 1280, "height": 800})
            tab.set_default_timeout(180_000)
            tab.on("websocket", lambda socket: socket.on("framereceived", lambda data: sizes.append(len(data))))
            tab.goto(address)
            tab.get_by_role("button", name="Pause", exact=True).wait_for()
            tab.evaluate(_COUNT)
            sizes.clear()
            began, simulated = time.perf_counter(), session.picture().formation.time
            shown = tab.evaluate("shown")
            tab.wait_for_timeout(1000 * seconds)
            shown = tab.evaluate("shown") - shown
            took = time.perf_counter() - began
            pictures = sum(size > _PICTURE for size in sizes)
            pace = (session.picture().formation.time - simulated) / took
            browser.close()
    finally:
        stopped.set()
        drawing.join()
        session.stop()
    yield Row(
        f"pictures of {_ROBOTS} robots that a browser receives per second",
        Spread.once(pictures / took, "1/s"),
        Aim(">=", 20.0),
        sides={"drawn by the browser": Spread.once(shown / took, "1/s")},
        note="Chromium on the same cores, drawing without a graphics card; a browser elsewhere draws on its own.",
    )
    yield Row(
        f"time of {_ROBOTS} robots over that of the clock, while the browser watches",
        Spread.once(pace, ""),
        Aim(">=", 0.98),
        note="At speed x 1.",
    )
