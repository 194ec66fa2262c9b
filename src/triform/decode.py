"""From JSON to checked values: what a file holds is read exactly, or refused in a sentence."""

from __future__ import annotations

import json
import reprlib
import types
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from triform.files import sha256
from triform.types import ConfigurationError, TriformError, require

Decoded = TypeVar("Decoded")

#: Nothing that is written here nests deeper.
_DEEPEST = 50
_NAMES = {bool: "true or false", int: "a whole number", float: "a number", str: "a text", dict: "an object"}


def decode_json(data: bytes, source: str) -> Any:
    """Read JSON.

    Args:
        data: Its bytes.
        source: What it was read from, for errors.

    Raises:
        TriformError: If it is no JSON, or nests too deeply to be read.
    """
    try:
        values = json.loads(data)
        deep = _nests(values, _DEEPEST)
    except RecursionError:
        deep = True
    except ValueError as error:
        raise TriformError(f"{source} cannot be read: {error}") from error
    if deep:
        raise TriformError(f"{source} cannot be read: its lists or objects nest too deeply")
    return values


def _nests(value: Any, levels: int) -> bool:
    """Whether lists and objects lie in each other deeper than some levels."""
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return levels == 0 or any(_nests(each, levels - 1) for each in parts)


def checksum(values: Mapping[str, Any]) -> str:
    """Checksum of all that a JSON object holds, whatever the order of its keys and the white space between them."""
    return sha256(json.dumps(values, sort_keys=True).encode())


def decode_dataclass(kind: type[Decoded], values: object, name: str) -> Decoded:
    """Make a dataclass of the object that describes it, which must hold each of its fields and nothing else.

    Args:
        kind: The dataclass.
        values: What JSON holds.
        name: What it describes, for errors.

    Raises:
        ConfigurationError: If a value is missing, unknown, of another type or not allowed.
    """
    return kind(**decode_fields(kind, values, name, partial=False))


def decode_fields(kind: type, values: object, name: str, *, partial: bool = True) -> dict[str, Any]:
    """Return the arguments of a dataclass from the object that describes it.

    Args:
        kind: The dataclass.
        values: What JSON holds.
        name: What it describes, for errors.
        partial: Whether fields may be missing.

    Raises:
        ConfigurationError: As ``decode_dataclass``.
    """
    hints, known = get_type_hints(kind), {each.name for each in fields(kind)}
    if not isinstance(values, dict) or not set(values) <= known or not (partial or set(values) == known):
        raise ConfigurationError(
            f"{name} must hold {'only' if partial else 'exactly'} the values {', '.join(sorted(known))}"
        )
    return {key: _decode(hints[key], value, f"{name}.{key}") for key, value in values.items()}


def _decode(kind: Any, value: Any, name: str) -> Any:
    """A value of the type ``kind``, one of those that configurations use; numbers are never taken for truth values."""
    origin, parts = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if is_dataclass(kind):
        return decode_dataclass(kind, value, name)  # type: ignore[arg-type]
    if origin in (Union, types.UnionType):
        (some,) = (each for each in parts if each is not types.NoneType)
        return None if value is None else _decode(some, value, name)
    if origin is tuple:
        require(isinstance(value, list), f"{name} is {reprlib.repr(value)}; a list is needed")
        each = parts[:1] * len(value) if parts[-1] is Ellipsis else parts
        require(len(value) == len(each), f"{name} holds {len(value)} values; {len(each)} are needed")
        return tuple(_decode(part, item, name) for part, item in zip(each, value, strict=True))
    if origin is Literal:
        require(value in parts, f"{name} is {reprlib.repr(value)}; it must be {' or '.join(parts)}")
        return value
    if origin is dict:
        require(isinstance(value, dict), f"{name} is {reprlib.repr(value)}; an object is needed")
        return {key: _decode(parts[1], item, f"{name}.{key}") for key, item in value.items()}
    fits = type(value) is kind or (kind is float and type(value) is int and abs(value) < 2**53)
    require(fits, f"{name} is {reprlib.repr(value)}; {_NAMES[kind]} is needed")
    return kind(value)
