"""What one robot sees, from its scan to the patches of its network."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch

from triform.control import ControllerSpec
from triform.evaluation.rollout import Trajectory
from triform.figures.runs import Scene, draw_formation, present
from triform.figures.sensing import RobotSight, central_robot, sense_again
from triform.figures.style import (
    FRONT_UP,
    GREY,
    HELD,
    INK,
    VERMILLION,
    draw_arena,
    figure_style,
    footprint_outlines,
    frame,
    map_colours,
    robot_colours,
)
from triform.simulation import Composition

#: When a robot is shown [s], while it still has far to go; at the end of a shorter run.
MOMENT = 2.0
_GRID = "#c9c9c9"


class ScanDrawing:
    """The scan of one robot in its own frame, forward up; drawn once or moved from frame to frame."""

    def __init__(self, axes: Axes, scene: Scene, robot: int, colour: Any, reach: float) -> None:
        """Draw a robot, and how far its LiDAR looks.

        Args:
            axes: Where to draw.
            scene: Outlines of the robots.
            robot: Which of them.
            colour: Its colour.
            reach: How far its LiDAR looks [m].
        """
        axes.add_patch(Circle((0, 0), reach, facecolor="none", edgecolor=GREY, linewidth=0.8))
        (body,) = footprint_outlines(FRONT_UP, scene.footprints(np.array([robot])))
        axes.fill(*body.T, color=colour, zorder=4)
        axes.set_xlim(-1.02 * reach, 1.02 * reach)
        axes.set_ylim(-1.02 * reach, 1.02 * reach)
        _strip(axes)
        # Typed as anything because their methods carry no types.
        self._rays: Any = LineCollection([], linewidths=0.4, alpha=0.25)
        self._dim: Any = Line2D([], [], ls="none", marker="o", ms=2.2, mfc=GREY, mec="none")
        self._hits: Any = Line2D([], [], ls="none", marker="o", ms=2.2, mfc=VERMILLION, mec="none")
        #: What moves, from the bottom up.
        self.artists = (self._rays, self._dim, self._hits)
        axes.add_collection(self._rays)
        axes.add_line(self._dim)
        axes.add_line(self._hits)

    def show(self, sensing: RobotSight) -> None:
        """Draw a scan; grey are returns that are too dim for a robot."""
        forward, left = sensing.hits_body.T
        points = np.column_stack([-left, forward])
        self._rays.set_segments(list(np.stack([np.zeros_like(points), points], axis=1)))
        self._rays.set_color([GREY if dim else VERMILLION for dim in sensing.dim])
        self._hits.set_data(*points[~sensing.dim].T)
        self._dim.set_data(*points[sensing.dim].T)


class MapDrawing:
    """The occupancy map of one robot, forward up, with the patches of its network."""

    def __init__(self, axes: Axes, sensing: RobotSight, colour: Any) -> None:
        """Draw the map of a first moment, or say that there is none.

        Args:
            axes: Where to draw.
            sensing: What the robot sees.
            colour: Its colour.
        """
        #: What moves, from the bottom up.
        self.artists: tuple[Any, ...] = ()
        _strip(axes)
        if sensing.occupancy is None:
            note = "the policy cannot\nuse these scans"
            axes.text(0.5, 0.5, note, ha="center", va="center", transform=axes.transAxes, fontsize=9)
            return
        half, size = sensing.half_extent, len(sensing.occupancy)
        image = map_colours(sensing.occupancy, sensing.patch)
        self._image: Any = axes.imshow(image, extent=(-half, half, -half, half), interpolation_stage="rgba")
        # Rows count from behind and columns from the right.
        places = 2 * half / size * np.arange(0, size + 1, sensing.patch or size) - half
        lines = [[(-half, place), (half, place)] for place in places]
        grid = LineCollection(lines + [[(-place, -half), (-place, half)] for place in places])
        grid.set(color=_GRID, linewidth=0.4)
        own = Line2D([0], [0], marker="^", ms=5, mfc=colour, mec="white", mew=0.5)
        axes.add_collection(grid)
        axes.add_line(own)
        self.artists = (self._image, grid, own)

    def show(self, sensing: RobotSight) -> None:
        """Draw a map."""
        if sensing.occupancy is not None:
            self._image.set_data(map_colours(sensing.occupancy, sensing.patch))


def sight_figure(trajectory: Trajectory, scene: Scene, team: Composition, controller: ControllerSpec) -> Figure:
    """Draw what the robot in the middle of the team sees after 2 s: in the world, as its scan, and as its map.

    Args:
        trajectory: The run.
        scene: Footprint, arena and prescribed distance.
        team: Kinds of the robots.
        controller: Who steered; the map is that of its policy, or of the default one.
    """
    robot = central_robot(trajectory)
    record = min(int(np.searchsorted(trajectory.time, MOMENT - 1e-6)), len(trajectory.time) - 1)
    (sensing,) = sense_again(trajectory, [record], robot, team, scene.arena, controller, scene.distance)
    robots, colours = present(trajectory, record), robot_colours(trajectory.poses.shape[2])
    poses = trajectory.poses[0, record, robots]
    with figure_style():
        figure, (world, scan, occupancy) = plt.subplots(1, 3, figsize=(10.2, 4.05))
        draw_arena(world, scene.arena)
        _draw_rays(world, sensing)
        draw_formation(world, poses, robots, scene, [colours[each] for each in robots])
        circle = sensing.pose[:2] + sensing.reach * np.array([[-1.0, -1.0], [1.0, 1.0]])
        frame(world, np.concatenate([poses[:, :2], circle]), scene.arena)
        world.set_xlabel("x [m]")
        world.set_ylabel("y [m]")
        world.set_title(f"a  the team after {trajectory.time[record]:g} s", loc="left")
        ScanDrawing(scan, scene, robot, colours[robot], sensing.reach).show(sensing)
        scan.set_title(f"b  scan of one robot, up to {sensing.reach:g} m", loc="left")
        MapDrawing(occupancy, sensing, colours[robot]).show(sensing)
        occupancy.set_title("c  its occupancy map and patches", loc="left")
        entries = [
            Line2D([], [], ls="none", marker="o", ms=4, mfc=VERMILLION, mec="none", label="return of the LiDAR"),
            Patch(facecolor=INK, label="occupied cell"),
            Patch(facecolor=HELD, label="patch that its network sees"),
        ]
        if sensing.dim.any():
            entries.insert(
                1, Line2D([], [], ls="none", marker="o", ms=4, mfc=GREY, mec="none", label="return too dim for a robot")
            )
        figure.legend(handles=entries, loc="outside lower center", ncols=len(entries))
    return figure


def _draw_rays(axes: Axes, sensing: RobotSight) -> None:
    """Draw the returns of a robot where they are in the world, and how far it looks."""
    place = sensing.pose[:2]
    for colour, hits in ((GREY, sensing.hits[sensing.dim]), (VERMILLION, sensing.hits[~sensing.dim])):
        rays = np.stack([np.broadcast_to(place, hits.shape), hits], axis=1)
        axes.add_collection(LineCollection(list(rays), colors=colour, linewidths=0.4, alpha=0.25, zorder=1.2))
        axes.plot(*hits.T, "o", ms=1.8, color=colour, zorder=6)
    axes.add_patch(Circle((place[0], place[1]), sensing.reach, facecolor="none", edgecolor=GREY, linewidth=0.8))


def _strip(axes: Axes) -> None:
    """Take ticks, grid and frame away, and show a square."""
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.grid(visible=False)
    for side in axes.spines.values():
        side.set_visible(False)
