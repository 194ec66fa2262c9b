"""Compiled access to the robots' outlines: one ``Body`` for all robots, or ``Bodies`` with one for each.

Kernels ask ``body_of`` and ``body_reach``, and are compiled once for either. So a team of one kind pays nothing for
teams of several.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numba.extending import overload

from triform.types import Body


class Bodies(NamedTuple):
    """Outlines of robots of several kinds, as kernels take them.

    Attributes:
        half_length: As in ``Body``, shape (N,) [m].
        half_width: As in ``Body``, shape (N,) [m].
        is_circle: As in ``Body``, shape (N,).
        reach: Largest distance of a point of any of the robots from its centre [m].
    """

    half_length: Any
    half_width: Any
    is_circle: Any
    reach: float

    @classmethod
    def of(cls, bodies: Sequence[Body]) -> Bodies:
        """Return the outlines of N robots."""
        lengths, widths, circles = zip(*bodies, strict=True)
        reach = max(map(body_reach, bodies))
        return cls(np.array(lengths, np.float64), np.array(widths, np.float64), np.array(circles, np.bool_), reach)


def body_of(bodies: Any, robot: int) -> Body:
    """Return the outline of a robot, of ``Body`` or ``Bodies``."""
    if isinstance(bodies, Body):
        return bodies
    return Body(bodies.half_length[robot], bodies.half_width[robot], bodies.is_circle[robot])


def body_reach(bodies: Any) -> float:
    """Return the largest distance of a point of a robot, whichever it is, from its centre [m]."""
    if not isinstance(bodies, Body):
        return float(bodies.reach)
    return bodies.half_length if bodies.is_circle else math.hypot(bodies.half_length, bodies.half_width)


@overload(body_of, inline="always", strict=False)  # type: ignore[untyped-decorator]
def _body_of(bodies: Any, robot: int) -> Any:  # noqa: ARG001 - the names are those of the function
    if bodies.instance_class is Body:
        return lambda bodies, robot: bodies  # noqa: ARG005
    return lambda bodies, robot: Body(bodies.half_length[robot], bodies.half_width[robot], bodies.is_circle[robot])


@overload(body_reach, inline="always", strict=False)  # type: ignore[untyped-decorator]
def _body_reach(bodies: Any) -> Any:
    if bodies.instance_class is Body:
        return lambda bodies: (
            bodies.half_length if bodies.is_circle else math.hypot(bodies.half_length, bodies.half_width)
        )
    return lambda bodies: bodies.reach
