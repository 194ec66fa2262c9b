"""A team in space: robots, their graph, triangles, trails, and what one of them sees, drawn with viser."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from triform.figures.sensing import Sensing
from triform.figures.style import (
    CLOSED,
    INK,
    OPEN,
    VERMILLION,
    Colours,
    bounds,
    edge_colours,
    rgb,
    robot_colours,
)
from triform.geometry import body_to_world
from triform.simulation import Arena, Footprint, Profile
from triform.types import FloatArray
from triform.viewer.formation import Formation, Picture
from triform.viewer.shapes import ROBOT_HEIGHT, Mesh, arena_mesh, body_mesh, heading_mesh, wheels_mesh

#: Heights at which flat things are drawn, so that none flickers through another [m].
_TRIANGLES, _TRAILS, _EDGES, _RING, _HITS = 0.004, 0.008, 0.05, 0.012, 0.1
#: A robot that seems to move farther than this between two records was put elsewhere [m].
_JUMP = 0.3
_RING_POINTS = 96
#: How far a robot comes in the time that its arrow shows [s].
_ARROW_TIME = 1.0


def _linear(colours: Colours) -> Colours:
    """Return colours as viser takes those of lines, points and batches: in linear light, not in sRGB."""
    share = colours / 255.0
    return np.round(255 * np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)).astype(np.uint8)


class _Lines:
    """Line segments whose number changes."""

    def __init__(self, scene: viser.SceneApi, name: str, thickness: float) -> None:
        self._scene, self._name, self._thickness = scene, name, thickness
        self._handle: viser.LineSegmentsHandle | None = None

    def show(self, points: FloatArray, colours: Colours) -> None:
        """Draw segments (K, 2, 3) [m] with a colour at every end (K, 2, 3); those of none are hidden."""
        handle, drawn, colours = self._handle, points.astype(np.float32), _linear(colours)
        if handle is None or len(handle.points) != len(drawn):
            if len(drawn):
                self._handle = self._scene.add_line_segments(self._name, drawn, colours, thickness=self._thickness)
            elif handle is not None:
                handle.visible = False
            return
        handle.visible = True
        handle.points = drawn
        if not np.array_equal(handle.colors, colours):
            handle.colors = colours


class _Triangles:
    """Flat triangles whose number changes."""

    def __init__(self, scene: viser.SceneApi, name: str, colour: str, opacity: float) -> None:
        self._scene, self._name, self._colour, self._opacity = scene, name, rgb(colour), opacity
        self._handle: viser.MeshHandle | None = None

    def show(self, corners: FloatArray) -> None:
        """Draw triangles (K, 3, 2) [m]; none are hidden."""
        handle, count = self._handle, len(corners)
        flat = corners.reshape(-1, 2)
        vertices = np.column_stack([flat, np.full(len(flat), _TRIANGLES)]).astype(np.float32)
        if handle is not None and len(handle.vertices) == len(vertices):
            handle.visible = True
            handle.vertices = vertices
        elif count:
            red, green, blue = self._colour.tolist()
            self._handle = self._scene.add_mesh_simple(
                self._name,
                vertices,
                np.arange(3 * count).reshape(-1, 3),
                color=(red, green, blue),
                opacity=self._opacity,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )
        elif handle is not None:
            handle.visible = False


class _Kind:
    """The robots of one outline: bodies, marks of their headings, and wheels."""

    def __init__(self, scene: viser.SceneApi, name: str, footprint: Footprint, profile: Profile | None) -> None:
        self._scene, self._name = scene, name
        self._parts: list[tuple[str, Mesh, Colours | None]] = [
            ("body", body_mesh(footprint), None),
            ("heading", heading_mesh(footprint), rgb("#ffffff")),
        ]
        if profile is not None:
            self._parts.append(("wheels", wheels_mesh(footprint, profile.drive), rgb(INK)))
        self.handles: dict[str, viser.BatchedMeshHandle] = {}
        self.robots: NDArray[np.int64] = np.zeros(0, dtype=np.int64)

    def show(self, robots: NDArray[np.int64], poses: FloatArray, colours: Colours) -> bool:
        """Draw robots (M,) at poses (M, 3) and tell whether their bodies are new things to click."""
        colours = _linear(colours)
        positions = np.column_stack([poses[:, :2], np.zeros(len(poses))]).astype(np.float32)
        turns = np.zeros((len(poses), 4), dtype=np.float32)
        turns[:, 0], turns[:, 3] = np.cos(poses[:, 2] / 2), np.sin(poses[:, 2] / 2)
        anew = not self.handles or not np.array_equal(robots, self.robots)
        if anew:
            self.remove()
            self.robots = robots.copy()
            if len(robots) == 0:
                return False
            for part, mesh, colour in self._parts:
                self.handles[part] = self._scene.add_batched_meshes_simple(
                    f"{self._name}/{part}",
                    mesh.vertices.astype(np.float32),
                    mesh.faces.astype(np.uint32),
                    turns,
                    positions,
                    batched_colors=colours if colour is None else np.tile(_linear(colour), (len(robots), 1)),
                    flat_shading=True,
                    lod="off",
                    cast_shadow=part == "body",
                    receive_shadow=False,
                )
        for part, handle in self.handles.items():
            handle.batched_positions = positions
            handle.batched_wxyzs = turns
            if part == "body" and not np.array_equal(handle.batched_colors, colours):
                handle.batched_colors = colours
        return anew

    def remove(self) -> None:
        """Draw none any more."""
        for handle in self.handles.values():
            handle.remove()
        self.handles.clear()


class Drawing:
    """Draws pictures of one team into a scene of viser.

    Attributes:
        bodies: What can be clicked: handles of bodies, and which robots they are, each (M,).
    """

    def __init__(
        self,
        scene: viser.SceneApi,
        outlines: Footprint | tuple[Footprint, ...],
        arena: Arena,
        distance: float,
        profiles: tuple[Profile, ...] = (),
    ) -> None:
        """Draw the floor, walls and pillars.

        Args:
            scene: Where to draw.
            outlines: Outline of all robots, or of each.
            arena: Walls and pillars.
            distance: Prescribed neighbour distance d* [m].
            profiles: What the robots are, if it is known; their wheels are then drawn too.
        """
        scene.reset()
        scene.set_up_direction("+z")
        # Light that is soft and the same everywhere shows the colours of the figures.
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(hdri=None)
        scene.add_light_ambient("/lights/everywhere", intensity=1.9)
        scene.add_light_directional("/lights/above", intensity=1.6, position=(2.0, -3.0, 8.0), cast_shadow=True)
        self._scene, self._outlines, self._distance = scene, outlines, distance
        self._colours: Colours = np.zeros((0, 3), dtype=np.uint8)
        self._profiles = {profile.footprint: profile for profile in reversed(profiles)}
        scene.add_grid(
            "/floor",
            width=400.0,
            height=400.0,
            cell_size=0.5,
            section_size=1.0,
            cell_color=(250, 250, 250),
            section_color=(236, 236, 236),
            plane_color=(255, 255, 255),
            plane_opacity=1.0,
            infinite_grid=True,
            fade_distance=60.0,
            shadow_opacity=0.16,
        )
        mesh = arena_mesh(arena)
        if mesh is not None:
            scene.add_mesh_simple(
                "/arena", mesh.vertices, mesh.faces, color=(150, 150, 150), flat_shading=True, side="double"
            )
        self._trails = _Lines(scene, "/trails", 0.018)
        self._edges = _Lines(scene, "/edges", 0.03)
        self._closed = _Triangles(scene, "/triangles/closed", *CLOSED)
        self._open = _Triangles(scene, "/triangles/open", *OPEN)
        self._ring = _Lines(scene, "/picked/reach", 0.015)
        self._arrow = _Lines(scene, "/picked/command", 0.04)
        self._hits: viser.PointCloudHandle | None = None
        self._kinds: dict[Footprint, _Kind] = {}
        self.bodies: list[tuple[viser.BatchedMeshHandle, NDArray[np.int64]]] = []

    def colours(self, robots: int) -> Colours:
        """Return the colours of a team, shape (robots, 3)."""
        if len(self._colours) != robots:
            self._colours = np.array([rgb(colour) for colour in robot_colours(robots)])
        return self._colours

    def show(self, picture: Picture, picked: int | None = None, sensing: Sensing | None = None) -> bool:
        """Draw a picture.

        Args:
            picture: The team.
            picked: The robot whose sight is shown.
            sensing: What that robot sees.

        Returns:
            Whether ``bodies`` are other ones than before.
        """
        formation, poses, trail = picture
        colours = self.colours(trail.shape[1])
        self._show_trails(trail, colours)
        self._show_graph(formation, poses)
        self._show_sensing(sensing, formation, poses, picked, colours)
        return self._show_robots(formation, poses, colours)

    def _show_robots(self, formation: Formation, poses: FloatArray, colours: Colours) -> bool:
        given = self._outlines
        of_each = [given if isinstance(given, Footprint) else given[robot] for robot in formation.robots.tolist()]
        for footprint in dict.fromkeys(of_each):
            if footprint not in self._kinds:
                name = f"/robots/{len(self._kinds)}"
                self._kinds[footprint] = _Kind(self._scene, name, footprint, self._profiles.get(footprint))
        anew = False
        for footprint, kind in self._kinds.items():
            own = np.array([each == footprint for each in of_each], dtype=np.bool_)
            robots = formation.robots[own]
            anew |= kind.show(robots, poses[own], colours[robots])
        if anew:
            self.bodies = [
                (kind.handles["body"], kind.robots) for kind in self._kinds.values() if "body" in kind.handles
            ]
        return anew

    def _show_trails(self, trail: FloatArray, colours: Colours) -> None:
        """Draw the ways of robots, fainter the longer ago; by time, so that the next picture begins as this one."""
        ends = np.stack([trail[:-1], trail[1:]], axis=2)
        length = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1)
        ends[~(length < _JUMP)] = 0.0
        age = np.linspace(0.0, 1.0, len(ends) + 1) if len(ends) else np.zeros(1)
        white = 255.0
        faint = white - 0.75 * age[:, None, None] * (white - colours.astype(np.float64))
        points = np.concatenate([ends, np.full((*ends.shape[:3], 1), _TRAILS)], axis=-1).reshape(-1, 2, 3)
        shades = np.stack([faint[:-1], faint[1:]], axis=2).reshape(-1, 2, 3)
        self._trails.show(points, np.round(shades).astype(np.uint8))

    def _show_graph(self, formation: Formation, poses: FloatArray) -> None:
        places = np.column_stack([poses[:, :2], np.full(len(poses), _EDGES)])
        colours = edge_colours(formation.lengths, self._distance)
        self._edges.show(places[formation.edges], np.repeat(colours[:, None], 2, axis=1))
        corners = poses[:, :2][formation.triangles]
        self._closed.show(corners[formation.closed])
        self._open.show(corners[~formation.closed])

    def _show_sensing(
        self, sensing: Sensing | None, formation: Formation, poses: FloatArray, picked: int | None, colours: Colours
    ) -> None:
        """Draw how far a robot looks, what its LiDAR hit, and its command."""
        row = np.flatnonzero(formation.robots == (-1 if picked is None else picked))
        if sensing is None or len(row) == 0:
            none, no_colour = np.zeros((0, 2, 3)), np.zeros((0, 2, 3), dtype=np.uint8)
            self._ring.show(none, no_colour)
            self._arrow.show(none, no_colour)
            if self._hits is not None:
                self._hits.visible = False
            return
        pose, colour = poses[row[0]], colours[picked]
        angle = np.linspace(0, 2 * np.pi, _RING_POINTS + 1)
        circle = pose[:2] + sensing.reach * np.column_stack([np.cos(angle), np.sin(angle)])
        circle = np.column_stack([circle, np.full(len(circle), _RING)])
        self._ring.show(np.stack([circle[:-1], circle[1:]], axis=1), np.tile(colour, (_RING_POINTS, 2, 1)))
        tip = pose[:2] + _ARROW_TIME * body_to_world(sensing.command[None, :2], pose[2])[0]
        arrow = np.array([[[*pose[:2], ROBOT_HEIGHT + 0.03], [*tip, ROBOT_HEIGHT + 0.03]]])
        self._arrow.show(arrow, np.tile(rgb(VERMILLION), (1, 2, 1)))
        points = np.column_stack([sensing.hits, np.full(len(sensing.hits), _HITS)]).astype(np.float32)
        red, green, blue = _linear(rgb(VERMILLION)).tolist()
        self._hits = self._scene.add_point_cloud(
            "/picked/hits",
            points,
            (red, green, blue),
            point_size=0.03,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
            visible=len(points) > 0,
        )


#: Angle of view of cameras, top to bottom [rad]; a small one keeps distances comparable over the picture.
FIELD_OF_VIEW = 0.6


def view_of(
    points: FloatArray, arena: Arena, aspect: float = 1.0, tilt: float = 0.3, aside: float = 0.0
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return where a camera sees all, and what it looks at [m].

    Args:
        points: What is to be seen besides the arena [m], shape (..., 2).
        arena: Walls and pillars.
        aspect: Width of the picture over its height.
        tilt: How far the camera is before the middle, over how high.
        aside: Share of the picture's width by which all is moved to the left.
    """
    middle, half = bounds(points, arena, margin=0.8)
    height = float(half / (np.tan(FIELD_OF_VIEW / 2) * min(1.0, aspect)))
    x, y = middle.tolist()
    x += aside * aspect * 2 * height * float(np.tan(FIELD_OF_VIEW / 2))
    return (x, y - tilt * height, height), (x, y, 0.0)
