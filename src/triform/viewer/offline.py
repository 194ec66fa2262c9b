"""A run as one page that opens without a server and without a network."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from triform.evaluation.rollout import Trajectory
from triform.figures.runs import Scene
from triform.files import write_atomically
from triform.simulation import Profile
from triform.viewer.formation import Picture
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
        first, place = playback.picture_at(0.0), (*_above(trajectory, scene), 0.0)
        caption = server.scene.add_label("/caption", _caption(first), position=place, anchor="bottom-center")
        drawing.show(first)
        film = server.get_scene_serializer()
        for moment in playback.time.tolist():
            picture = playback.picture_at(moment)
            with server.atomic():
                drawing.show(picture)
                caption.text = _caption(picture)
            film.insert_sleep(playback.period)
        page = film.as_html().replace("<title>Viser</title>", f"<title>{title}</title>")
        page = page.replace("<head>", f"<head>{_upright(camera.position, camera.look_at)}", 1)
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


def _caption(picture: Picture) -> str:
    formation = picture.formation
    said = "no edges" if np.isnan(formation.error) else f"formation error {100 * formation.error:.0f} %"
    return f"{formation.time:.1f} s: {said}{', strict' if formation.strict else ''}"


def _above(trajectory: Trajectory, scene: Scene) -> tuple[float, float]:
    """A point behind all that is drawn [m]."""
    points = np.concatenate([scene.arena.walls.reshape(-1, 2), trajectory.positions[0].reshape(-1, 2)])
    high, low = np.nanmax(points, axis=0), np.nanmin(points, axis=0)
    return float((low[0] + high[0]) / 2), float(high[1] + 0.5)
