"""The page in a real browser: open it, press, pick, add, remove, drag; a page without a server opens as a file.

Browsers draw without a graphics card here, so pages are small, and time stands still while one looks.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
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

from playwright.sync_api import Browser, ConsoleMessage, sync_playwright  # noqa: E402
from playwright.sync_api import Page as Tab  # noqa: E402

from triform.viewer.film import FilmPage  # noqa: E402
from triform.viewer.formation import Formation  # noqa: E402
from triform.viewer.live import LivePage  # noqa: E402
from triform.viewer.page import Stage  # noqa: E402
from triform.viewer.playback import Playback  # noqa: E402
from triform.viewer.server import close_server, open_server  # noqa: E402

WINDOW = {"width": 800, "height": 480}
PHONE = {"width": 390, "height": 844}
#: Browsers are slow without a graphics card on a busy machine [s].
PATIENCE = 90.0
#: What Chromium says of the library that turns viser's camera when it is busy; nothing of ours listens passively.
PASSIVE = "Unable to preventDefault inside passive event listener invocation."
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

    def open(self, address: str, window: Any = WINDOW) -> Tab:
        tab = self.browser.new_page(viewport=window)
        tab.set_default_timeout(1000 * PATIENCE)
        tab.on("console", self._note)
        tab.on("pageerror", lambda error: self.errors.append(str(error)))
        tab.goto(address)
        return tab

    def _note(self, message: ConsoleMessage) -> None:
        # viser takes back an image of which a busy browser has not loaded the last version yet.
        replaced = message.location["url"].startswith("blob:")
        if message.type == "error" and message.text != PASSIVE and not replaced:
            self.errors.append(f"{message.location['url']}: {message.text}")


@pytest.fixture
def tabs(browser: Browser) -> Iterator[Tabs]:
    opened = Tabs(browser)
    yield opened
    for context in browser.contexts:
        context.close()
    assert opened.errors == []


def press(tab: Tab, name: str) -> None:
    """Click a button, without waiting for two pictures in which it stands still, which take long here."""
    tab.get_by_role("button", name=name, exact=True).click(force=True)


def wait_for(happened: Callable[[], Any], tab: Tab) -> None:
    deadline = time.monotonic() + PATIENCE
    while not happened():
        assert time.monotonic() < deadline
        tab.wait_for_timeout(50)


class Live:
    """A live page, and where things are on it."""

    def __init__(self) -> None:
        self.session = Session(Setup(Scenario(), ControllerSpec("expert"), 4, 7), 1)
        self.session.pause()
        self.server = open_server("127.0.0.1", 8530, "triform")
        self.page, self._stopped = LivePage(self.server, self.session), threading.Event()
        self.page._under.minimize()
        self._drawing = threading.Thread(target=self.page.run, args=(self._stopped.is_set,))
        self._drawing.start()
        self.session.start()
        self.address = f"http://127.0.0.1:{self.server.get_port()}"

    @property
    def team(self) -> Formation:
        return self.session.picture().formation

    def pixel(self, point: Sequence[float], window: Any = WINDOW) -> tuple[float, float]:
        """Where the browser of a window shows a point of the floor: a pinhole camera that looks at a point, +z up."""
        shape = window["width"] / window["height"]
        cameras = [client.camera for client in self.server.get_clients().values()]
        camera = min(cameras, key=lambda camera: abs(camera.aspect - shape))
        ahead = np.array(camera.look_at) - camera.position
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        way = np.array([*point, 0.1]) - camera.position
        scale = window["height"] / (2 * np.tan(camera.fov / 2) * (way @ ahead))
        across, up = way @ right * scale, way @ np.cross(right, ahead) * scale
        return window["width"] / 2 + across, window["height"] / 2 - up

    def stop(self) -> None:
        assert self._drawing.is_alive()
        self._stopped.set()
        self._drawing.join()
        self.session.stop()
        close_server(self.server)


@pytest.fixture
def live() -> Iterator[Live]:
    page = Live()
    yield page
    page.stop()


def test_people_reach_into_a_live_team(live: Live, tabs: Tabs) -> None:
    session, tab = live.session, tabs.open(live.address)
    # Pressing: one step, and then time goes on.
    press(tab, "step")
    wait_for(lambda: live.team.time > 0, tab)
    assert live.team.time == pytest.approx(session.period)
    press(tab, "Run")
    wait_for(lambda: live.team.time > 2 * session.period, tab)
    session.pause()
    # A good value is taken; a bad one is refused in a sentence and the team goes on as it was.
    field = tab.get_by_label("robots", exact=True)
    field.fill("5")
    field.press("Enter")
    wait_for(lambda: session.setup.robots == 5, tab)
    field.fill("0")
    field.press("Enter")
    tab.get_by_text("robots is 0; a page shows 1 to 300").first.wait_for()
    assert session.setup.robots == 5
    # A robot is added by a click on the floor.
    press(tab, "Add a robot")
    tab.get_by_text("Click on the floor where the new robot shall be.").wait_for()
    middle = live.team.poses[:, :2].mean(axis=0)
    free = next(
        point
        for point in middle + np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5], [-0.5, 0.0], [0.0, -0.5]])
        if np.linalg.norm(live.team.poses[:, :2] - point, axis=1).min() > 0.5
    )
    tab.mouse.click(*live.pixel(free))
    wait_for(lambda: len(live.team.robots) == 6, tab)
    np.testing.assert_allclose(live.team.poses[5, :2], free, atol=0.1)


def test_robots_are_picked_dragged_and_removed_and_steered_by_another(live: Live, tabs: Tabs) -> None:
    session, tab = live.session, tabs.open(live.address)
    for _ in range(150):
        session.step()
    assert live.team.error < 0.1
    wait_for(lambda: bool(live.page.drawing.bodies), tab)
    tab.wait_for_timeout(1000)
    # Another controller finds the robots where they are.
    tab.get_by_label("controller", exact=True).click(force=True)
    tab.get_by_role("option", name="policy", exact=True).click(force=True)
    wait_for(lambda: session.setup.controller.name == "policy", tab)
    # A click on a robot shows what it sees.
    tab.mouse.click(*live.pixel(live.team.poses[1, :2]))
    tab.get_by_text("Robot 1").wait_for()
    tab.get_by_text("taken for a neighbour").wait_for()
    # A robot that is dragged away comes back when it is let go.
    start = live.team.poses[2, :2]
    away = start + (start - live.team.poses[:, :2].mean(axis=0)) * 0.8
    tab.mouse.move(*live.pixel(start))
    tab.mouse.down()
    for share in (0.3, 0.7, 1.0, 1.0):
        tab.mouse.move(*live.pixel(start + share * (away - start)))
        tab.wait_for_timeout(100)
    wait_for(lambda: np.linalg.norm(live.team.poses[2, :2] - away) < 0.15, tab)
    assert live.team.error > 0.1
    tab.mouse.up()
    wait_for(lambda: not session._held, tab)
    for _ in range(400):
        session.step()
    assert live.team.error < 0.1
    # The picked robot goes.
    press(tab, "Remove the picked robot")
    wait_for(lambda: live.team.robots.tolist() == [0, 2, 3], tab)
    tab.get_by_text("taken for a neighbour").wait_for(state="hidden")


def test_every_browser_sees_the_same_and_a_closed_one_harms_nothing(live: Live, tabs: Tabs) -> None:
    first, second = tabs.open(live.address), tabs.open(live.address, PHONE)
    for tab in (first, second):
        tab.get_by_role("button", name="Run", exact=True).wait_for()
    press(second, "step")
    for tab in (first, second):
        tab.get_by_text(f"{live.session.period:.1f} s").first.wait_for()
    # On a phone, the panel leaves the upper half to the robots, and is as wide as the window.
    sheet = second.locator('[style*="max-height: 60%"]').first.bounding_box()
    assert sheet is not None
    assert sheet["width"] == PHONE["width"]
    assert sheet["height"] <= 0.47 * PHONE["height"]
    places = np.array([live.pixel(pose[:2], PHONE) for pose in live.team.poses])
    assert (places > 0).all()
    assert places[:, 0].max() < PHONE["width"]
    assert places[:, 1].max() < sheet["y"]
    first.close()
    press(second, "step")
    second.get_by_text(f"{2 * live.session.period:.1f} s").first.wait_for()


def test_a_page_without_a_server_plays_a_run(tmp_path: Path, tabs: Tabs) -> None:
    path = tmp_path / "run.html"
    options = ["--robots", "3", "--duration", "5", "--controller", "expert", "--html", str(path)]
    assert main(["view", *options]) == 0
    assert path.stat().st_size < 1_500_000
    tab = tabs.open(path.as_uri())
    tab.locator("canvas").first.wait_for()
    moment = tab.locator("input").first
    wait_for(lambda: float(moment.input_value() or 0.0) > 0.5, tab)
    assert "formation error" in tab.locator("#caption").inner_text()
    asked: list[str] = []
    tab.on("request", lambda request: asked.append(request.url))
    tab.wait_for_timeout(1000)
    assert [url for url in asked if not url.startswith(("data:", "blob:"))] == []
    # On a phone, nothing is wider than the window.
    tab.set_viewport_size(PHONE)
    assert tab.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    assert tab.evaluate("document.querySelector('input').getBoundingClientRect().right") <= PHONE["width"]


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
