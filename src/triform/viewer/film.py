"""The page of a recorded run: a time bar."""

from __future__ import annotations

from typing import Any

import viser

from triform.viewer.formation import Picture
from triform.viewer.page import Page, Stage
from triform.viewer.playback import Playback
from triform.viewer.plots import text_html
from triform.viewer.sensing import Sensing


class FilmPage(Page):
    """A page over a playback."""

    def __init__(self, server: viser.ViserServer, playback: Playback, stage: Stage, label: str) -> None:
        """Build the page of a run that is called ``label``."""
        self._playback, self._label = playback, label
        super().__init__(server, playback, stage)

    def _build(self) -> None:
        gui, playback = self._server.gui, self._playback
        gui.add_html(text_html(self._label))
        end = round(playback.duration, 2)
        self._bar = gui.add_slider("moment [s]", 0.0, end, 0.01, 0.0)
        self._bar.on_update(self._wind)

    def _wind(self, event: Any) -> None:
        """Go to the moment that people chose."""
        if event.client is not None:
            moment = min(float(event.target.value), self._playback.duration)
            self.refusing(lambda: self._playback.seek(moment), event.client)

    def _show_numbers(self, picture: Picture, sensing: Sensing | None) -> None:  # noqa: ARG002
        self._bar.value = round(self._playback.now, 2)
