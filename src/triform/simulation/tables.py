"""Profiles and arenas in TOML: read with one sentence for what is wrong, and written to start from."""

from __future__ import annotations

import math
import sys
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from triform.files import refuse_device
from triform.types import ConfigurationError, nearest


@dataclass(frozen=True)
class TomlTable:
    """A table of a TOML file whose values are taken out one by one, each checked.

    Attributes:
        path: The file.
        values: What the file says.
        section: Name of the table; empty for the top.
    """

    path: Path
    values: Mapping[str, Any]
    section: str = ""

    @classmethod
    def read(cls, path: Path) -> TomlTable:
        """Read a file.

        Raises:
            ConfigurationError: It cannot be read, or is no TOML.
        """
        try:
            refuse_device(path)
            return cls(path, tomllib.loads(path.read_text(encoding="utf-8")))
        except OSError as error:
            raise ConfigurationError(f"{path} cannot be read: {(error.strerror or str(error)).lower()}") from None
        except (ValueError, RecursionError) as error:
            # Numbers too long to read are a ValueError of their own.
            raise ConfigurationError(f"{path} is no TOML file: {error}") from None

    def known(self, *keys: str) -> None:
        """Refuse keys that are none of these."""
        for key in self.values:
            if key not in keys:
                raise ConfigurationError(
                    f"{self.path}: there is no key {self._name(key)!r}{nearest(key, keys)}; allowed are "
                    f"{', '.join(keys)}"
                )

    def table(self, key: str) -> TomlTable:
        """Return the table ``key``, empty if the file has none."""
        value = self._checked(key, {}, lambda value: isinstance(value, dict), "a table")
        return TomlTable(self.path, value, self._name(key))

    def number(self, key: str, default: float) -> float:
        """Return a number; ``inf`` counts as one."""
        return float(self._checked(key, default, _is_number, "a number"))

    def whole(self, key: str, default: int) -> int:
        """Return a whole number."""
        return int(self._checked(key, default, lambda value: type(value) is int, "a whole number"))

    def flag(self, key: str, default: bool) -> bool:
        """Return true or false."""
        return bool(self._checked(key, default, lambda value: isinstance(value, bool), "true or false"))

    def text(self, key: str, default: str) -> str:
        """Return a text."""
        return str(self._checked(key, default, lambda value: isinstance(value, str), "a text"))

    def rows(self, key: str, columns: int, what: str, spare: int = 0) -> list[list[float]]:
        """Return rows of finite numbers, and up to ``spare`` more in each; none if the file has no such key."""
        value = self.values.get(key, [])
        for row in value if isinstance(value, list) else [value]:
            if not any(are_numbers(row, columns + more) for more in range(spare + 1)):
                raise self.wrong(key, row, f"rows of {columns} numbers are needed: {what}")
        return [[float(number) for number in row] for row in value]

    def tables(self, key: str, example: str) -> list[TomlTable]:
        """Return the tables of a list, none if the file has no such key."""
        value = self.values.get(key, [])
        if not isinstance(value, list) or not all(isinstance(each, dict) for each in value):
            raise self.wrong(key, value, f"a list of tables is needed, such as {example}")
        return [TomlTable(self.path, each, f"{self._name(key)}[{index}]") for index, each in enumerate(value)]

    def wrong(self, key: str, value: Any, needed: str) -> ConfigurationError:
        """Return the error of a value that is not allowed."""
        return ConfigurationError(f"{self.path}: {self._name(key)} is {value!r}; {needed}")

    def refused(self, error: ConfigurationError) -> ConfigurationError:
        """Return the error of values that do not go together."""
        where = f", table {self.section}" if self.section else ""
        return ConfigurationError(f"{self.path}{where}: {error}")

    def _checked(self, key: str, default: Any, allowed: Callable[[Any], bool], needed: str) -> Any:
        value = self.values.get(key, default)
        if not allowed(value):
            raise self.wrong(key, value, f"{needed} is needed")
        return value

    def _name(self, key: str) -> str:
        return f"{self.section}.{key}" if self.section else key


def are_numbers(value: Any, count: int) -> bool:
    """Tell whether a value is a list of so many numbers."""
    return isinstance(value, list) and len(value) == count and all(_is_number(each) for each in value)


def _is_number(value: Any) -> bool:
    """Tell whether a value is a number that a float can hold."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return not math.isnan(value) if isinstance(value, float) else abs(value) <= sys.float_info.max


def quoted(text: str) -> str:
    """Return a text as TOML spells it."""
    escapes = {'"': '\\"', "\\": "\\\\"}
    # Control characters are not allowed as they are.
    spelled = (escapes.get(each) or (f"\\u{ord(each):04x}" if each < " " or each == "\x7f" else each) for each in text)
    return '"' + "".join(spelled) + '"'
