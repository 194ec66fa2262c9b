"""A page: one drawing, the clock's controls and the plots; a live team and a recorded run add theirs."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
import viser

from triform.figures.style import BLUE, rgb
from triform.simulation import Arena, Footprint, Profile
from triform.types import TriformError
from triform.viewer.formation import Course, Picture
from triform.viewer.plots import Plots, legend_html, status_html
from triform.viewer.scene import FIELD_OF_VIEW, Drawing, Margins, view_of
from triform.viewer.sensing import Sensing
from triform.viewer.session import SPEEDS

#: Pictures and numbers per second.
_PICTURES, _NUMBERS = 25.0, 3.0
#: How long a refusal stays [s].
_SHOWN = 8.0
#: Widths of the panels and their gap to the edge of the window [pixels].
_LEFT, _RIGHT, _GAP = 280, 310, 12
#: Windows that are not wider have panels below, over a share of them, and others only one at the right [pixels].
_NARROW, _BELOW, _WIDE = 576, 0.46, 1000
#: A narrow window has all its width for the panel, which viser makes 20 em wide and 60 % high.
_SHEET = f"""<style>@media (max-width: {_NARROW}px) {{
[style*="width: 20em"] {{ width: 100vw !important; }}
[style*="max-height: 60%"] {{ max-height: {100 * _BELOW:g}% !important; }}
}}</style>"""


class Source(Protocol):
    """What a page shows: a live team or a recorded run."""

    speed: float

    @property
    def paused(self) -> bool:
        """Whether time stands still."""
        ...

    def pause(self, paused: bool = True) -> None:
        """Let time stand still, or go on."""
        ...

    def step(self) -> None:
        """Let time stand still after one more record."""
        ...

    def reset(self) -> None:
        """Begin anew."""
        ...

    def picture(self) -> Picture:
        """Return what is to be drawn now."""
        ...

    def course(self) -> Course:
        """Return how it went up to now."""
        ...


class Stage(NamedTuple):
    """What stays the same while robots move.

    Attributes:
        outlines: Outline of all robots, or of each.
        arena: Walls and pillars.
        distance: Prescribed neighbour distance d* [m].
        profiles: What the robots are, if it is known.
    """

    outlines: Footprint | tuple[Footprint, ...]
    arena: Arena
    distance: float
    profiles: tuple[Profile, ...] = ()


class Page:
    """The same page in every browser that opens it.

    Attributes:
        drawing: What is drawn.
    """

    def __init__(self, server: viser.ViserServer, source: Source, stage: Stage) -> None:
        """Build the page; it shows something once it is drawn.

        Args:
            server: Its server.
            source: What it shows.
            stage: Where.
        """
        self._server, self._source, self._stage = server, source, stage
        self._next_numbers = 0.0
        self._shown: tuple[object, ...] = ()
        # The button that shares a page sends it past this computer.
        red, green, blue = rgb(BLUE).tolist()
        server.gui.configure_theme(
            control_layout="floating", show_logo=False, show_share_button=False, brand_color=(red, green, blue)
        )
        self.drawing = self._new_drawing()
        server.gui.add_html(_SHEET)
        server.gui.main_panel.float(x=-_GAP, y=_GAP, width=_RIGHT)
        self._status = server.gui.add_html("")
        self._add_clock()
        self._build()
        server.gui.add_html(legend_html())
        self._under, plots = self._add_panel("Plots", "chart-line", y=-_GAP)
        with plots:
            self._plots = Plots(server.gui, stage.distance)
        server.on_client_connect(self._aim)

    def _add_panel(self, title: str, icon: viser.IconName, y: float) -> tuple[viser.PanelHandle, viser.GuiTabHandle]:
        """Add a panel at the left, at a height [pixels] from above, or a negative one from below."""
        panel = self._server.gui.add_panel()
        tab = panel.add_tab(title, icon)
        panel.float(x=_GAP, y=y, width=_LEFT)
        return panel, tab

    def run(self, stopped: Callable[[], bool]) -> None:
        """Draw until there is reason to stop."""
        due = time.monotonic()
        while not stopped():
            self.draw()
            due = max(due + 1 / _PICTURES, time.monotonic())
            time.sleep(max(0.005, due - time.monotonic()))

    def draw(self) -> None:
        """Draw what there is now; numbers less often."""
        if not self._server.get_clients():
            return
        picture = self._source.picture()
        stage = self._current_stage()
        with self._server.atomic():
            if stage != self._stage:
                self._stage = stage
                self._plots.distance = stage.distance
                self.drawing = self._new_drawing()
            picked, sensing = self._sensing()
            shown = (self.drawing, picture.formation, picture.poses.tobytes(), picked)
            # Browsers draw only what has changed.
            if shown != self._shown:
                self._shown = shown
                if self.drawing.show(picture, picked, sensing):
                    self._connect_bodies()
            if time.monotonic() >= self._next_numbers:
                self._next_numbers = time.monotonic() + 1 / _NUMBERS
                self._status.content = status_html(picture.formation, self._source.speed, self._source.paused)
                self._plots.show(self._source.course())
                self._pause.label = "Run" if self._source.paused else "Pause"
                self._show_numbers(picture, sensing)

    def refusing(self, act: Callable[[], object], client: viser.ClientHandle | None) -> bool:
        """Do something that people asked for; if it is refused say why to them, or to all, and return ``False``."""
        try:
            act()
        except TriformError as error:
            self.say(str(error), client)
            return False
        return True

    def say(self, sentence: str, client: viser.ClientHandle | None = None) -> None:
        """Show a sentence in one browser, or in all."""
        for each in self._server.get_clients().values() if client is None else [client]:
            each.add_notification("Not done", sentence, auto_close_seconds=_SHOWN, color="red")

    def _add_clock(self) -> None:
        gui, source = self._server.gui, self._source
        self._pause = gui.add_button("Pause", icon="player-play")
        clock = gui.add_button_group("time", ("step", "reset"))
        speed = gui.add_dropdown("speed", [f"x {each:g}" for each in SPEEDS], initial_value=f"x {source.speed:g}")
        self._pause.on_click(lambda _: source.pause(not source.paused))

        clock.on_click(lambda event: self._press(event.target.value, event.client))
        speed.on_update(lambda event: setattr(source, "speed", float(event.target.value.removeprefix("x "))))

    def _press(self, name: str, client: viser.ClientHandle | None) -> None:
        self.refusing(self._source.step if name == "step" else self._source.reset, client)

    def _new_drawing(self) -> Drawing:
        return Drawing(self._server.scene, *self._stage)

    def _aim(self, client: viser.ClientHandle) -> None:
        """Let a browser that has just opened the page see all robots, beside the panel."""
        poses = self._source.picture().poses
        camera = client.camera
        camera.fov = FIELD_OF_VIEW
        width = camera.image_width
        left, right = (_LEFT + _GAP) * (width > _WIDE), (_RIGHT + _GAP) * (width > _NARROW)
        margins = Margins(left / width, right / width, 0.0 if width > _NARROW else _BELOW)
        camera.position, camera.look_at = view_of(poses[:, :2], self._stage.arena, camera.aspect, margins)

    def _build(self) -> None:
        """Add what this kind of page has besides."""

    def _current_stage(self) -> Stage:
        return self._stage

    def _sensing(self) -> tuple[int | None, Sensing | None]:
        """Return the robot that is picked, and what it sees."""
        return None, None

    def _connect_bodies(self) -> None:
        """Let people click on bodies that have just been made."""

    def _show_numbers(self, picture: Picture, sensing: Sensing | None) -> None:
        """Show what this kind of page has besides."""


def floor_point(origin: tuple[float, ...], direction: tuple[float, ...]) -> tuple[float, float] | None:
    """Return where a ray meets the floor [m]; ``None`` if it does not."""
    if direction[2] >= 0 or origin[2] <= 0:
        return None
    point = np.array(origin) + np.array(direction) * (-origin[2] / direction[2])
    return float(point[0]), float(point[1])
