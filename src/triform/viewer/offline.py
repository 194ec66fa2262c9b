"""A run as one page that opens without a server and without a network."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from triform.evaluation.rollout import Trajectory
from triform.figures.runs import Scene
from triform.figures.style import GREEN
from triform.files import write_atomically
from triform.simulation import Profile
from triform.viewer.formation import Formation
from triform.viewer.playback import Playback
from triform.viewer.scene import FIELD_OF_VIEW, Drawing, view_of
from triform.viewer.server import close_server, open_server

#: The free port of the server from which a page is taken.
_PORT = 8460


def write_page(
    trajectory: Trajectory, scene: Scene, path: Path, profiles: tuple[Profile, ...] = (), title: str = "triform"
) -> Path:
    """Write the first run of a trajectory to ``path`` as a page with a time bar.

    Args:
        trajectory: The run.
        scene: Outlines, arena and prescribed distance.
        path: File to write, atomically.
        profiles: What the robots are, if it is known.
        title: Title of the page.

    Returns:
        ``path``.

    Raises:
        TriformError: The file cannot be written.
    """
    playback = Playback(trajectory, scene.distance)
    server = open_server("127.0.0.1", _PORT, title)
    try:
        drawing = Drawing(server.scene, scene.footprint, scene.arena, scene.distance, profiles)
        camera = server.initial_camera
        camera.position, camera.look_at = view_of(trajectory.positions[0], scene.arena)
        camera.fov = FIELD_OF_VIEW
        drawing.show(playback.picture_at(0.0))
        film = server.get_scene_serializer()
        for moment in playback.time.tolist():
            with server.atomic():
                drawing.show(playback.picture_at(moment))
            film.insert_sleep(playback.period)
        page = film.as_html().replace("<title>Viser</title>", f"<title>{title}</title>")
        page = page.replace("<head>", f"<head>{_upright(camera.position, camera.look_at)}{_captions(playback)}", 1)
    finally:
        close_server(server)
    write_atomically(path, page.encode())
    return path


def _upright(position: Sequence[float], look_at: Sequence[float]) -> str:
    """Return a script that takes the camera farther away where the window is higher than wide, as on a phone.

    A page of viser reads its camera from its own address.
    """
    place, target = (json.dumps([round(float(each), 4) for each in point]) for point in (position, look_at))
    return (
        f"<script>try {{ const place = {place}, target = {target}, aspect = innerWidth / innerHeight; "
        "if (aspect < 1 && !location.search) { "
        "const farther = place.map((x, k) => target[k] + (x - target[k]) / aspect); "
        "history.replaceState(null, '', `?initialCameraPosition=${farther}`); } } catch {}</script>"
    )


def _captions(playback: Playback) -> str:
    """Return a script that writes above the scene how the formation is at the moment that the time bar shows."""
    formations = [playback.picture_at(moment).formation for moment in playback.time.tolist()]
    said = json.dumps([_caption(formation) for formation in formations])
    times = json.dumps(np.round(playback.time, 3).tolist())
    return (
        f"<script>addEventListener('DOMContentLoaded', () => {{ const times = {times}, said = {said}; "
        "const line = document.createElement('div'); line.id = 'caption'; document.body.append(line); "
        "line.style = 'position:fixed;top:0;left:0;right:0;padding:14px;text-align:center;font:15px sans-serif;"
        "pointer-events:none'; "
        "setInterval(() => { const now = Number(document.querySelector('input')?.value ?? 0); "
        "line.innerHTML = said[Math.max(0, times.findLastIndex((each) => each <= now + 0.001))]; }, 100); "
        "}); </script>"
    )


def _caption(formation: Formation) -> str:
    error = "no edges" if np.isnan(formation.error) else f"formation error <b>{100 * formation.error:.0f} %</b>"
    strict = f', <b style="color:{GREEN}">strict</b>' if formation.strict else ""
    return f"{formation.time:.1f} s: {error}{strict}"
