"""The page in a real browser: open it, press, pick, add, remove, drag; a page without a server opens as a file.

Browsers draw without a graphics card here, so pages are small, and time stands still while one looks.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from triform.cli import main
from triform.control import ControllerSpec
from triform.evaluation.scenario import Scenario
from triform.types import TriformError
from triform.viewer.session import Session, Setup

NEEDED = importlib.util.find_spec("viser") and importlib.util.find_spec("playwright") and shutil.which("chromium")
if not NEEDED:
    if "TRIFORM_REQUIRE_BROWSER" in os.environ:
        pytest.fail("there is no viser, Playwright or Chromium, and TRIFORM_REQUIRE_BROWSER is set", pytrace=False)
    pytest.skip("needs viser, Playwright and Chromium", allow_module_level=True)

from playwright.sync_api import Browser, sync_playwright  # noqa: E402
from playwright.sync_api import Page as Tab  # noqa: E402

from triform.viewer.film import FilmPage  # noqa: E402
from triform.viewer.live import LivePage  # noqa: E402
from triform.viewer.page import Stage  # noqa: E402
from triform.viewer.playback import Playback  # noqa: E402
from triform.viewer.server import close_server, open_server  # noqa: E402

WINDOW = {"width": 900, "height": 600}
#: Browsers are slow without a graphics card on a busy machine [s].
PATIENCE = 90.0
FLAGS = (
    "--no-sandbox", "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--no-first-run", "--enable-unsafe-swiftshader", "--use-angle=swiftshader",
)  # fmt: skip


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        yield chromium
        chromium.close()


class Tabs:
    """Opens tabs, and knows what went wrong in them."""

    def __init__(self, browser: Browser) -> None:
        self.browser, self.errors = browser, []

    def open(self, address: str) -> Tab:
        tab = self.browser.new_page(viewport=WINDOW)
        tab.set_default_timeout(1000 * PATIENCE)
        tab.on("console", lambda message: self.errors.append(message.text) if message.type == "error" else None)
        tab.on("pageerror", lambda error: self.errors.append(str(error)))
        tab.goto(address)
        return tab


@pytest.fixture
def tabs(browser: Browser) -> Iterator[Tabs]:
    opened = Tabs(browser)
    yield opened
    for context in browser.contexts:
        context.close()
    assert opened.errors == []


def wait_for(happened: Callable[[], Any], tab: Tab) -> None:
    deadline = time.monotonic() + PATIENCE
    while not happened():
        assert time.monotonic() < deadline
        tab.wait_for_timeout(50)


@pytest.fixture
def live() -> Iterator[tuple[Session, str]]:
    session = Session(Setup(Scenario(), ControllerSpec("expert"), 4, 7), 1)
    session.pause()
    server = open_server("127.0.0.1", 8530, "triform")
    page, stopped = LivePage(server, session), threading.Event()
    drawing = threading.Thread(target=page.run, args=(stopped.is_set,))
    drawing.start()
    session.start()
    yield session, f"http://127.0.0.1:{server.get_port()}"
    assert drawing.is_alive()
    stopped.set()
    drawing.join()
    session.stop()
    close_server(server)


def test_people_reach_into_a_live_team(live: tuple[Session, str], tabs: Tabs) -> None:
    session, address = live
    tab = tabs.open(address)
    button = functools.partial(tab.get_by_role, "button", exact=True)
    # Pressing: one step, and then time goes on.
    button(name="step").click()
    wait_for(lambda: session.picture().formation.time > 0, tab)
    assert session.picture().formation.time == pytest.approx(session.period)
    button(name="Run").click()
    wait_for(lambda: session.picture().formation.time > 2 * session.period, tab)
    session.pause()
    # A good value is taken; a bad one is refused in a sentence and the team goes on as it was.
    field = tab.get_by_label("robots", exact=True)
    field.fill("6")
    field.press("Enter")
    wait_for(lambda: session.setup.robots == 6, tab)
    field.fill("0")
    field.press("Enter")
    tab.get_by_text("robots is 0; a page shows 1 to 300").first.wait_for()
    assert session.setup.robots == 6
    # A robot is added by a click on the floor.
    button(name="Add a robot").click()
    tab.get_by_text("Click on the floor where the new robot shall be.").wait_for()
    tab.mouse.click(60, 560)
    wait_for(lambda: len(session.picture().formation.robots) == 7, tab)
    tab.screenshot(timeout=1000 * PATIENCE)


def test_a_closed_tab_harms_nothing(live: tuple[Session, str], tabs: Tabs) -> None:
    session, address = live
    first, second = tabs.open(address), tabs.open(address)
    for tab in (first, second):
        tab.get_by_role("button", name="Run", exact=True).wait_for()
    first.close()
    second.get_by_role("button", name="step", exact=True).click()
    wait_for(lambda: session.picture().formation.time > 0, second)


def test_a_page_without_a_server_plays_a_run(tmp_path: Path, tabs: Tabs) -> None:
    path = tmp_path / "run.html"
    options = ["--robots", "3", "--duration", "5", "--controller", "expert", "--html", str(path)]
    assert main(["view", *options]) == 0
    assert path.stat().st_size < 1_500_000
    tab = tabs.open(path.as_uri())
    tab.locator("canvas").first.wait_for()
    moment = tab.locator("input").first
    wait_for(lambda: float(moment.input_value() or 0.0) > 0.5, tab)
    asked: list[str] = []
    tab.on("request", lambda request: asked.append(request.url))
    tab.wait_for_timeout(1000)
    assert [url for url in asked if not url.startswith(("data:", "blob:"))] == []


def test_the_time_bar_of_a_recorded_run_follows_it(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = Scenario(duration=6.0, arena="room-6")
    trajectory, _ = scenario.run(scenario.sample_starts(4, 1, 7), "expert", 7, [0])
    now = [0.0]
    playback = Playback(trajectory, clock=lambda: now[0])
    server = open_server("127.0.0.1", 8560, "triform")
    try:
        stage = Stage(scenario.team.outlines(4), scenario.surroundings, 1.0, scenario.team.profiles)
        page = FilmPage(server, playback, stage, "run 1")
        monkeypatch.setattr(server, "get_clients", lambda: {0: None})
        now[0] = 2.5
        page.draw()
        assert page._bar.value == pytest.approx(2.5)
    finally:
        close_server(server)


def test_an_address_that_this_computer_has_not_is_refused() -> None:
    with pytest.raises(TriformError, match=r"no page can be served at '192\.0\.2\.1'"):
        open_server("192.0.2.1", 8540, "triform")


def test_a_hundred_robots_are_drawn_many_times_a_second() -> None:
    session = Session(Setup(Scenario(), ControllerSpec("expert"), 100, 7), 1)
    server = open_server("127.0.0.1", 8550, "triform")
    try:
        page = LivePage(server, session)
        for _ in range(3):
            session.step()
        times = []
        for _ in range(20):
            began = time.process_time()
            page.drawing.show(session.picture())
            times.append(time.process_time() - began)
        # 20 pictures a second leave 50 ms for each.
        assert np.median(times) < 0.05
    finally:
        close_server(server)
