"""Parameters of the executables: declared once, with descriptions and ranges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterException
from rclpy.node import Node

from triform.types import ConfigurationError, require

#: Parameters that ROS itself gives to every node.
_OF_EVERY_NODE = ("use_sim_time", "start_type_description_service")


@dataclass(frozen=True)
class Parameter:
    """A parameter of an executable.

    Attributes:
        name: Its name.
        default: Its value if none is given; the type holds.
        description: What it is, with its unit.
        low: Smallest number that is allowed.
        high: Largest number that is allowed.
        live: Whether it may change while the node runs.
    """

    name: str
    default: bool | int | float | str | list[float]
    description: str
    low: float | None = None
    high: float | None = None
    live: bool = False

    def declare(self, node: Node) -> Any:
        """Declare it and return its value.

        Raises:
            ConfigurationError: The value has another type or is out of range.
        """
        descriptor = ParameterDescriptor(description=self.description, read_only=not self.live)
        low, high = self.low, self.high
        allowed = ""
        if low is not None and high is not None:
            allowed = f" between {low:g} and {high:g}"
            if isinstance(self.default, float):
                descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
            else:
                descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        kind = {float: "number with a decimal point", int: "whole number", list: "list of numbers"}
        needed = f"a {kind.get(type(self.default), type(self.default).__name__)}{allowed} is needed"
        try:
            value = node.declare_parameter(self.name, self.default, descriptor).value
        except ParameterException as error:
            raise ConfigurationError(f"the parameter {self.name!r} cannot be used: {needed}") from error
        require(
            low is None or high is None or low <= value <= high, f"the parameter {self.name!r} is {value}: {needed}"
        )
        return value


def given_names(node: Node) -> frozenset[str]:
    """Return the names of the parameters that the node was started with, before any is declared."""
    return frozenset(node.get_parameters_by_prefix(""))


def declare(node: Node, parameters: tuple[Parameter, ...]) -> dict[str, Any]:
    """Declare all parameters of an executable and return their values by name.

    Args:
        node: Made with ``automatically_declare_parameters_from_overrides``, so that it knows what was given.
        parameters: All that there are.

    Raises:
        ConfigurationError: A value has another type or is out of range, or there is no such parameter.
    """
    known = {each.name for each in parameters}
    for name in given_names(node):
        if name in known:
            # Given values come back when it is declared with its type and range.
            node.undeclare_parameter(name)
        elif name not in _OF_EVERY_NODE and not name.startswith("qos_overrides."):
            raise ConfigurationError(f"there is no parameter {name!r}; there are {', '.join(sorted(known))}")
    return {each.name: each.declare(node) for each in parameters}
