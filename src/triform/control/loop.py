"""Algorithm 2: at every control period a robot senses, decides and moves. Every body is driven by this loop."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from typing import TypeVar

import numpy as np

from triform.types import (
    Controller,
    FloatArray,
    PrivilegedView,
    Team,
    TriformError,
    View,
    require,
)

ViewT = TypeVar("ViewT", bound=View)


def drive(
    team: Team[ViewT],
    controller: Controller[ViewT],
    duration: float,
    on_step: Callable[[ViewT, FloatArray], None] | None = None,
) -> None:
    """Drive any team with any controller.

    Args:
        team: The body: the built-in world, a simulator, or one real robot.
        controller: What turns a view into body twists.
        duration: How long to drive [s]; a whole number of control periods, or ``inf`` until an exception ends it.
        on_step: Called once per control period with the view and the commands, before they are applied.

    Raises:
        ConfigurationError: ``duration`` is not a positive whole number of control periods.
        TriformError: The controller needs true poses and the team does not show them; no command has been sent then.
    """
    steps: Iterable[int] = itertools.count()
    if duration != math.inf:
        steps = range(control_steps(duration, team.control_period))
    for _ in steps:
        view = team.observe()
        if controller.privileged and not isinstance(view, PrivilegedView):
            raise TriformError(
                f"the controller {controller.description['name']!r} needs everybody's true pose, which this team "
                "does not show; only a controller that is not privileged can drive it"
            )
        commands = controller.command(view)
        if on_step is not None:
            on_step(view, commands)
        team.apply(commands, team.control_period)


def true_poses(view: View, who: str) -> FloatArray:
    """Return everybody's true pose, shape (B, N, 3), contiguous.

    Args:
        view: What a team senses.
        who: The controller, for the sentence that refuses.

    Raises:
        TriformError: The view carries no poses.
    """
    if not isinstance(view, PrivilegedView):
        raise TriformError(f"{who} needs true poses, and this team cannot offer them")
    return np.ascontiguousarray(view.poses, dtype=np.float64)


def control_steps(duration: float, control_period: float) -> int:
    """Return how many control periods [s] make up ``duration`` [s].

    Raises:
        ConfigurationError: It is not a positive whole number.
    """
    steps = round(duration / control_period) if np.isfinite(duration) else 0
    require(
        steps >= 1 and abs(steps * control_period - duration) < 1e-6,
        f"duration is {duration:g} s; it must be a positive whole number of control periods of {control_period:g} s",
    )
    return steps
