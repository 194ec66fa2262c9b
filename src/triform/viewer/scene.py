"""A team in space: robots, their graph, triangles, trails, and what one of them sees, drawn with viser."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import viser
from numpy.typing import NDArray

from triform.figures.style import (
    CLOSED,
    GREY,
    INK,
    OPEN,
    ORANGE,
    PURPLE,
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
from triform.viewer.sensing import Sensing
from triform.viewer.shapes import ROBOT_HEIGHT, Mesh, arena_mesh, body_mesh, heading_mesh, wheels_mesh

#: Heights at which flat things are drawn, so that none flickers through another [m].
_FLOOR, _TRIANGLES, _TRAILS, _EDGES, _RING, _HITS, _FREE = -0.02, 0.01, 0.02, 0.05, 0.06, 0.1, 0.14
#: A robot that seems to move farther than this between two records was put elsewhere [m].
_JUMP = 0.3
_RING_POINTS = 96


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
            else:
                self.hide()
            return
        handle.visible = True
        handle.points = drawn
        if not np.array_equal(handle.colors, colours):
            handle.colors = colours

    def draw(self, flat: FloatArray, height: float, colour: Colours) -> None:
        """Draw segments (K, 2, 2) [m] of one colour at one height [m]."""
        points = np.concatenate([flat, np.full((*flat.shape[:2], 1), height)], axis=2)
        self.show(points, np.tile(colour, (len(flat), 2, 1)))

    def hide(self) -> None:
        """Draw none."""
        if self._handle is not None:
            self._handle.visible = False


class _Triangles:
    """Flat triangles whose number changes."""

    def __init__(
        self, scene: viser.SceneApi, name: str, colour: str, opacity: float, height: float = _TRIANGLES
    ) -> None:
        self._scene, self._name, self._colour, self._opacity, self._height = scene, name, rgb(colour), opacity, height
        self._handle: viser.MeshHandle | None = None

    def show(self, corners: FloatArray) -> None:
        """Draw triangles (K, 3, 2) [m]; none are hidden."""
        handle, count = self._handle, len(corners)
        flat = corners.reshape(-1, 2)
        vertices = np.column_stack([flat, np.full(len(flat), self._height)]).astype(np.float32)
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
            position=(0.0, 0.0, _FLOOR),
            fade_distance=60.0,
            shadow_opacity=0.16,
        )
        mesh = arena_mesh(arena)
        if mesh is not None:
            scene.add_mesh_simple(
                "/arena", mesh.vertices, mesh.faces, color=(150, 150, 150), flat_shading=True, side="double"
            )
        self._trails = _Lines(scene, "/trails", 0.03)
        self._edges = _Lines(scene, "/edges", 0.03)
        self._closed = _Triangles(scene, "/triangles/closed", *CLOSED)
        self._open = _Triangles(scene, "/triangles/open", *OPEN)
        self._ring = _Lines(scene, "/picked/reach", 0.025)
        self._groups = _Lines(scene, "/picked/groups", 0.02)
        self._neighbours = _Lines(scene, "/picked/neighbours", 0.05)
        self._edge_of_free = _Lines(scene, "/picked/free/edge", 0.02)
        self._free = _Triangles(scene, "/picked/free", ORANGE, 0.3, _FREE)
        self._arrows: viser.ArrowsHandle | None = None
        self._hits: list[viser.PointCloudHandle] = []
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
        """Draw how far a robot looks, what its LiDAR hit, what the network takes for a neighbour, and its command."""
        row = np.flatnonzero(formation.robots == (-1 if picked is None else picked))
        for handle in self._hits:
            handle.visible = False
        if sensing is None or len(row) == 0:
            for lines in (self._ring, self._groups, self._neighbours, self._edge_of_free):
                lines.hide()
            self._free.show(np.zeros((0, 3, 2)))
            if self._arrows is not None:
                self._arrows.visible = False
            return
        pose, colour = poses[row[0]], colours[picked]
        self._ring.draw(_circle(pose[:2], sensing.reach), _RING, colour)
        self._show_groups(sensing)
        self._show_limits(sensing, pose)
        tips = sensing.horizon * body_to_world(np.stack([sensing.wanted, sensing.command])[:, :2], pose[2])
        ends = np.stack([np.tile(pose[:2], (2, 1)), pose[:2] + tips], axis=1)
        heights = np.broadcast_to(np.array([0.03, 0.06])[:, None, None] + ROBOT_HEIGHT, (2, 2, 1))
        points = np.concatenate([ends, heights], axis=2).astype(np.float32)
        if self._arrows is None:
            self._arrows = self._scene.add_arrows(
                "/picked/commands",
                points,
                _linear(np.stack([rgb(GREY), rgb(VERMILLION)])),
                shaft_radius=0.018,
                head_radius=0.05,
                head_length=0.1,
            )
        self._arrows.points, self._arrows.visible = points, True
        self._hits = [
            self._show_points("hits", sensing.hits, VERMILLION, 0.03),
            self._show_points("limiting", sensing.limiting, ORANGE, 0.06),
        ]

    def _show_groups(self, sensing: Sensing) -> None:
        """Draw rings around groups of cells, thick ones around what the network takes for neighbours."""
        groups = None if sensing.reading is None else sensing.reading.groups
        if groups is None:
            self._groups.hide()
            self._neighbours.hide()
            return
        centres = sensing.pose[:2] + body_to_world(groups.centres, sensing.pose[2])
        rings = [_circle(centre, radius + 0.12) for centre, radius in zip(centres, groups.radii, strict=True)]
        for lines, chosen, colour in (
            (self._groups, ~groups.neighbours, GREY),
            (self._neighbours, groups.neighbours, PURPLE),
        ):
            some = [ring for ring, one in zip(rings, chosen, strict=True) if one]
            lines.draw(np.concatenate([np.zeros((0, 2, 2)), *some]), _RING, rgb(colour))

    def _show_limits(self, sensing: Sensing, pose: FloatArray) -> None:
        """Draw where the safety filter lets a robot be in the time of an arrow."""
        if sensing.free is None:
            self._free.show(np.zeros((0, 3, 2)))
            self._edge_of_free.hide()
            return
        edge = pose[:2] + sensing.horizon * body_to_world(sensing.free, pose[2])
        sides = np.stack([edge, np.roll(edge, -1, axis=0)], axis=1)
        middle = np.broadcast_to(pose[:2], (len(edge), 1, 2))
        self._free.show(np.concatenate([middle, sides], axis=1))
        self._edge_of_free.draw(sides, _FREE, rgb(ORANGE))

    def _show_points(self, name: str, points: FloatArray, colour: str, size: float) -> viser.PointCloudHandle:
        """Draw points (K, 2) [m]."""
        red, green, blue = _linear(rgb(colour)).tolist()
        return self._scene.add_point_cloud(
            f"/picked/{name}",
            np.column_stack([points, np.full(len(points), _HITS)]).astype(np.float32),
            (red, green, blue),
            point_size=size,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
            visible=len(points) > 0,
        )


def _circle(middle: FloatArray, radius: float) -> FloatArray:
    """Return a circle as segments (K, 2, 2) [m]."""
    angle = np.linspace(0, 2 * np.pi, _RING_POINTS + 1)
    points = middle + radius * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.stack([points[:-1], points[1:]], axis=1)


#: Angle of view of cameras, top to bottom [rad]; a small one keeps distances comparable over the picture.
FIELD_OF_VIEW = 0.6


class Margins(NamedTuple):
    """Shares of a window that panels cover."""

    left: float = 0.0
    right: float = 0.0
    bottom: float = 0.0


#: Nothing is covered.
UNCOVERED = Margins()


def view_of(
    points: FloatArray, arena: Arena, aspect: float = 1.0, margins: Margins = UNCOVERED, tilt: float = 0.3
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return where a camera sees all, and what it looks at [m].

    Args:
        points: What is to be seen besides the arena [m], shape (..., 2).
        arena: Walls and pillars.
        aspect: Width of the window over its height.
        margins: What of the window is covered.
        tilt: How far the camera is before the middle, over how high.
    """
    middle, half = bounds(points, arena, margin=0.8)
    free_height, free_width = 1.0 - margins.bottom, aspect * (1.0 - margins.left - margins.right)
    # Half the height that the window shows, of which the free part holds all.
    seen = float(half / min(free_height, free_width))
    height = seen / float(np.tan(FIELD_OF_VIEW / 2))
    x, y = middle.tolist()
    x += (margins.right - margins.left) * aspect * seen
    y -= margins.bottom * seen
    return (x, y - tilt * height, height), (x, y, 0.0)
