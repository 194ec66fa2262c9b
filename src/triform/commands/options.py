"""How options are spelled on the command line: flat, in named groups, with readable placeholders.

All is taken from the dataclass of a command and its docstring, so that libraries need not know a command line. What an
attribute's line says decides its placeholder: ``[s]`` makes SECONDS, and *Folder of ...* makes FOLDER. Attributes named
in ``GROUPS`` of a command, and those of nested dataclasses, have a heading of their own in the help. Those named in
``WORDS`` are one text, given as one or several words.
"""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import (
    MISSING_NONPROP,
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from triform.control import ControllerSpec
from triform.evaluation.events import EVENTS, Event

#: Nested options are flat on the command line.
CONFIG = (tyro.conf.OmitArgPrefixes,)
#: Placeholders by the unit in brackets.
_UNITS = {
    "s": "SECONDS",
    "m": "METRES",
    "m/s": "M/S",
    "m/s^2": "M/S^2",
    "Hz": "HERTZ",
    "rad": "RADIANS",
    "rad/s": "RAD/S",
}
#: Placeholders by the words with which the explanation begins.
_BEGINNINGS = {
    "Serial port": "PORT",
    "Address": "ADDRESS",
    "Loopback address": "ADDRESS",
    "Sectors": "FROM:TO",
    "Ray cluster": "HOST:PORT",
    "Outline": "OUTLINE",
    "Folder": "FOLDER",
    "Another folder": "FOLDER",
    "Share": "SHARE",
}
#: Placeholders by type, where the explanation says nothing.
_KINDS: dict[Any, str] = {
    int: "NUMBER",
    float: "NUMBER",
    str: "NAME",
    Path: "FILE",
    Event: f"{{{','.join(EVENTS)}}}[@SECONDS]",
    ControllerSpec: "CONTROLLER",
}

#: Reads one or several words as one text.
_TEXT = PrimitiveConstructorSpec(
    nargs="*",
    metavar="NAME|FILE[:ROBOTS] ...",
    instance_from_str=" ".join,
    is_instance=lambda value: isinstance(value, str),
    str_from_instance=lambda value: [value],
)

registry = ConstructorRegistry()


class _Group:
    """Some options of a command under a heading of their own; subclasses have the options."""

    options: tuple[StructFieldSpec, ...]


@registry.struct_rule
def _options(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Take the options of a command from a dataclass, each explained by its docstring."""
    kind: Any = info.type
    if not isinstance(kind, type):
        return None
    if issubclass(kind, _Group):
        return StructConstructorSpec(dict, kind.options)
    if not is_dataclass(kind):
        return None
    types, helps = get_type_hints(kind, include_extras=True), explanations(kind)
    options: dict[str, StructFieldSpec] = {}
    for each in fields(kind):
        default = MISSING_NONPROP
        if isinstance(info.default, kind):
            default = getattr(info.default, each.name)
        elif each.default is not MISSING:
            default = each.default
        elif each.default_factory is not MISSING:
            default = each.default_factory()
        text = helps.get(each.name, "")
        shown = _shown(types[each.name], text, default)
        if each.name in getattr(kind, "WORDS", ()):
            shown = Annotated[types[each.name], _TEXT]
        options[each.name] = StructFieldSpec(each.name, shown, default, text)
    groups: dict[str, tuple[str, ...]] = getattr(kind, "GROUPS", {})
    for name, members in groups.items():
        held = type(name, (_Group,), {"options": tuple(options.pop(member) for member in members)})
        options[f"{name} options"] = StructFieldSpec(name, held, MISSING_NONPROP)

    def make(**given: Any) -> Any:
        parts = [given.pop(name) for name in groups]
        return kind(**given, **{name: value for part in parts for name, value in part.items()})

    return StructConstructorSpec(make, tuple(options.values()))


@functools.cache
def explanations(options: type) -> dict[str, str]:
    """Return what a docstring, and those of the classes that it extends, say of attributes."""
    found = {}
    for each in reversed(options.__mro__):
        _, _, attributes = inspect.cleandoc(each.__doc__ or "").partition("Attributes:\n")
        for name, text in re.findall(r"^    (\w+): (.*(?:\n {5,}.*)*)", attributes, re.MULTILINE):
            found[name] = re.sub(r"\s+", " ", text).replace("``", "")
    return found


def placeholder(kind: Any, text: str) -> str | None:
    """Return what stands for a value in the help; ``None`` for flags, choices and nested options.

    Args:
        kind: Type of the value.
        text: What its line of the docstring says.
    """
    kind = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    if get_origin(kind) in (Union, UnionType):
        kinds = [each for each in get_args(kind) if each is not NoneType]
        return placeholder(kinds[0], text) if len(kinds) == 1 else None
    units = re.findall(r"\[([^\]]+)\]", text)
    if get_origin(kind) is tuple:
        parts = get_args(kind)
        if parts[-1] is ...:
            each = placeholder(parts[0], text)
            return each and f"{each} ..."
        named = units[0].split(", ") if units else []
        return " ".join(_UNITS.get(unit, "NUMBER") for unit in named) if len(named) == len(parts) else None
    if kind is float and units and units[0] in _UNITS:
        return _UNITS[units[0]]
    begun = [name for beginning, name in _BEGINNINGS.items() if text.startswith(beginning)]
    if begun and kind in (float, str, Path):
        return begun[0]
    if kind is str and "a TOML file" in text:
        return "NAME|FILE"
    return _KINDS.get(kind)


def _shown(kind: Any, text: str, default: Any) -> Any:
    """Return a type with its placeholder, and with no default shown where it has none."""
    if is_dataclass(default) and not isinstance(default, ControllerSpec):
        # Its heading is its own name alone, however deep it lies.
        return Annotated[kind, tyro.conf.arg(prefix_name=False)]
    name = placeholder(kind, text)
    if name is not None and _is_positional(kind) and default is not MISSING_NONPROP:
        name = f"[{name}]"
    return Annotated[kind, tyro.conf.arg(metavar=name, help_behavior_hint="(optional)" if default is None else None)]


def _is_positional(kind: Any) -> bool:
    return get_origin(kind) is Annotated and tyro.conf.Positional in get_args(kind)


@registry.primitive_rule
def _controller(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[ControllerSpec] | None:
    if info.type is not ControllerSpec:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=_KINDS[ControllerSpec],
        instance_from_str=lambda words: ControllerSpec.parse(words[0]),
        is_instance=lambda value: isinstance(value, ControllerSpec),
        str_from_instance=lambda value: [value.label],
    )


@registry.primitive_rule
def _omittable(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Read ``float | None`` and its like: what is omitted is ``None``, and what is given is the other type."""
    if get_origin(info.type) not in (Union, UnionType):
        return None
    kinds = [kind for kind in get_args(info.type) if kind is not NoneType]
    if len(kinds) != 1 or len(kinds) == len(get_args(info.type)):
        return None
    kind = kinds[0]
    choices: tuple[str, ...] | None = None
    read: Callable[[list[str]], Any]
    if get_origin(kind) is Literal:
        choices = get_args(kind)
        read = _first(str)
    elif get_origin(kind) is tuple and get_args(kind)[-1] is ...:
        part = get_args(kind)[0]
        read = functools.partial(_each, part)
    elif kind is Event:
        read = _first(Event.parse)
    elif kind in _KINDS:
        read = _first(kind)
    else:
        return None
    return PrimitiveConstructorSpec(
        nargs="*" if get_origin(kind) is tuple else 1,
        metavar=f"{{{','.join(choices)}}}" if choices else _KINDS.get(kind, "NUMBER"),
        instance_from_str=read,
        is_instance=lambda value: value is None or choices is not None or isinstance(value, get_origin(kind) or kind),
        str_from_instance=lambda value: ["none" if value is None else getattr(value, "label", str(value))],
        choices=choices,
    )


def _first(read: Callable[[str], Any]) -> Callable[[list[str]], Any]:
    return lambda words: read(words[0])


def _each(read: Callable[[str], Any], words: list[str]) -> tuple[Any, ...]:
    return tuple(map(read, words))
