"""How options are spelled on the command line: controllers and events as one word, readable placeholders."""

from __future__ import annotations

from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from triform.control import ControllerSpec
from triform.evaluation.events import EVENTS, Event

#: Nested options are flat on the command line.
CONFIG = (tyro.conf.OmitArgPrefixes,)
#: Placeholder of a value of each type.
_PLACEHOLDERS: dict[Any, str] = {
    int: "INT",
    float: "FLOAT",
    str: "NAME",
    Path: "FILE",
    Event: f"{{{','.join(EVENTS)}}}[@SECONDS]",
}

registry = ConstructorRegistry()


@registry.primitive_rule
def _controller(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[ControllerSpec] | None:
    if info.type is not ControllerSpec:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="CONTROLLER",
        instance_from_str=lambda words: ControllerSpec.parse(words[0]),
        is_instance=lambda value: isinstance(value, ControllerSpec),
        str_from_instance=lambda value: [value.label],
    )


@registry.primitive_rule
def _omittable(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Read ``float | None`` and its like: what is omitted is ``None``, and the placeholder is that of the type."""
    if get_origin(info.type) not in (Union, UnionType):
        return None
    kinds = [kind for kind in get_args(info.type) if kind is not NoneType]
    if len(kinds) != 1 or len(kinds) == len(get_args(info.type)):
        return None
    kind = kinds[0]
    if kind not in _PLACEHOLDERS:
        return None

    def read(words: list[str]) -> Any:
        return Event.parse(words[0]) if kind is Event else kind(words[0])

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=_PLACEHOLDERS[kind],
        instance_from_str=read,
        is_instance=lambda value: value is None or isinstance(value, kind),
        str_from_instance=lambda value: ["none" if value is None else getattr(value, "label", str(value))],
    )
