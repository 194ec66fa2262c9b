"""The page of a live team: pause it, change it, add, remove and drag robots, and see what one of them sees."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import viser

from triform.control import CONTROLLERS, shipped_weights
from triform.control.user import installed_controllers
from triform.policy import read_spec
from triform.simulation import ARENAS, PROFILES
from triform.viewer.formation import Picture
from triform.viewer.page import Page, Stage, floor_point
from triform.viewer.plots import map_html, map_image, sensing_html, text_html
from triform.viewer.sensing import Sensing
from triform.viewer.session import Session

_NOBODY = "none"
#: Gap of the panel of a picked robot to the upper edge of the window [pixels].
_ABOVE = 12
_NOISES: dict[str, float | None] = {"of the profile": None, "none": 0.0, "1 cm": 0.01, "3 cm": 0.03, "10 cm": 0.1}


class LivePage(Page):
    """A page over a session."""

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        """Build the page of a session."""
        self._session = session
        self._picked: int | None = None
        self._adding = False
        self._clicked: tuple[float, float] | None = None
        super().__init__(server, session, self._current_stage())

    def _current_stage(self) -> Stage:
        scenario = self._session.setup.scenario
        return Stage(self._session.outlines, scenario.surroundings, scenario.distance, scenario.team.profiles)

    def _build(self) -> None:
        gui, setup = self._server.gui, self._session.setup
        scenario = setup.scenario
        with gui.add_folder("Team"):
            self._add_setting("robots", gui.add_number("robots", setup.robots, step=1))
            self._add_setting("seed", gui.add_number("seed", setup.seed, step=1))
            self._add_setting("distance", gui.add_number("d* [m]", scenario.distance, step=0.05))
            self._add_choice("controller", _controllers(), setup.controller.label)
            self._add_choice("profile", PROFILES, scenario.profile)
            self._add_choice("arena", ARENAS, scenario.arena)
            noise = scenario.overrides.range_noise
            named = next((name for name, value in _NOISES.items() if value == noise), f"{noise} m")
            self._noises = {**_NOISES, named: noise}
            self._add_choice("range_noise", self._noises, named, self._noises.__getitem__)
        with gui.add_folder("Robots"):
            hint = "then click on the floor where it shall be"
            add = gui.add_button("Add a robot", icon="plus", hint=hint)
            self._remove = gui.add_button("Remove the picked robot", icon="minus", disabled=True)
            self._help = gui.add_html(text_html("Click a robot to see what it sees; drag it away and let go."))
            self._pick = gui.add_dropdown("picked", (_NOBODY, *map(str, range(setup.robots))))
        self._robot, tab = self._add_panel("What it sees", "eye", y=_ABOVE)
        self._robot.visible = False
        with tab:
            self._told = gui.add_html("")
            self._map = gui.add_image(np.full((3, 3, 3), 255, dtype=np.uint8), format="png")
            self._map_told = gui.add_html("")
        add.on_click(lambda _: self._arm(not self._adding))
        self._remove.on_click(lambda event: self._remove_picked(event.client))

        self._pick.on_update(self._choose_named)
        self._server.scene.on_click()(self._click_floor)

    def _add_choice(self, name: str, options: Any, value: str, read: Callable[[str], Any] = str) -> None:
        """Add a choice of a setting, among them the present one."""
        label = name.replace("_", " ")
        every = list(dict.fromkeys((*options, value)))
        self._add_setting(name, self._server.gui.add_dropdown(label, every, initial_value=value), read)

    def _add_setting(self, name: str, handle: Any, read: Callable[[Any], Any] = lambda value: value) -> None:
        """Let a control change a setting of the session, and show the old value again if that is refused."""
        good = [handle.value]

        def change(event: Any) -> None:
            if event.client is None:
                return
            value = event.target.value
            if self.refusing(lambda: self._session.change(**{name: read(value)}), event.client):
                good[0] = value
            else:
                event.target.value = good[0]

        handle.on_update(change)

    def _choose_named(self, event: Any) -> None:
        """Pick the robot that people chose by its number."""
        if event.client is not None:
            self._choose(None if event.target.value == _NOBODY else int(event.target.value))

    def _arm(self, adding: bool) -> None:
        """Let the next click on the floor add a robot, or not."""
        self._adding = adding
        said = "Click on the floor where the new robot shall be." if adding else (
            "Click a robot to see what it sees; drag it away and let go."
        )  # fmt: skip
        self._help.content = text_html(said)

    def _click_floor(self, event: viser.SceneClickEvent) -> None:
        # A click on a robot is one on the scene as well.
        if event.screen_pos == self._clicked or not self._adding:
            return
        point = floor_point(event.ray_origin, event.ray_direction)
        if point is not None and self.refusing(lambda: self._session.add(*point), event.client):
            self._arm(False)

    def _remove_picked(self, client: viser.ClientHandle | None) -> None:
        picked = self._picked
        if picked is not None and self.refusing(lambda: self._session.remove(picked), client):
            self._choose(None)

    def _choose(self, robot: int | None) -> None:
        """Pick a robot, or none."""
        self._picked = robot
        self._remove.disabled = robot is None
        if self._robot.visible != (robot is not None):
            self._robot.visible = robot is not None
            # Low windows have no height for both at the left; people open what they like again.
            (self._under.expand if robot is None else self._under.minimize)()
        shown = _NOBODY if robot is None else str(robot)
        if shown in self._pick.options:
            self._pick.value = shown

    def _connect_bodies(self) -> None:
        for handle, robots in self.drawing.bodies:
            handle.on_click(partial(self._click_body, robots))
            handle.on_drag("left")(partial(self._drag_body, robots))

    def _click_body(self, robots: Any, event: Any) -> None:
        self._clicked = event.screen_pos
        robot = int(robots[event.instance_index or 0])
        self._choose(None if robot == self._picked else robot)

    def _drag_body(self, robots: Any, event: Any) -> None:
        robot = int(robots[event.instance_index or 0])
        if event.phase == "end":
            self._session.release(robot)
            return
        origin = tuple(event.client.camera.position)
        point = floor_point(origin, tuple(np.array(event.end_position) - origin))
        if point is not None:
            # Ways over others and walls are no mistakes: the robot waits before them.
            self._session.drag(robot, *point, strictly=False)

    def _sensing(self) -> tuple[int | None, Sensing | None]:
        picked = self._picked
        return picked, None if picked is None else self._session.sensing(picked)

    def _show_numbers(self, picture: Picture, sensing: Sensing | None) -> None:
        problem = self._session.problem()
        if problem:
            self.say(problem)
        options = (_NOBODY, *map(str, picture.formation.robots.tolist()))
        if self._pick.options != options:
            value = self._pick.value
            self._pick.options = options
            if value not in options:
                self._choose(None)
        if sensing is None or self._picked is None:
            return
        self._told.content = sensing_html(self._picked, sensing)
        reading = sensing.reading
        self._map.visible = self._map_told.visible = reading is not None
        if reading is not None:
            self._map.image = map_image(reading, self.drawing.colours(picture.trail.shape[1])[self._picked])
            self._map_told.content = map_html(reading)


def _controllers() -> list[str]:
    """Controllers that a page offers: by name, and shipped policies."""
    policies = [name for name, folder in shipped_weights().items() if hasattr(read_spec(folder).network, "patch")]
    names = [name for name in (*CONTROLLERS, *installed_controllers()) if name != "policy"]
    return ["policy", *(f"policy:{name}" for name in policies), *names]
