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
        return self.decide(view)[1]

    def decide(self, view: MixedView) -> tuple[FloatArray, FloatArray]:
        """Return the body twists that the controllers want and those that are allowed, each of shape (B, N, 3).

        Who is not due wants what he holds.

        Raises:
            TriformError: The robots are of other kinds.
        """
        if not isinstance(view, MixedView) or len(view.parts) != len(self._controllers):
            raise TriformError(
                f"the controller {self.description['name']!r} is made for robots of {len(self._controllers)} profiles, "
                "and sees others"
            )
        wanted, commands = view.held.copy(), view.held.copy()
        everyone = None if self._everyone is None else self._everyone.command(view)
        for controller, part, robots, due in zip(self._controllers, view.parts, view.robots, view.due, strict=True):
            if not due:
                continue
            if everyone is None:
                wanted[:, robots], commands[:, robots] = decide(controller, part)
            else:
                wanted[:, robots] = own = everyone[:, robots]
                commands[:, robots] = controller.limit(part, own) if isinstance(controller, SafetyFilter) else own
        return wanted, commands


def decide(controller: Controller[Any], view: Any) -> tuple[FloatArray, FloatArray]:
    """Return the body twists that a controller wants and those that its safety filters allow, each of shape (B, N, 3).

    Without a safety filter they are the same.
    """
    if isinstance(controller, SafetyFilter | MixedController):
        return controller.decide(view)
    commands = controller.command(view)
    return commands, commands
