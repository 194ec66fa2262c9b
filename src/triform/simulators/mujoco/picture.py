"""Pictures of a world by MuJoCo's own renderer."""

from __future__ import annotations

import mujoco
import numpy as np

from triform.types import FloatArray, MapArray, TriformError

#: Degrees that the camera looks down, and room around the robots [m].
_ELEVATION = -60.0
_MARGIN = 1.0


def draw(model: mujoco.MjModel, places: FloatArray, positions: FloatArray, width: int, height: int) -> MapArray:
    """Draw robots as a camera above and behind them sees them.

    Args:
        model: What there is.
        places: Positions of all joints, MuJoCo's ``qpos``, shape (nq,).
        positions: Where to look: robots in the world frame, shape (N, 2) [m].
        width: Width of the picture in pixels, at most 1920.
        height: Height of the picture in pixels, at most 1080.

    Returns:
        Colours, shape (height, width, 3).

    Raises:
        TriformError: No OpenGL that the renderer can use, or a picture that is too large.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = places
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.azimuth, camera.elevation = 90.0, _ELEVATION
    camera.lookat[:2] = (positions.min(axis=0) + positions.max(axis=0)) / 2
    extent = float(np.ptp(positions, axis=0).max()) + 2 * _MARGIN
    camera.distance = extent / np.tan(np.radians(model.vis.global_.fovy) / 2) / 2
    try:
        with mujoco.Renderer(model, height, width) as renderer:
            renderer.update_scene(data, camera)
            return np.array(renderer.render())
    # Each backend of OpenGL fails in its own way.
    except (mujoco.FatalError, AttributeError, ImportError, RuntimeError, ValueError) as error:
        raise TriformError(
            f"MuJoCo's renderer does not work here ({error}); on a machine without a screen set MUJOCO_GL=egl before "
            "Python starts"
        ) from error
