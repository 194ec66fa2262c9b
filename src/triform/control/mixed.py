"""Control of teams of several kinds of robots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from triform.control.safety import SafetyFilter
from triform.mixed import MixedView
from triform.types import Controller, FloatArray, TriformError


class MixedController:
    """Steers robots of several kinds: a ``Controller[MixedView]``.

    Robots of each kind have a controller of their own, which sees what they sense and no more. A privileged controller
    is one for all, because it asks for everybody's pose; what it commands then passes the safety filter of each kind.
    Who is not due holds his command.
    """

    def __init__(self, controllers: Sequence[Controller[Any]], everyone: Controller[Any] | None = None) -> None:
        """Put controllers side by side.

        Args:
            controllers: That of each kind, in the order of the kinds.
            everyone: One that commands all kinds; each of ``controllers`` is then this one, with or without a filter.
        """
        self._controllers = tuple(controllers)
        self._everyone = everyone

    @property
    def privileged(self) -> bool:
        """Whether a controller needs true poses."""
        return self._everyone is not None

    @property
    def description(self) -> dict[str, Any]:
        """Name of the controller, and what that of each kind says of itself."""
        kinds = [controller.description for controller in self._controllers]
        return {"name": kinds[0]["name"], "kinds": kinds}

    def command(self, view: MixedView) -> FloatArray:
        """Return body twists, shape (B, N, 3).

        Raises:
            TriformError: The robots are of other kinds.
        """
        if not isinstance(view, MixedView) or len(view.parts) != len(self._controllers):
            raise TriformError(
                f"the controller {self.description['name']!r} is made for robots of {len(self._controllers)} profiles, "
                "and sees others"
            )
        commands = view.held.copy()
        wanted = None if self._everyone is None else self._everyone.command(view)
        for controller, part, robots, due in zip(self._controllers, view.parts, view.robots, view.due, strict=True):
            if not due:
                continue
            if wanted is None:
                commands[:, robots] = controller.command(part)
            elif isinstance(controller, SafetyFilter):
                commands[:, robots] = controller.limit(part, wanted[:, robots])
            else:
                commands[:, robots] = wanted[:, robots]
        return commands
