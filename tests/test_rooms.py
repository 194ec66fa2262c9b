"""What begins with an underscore belongs to its own room: no other one imports it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import triform

PACKAGE = Path(triform.__file__).parent


def imported(path: Path, package: Path) -> Iterator[str]:
    """Full names of all that a file imports, the modules and the names in them."""
    parts = ("triform", *path.relative_to(package).with_suffix("").parts)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (each.name for each in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = list(parts[: -node.level]) if node.level else []
            yield from (".".join([*base, *filter(None, [node.module]), each.name]) for each in node.names)


def trespasses(package: Path) -> list[str]:
    """Imports of a room's underscored modules, or of underscored names in its modules, from outside the room."""
    found = []
    for path in sorted(package.rglob("*.py")):
        room = path.relative_to(package).with_suffix("").parts[0]
        for name in imported(path, package):
            first, *inner = name.split(".")
            private = any(part.startswith("_") and not part.startswith("__") for part in inner[1:])
            if first == "triform" and inner and inner[0] != room and private:
                found.append(f"{path.relative_to(package)} imports {name}")
    return found


def test_no_room_imports_what_is_private_to_another() -> None:
    assert trespasses(PACKAGE) == []


@pytest.mark.parametrize(
    ("line", "caught"),
    [
        ("from triform.geometry._search import cells", True),
        ("from triform.geometry import _search", True),
        ("import triform.geometry._search", True),
        ("from ..geometry._search import cells", True),
        ("from triform.geometry.cells import _split", True),
        ("from triform.control._fit import fit", False),
        ("from ._fit import fit", False),
        ("from triform import __version__", False),
        ("from numba.core import _private", False),
    ],
)
def test_trespasses_are_found(line: str, caught: bool, tmp_path: Path) -> None:
    (tmp_path / "control").mkdir()
    (tmp_path / "control" / "expert.py").write_text(f"def work():\n    {line}\n")
    assert bool(trespasses(tmp_path)) == caught
