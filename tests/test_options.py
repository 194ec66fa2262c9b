"""How the command line reads and shows the options of dataclasses."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import pytest
import tyro

from triform.cli import COMMANDS, main
from triform.commands.options import CONFIG, explanations, placeholder, registry


@dataclass(frozen=True)
class Inner:
    """Nested options.

    Attributes:
        gap: Width of a gap
            in a wall [m].
    """

    gap: float | None = None


@dataclass(frozen=True)
class Base:
    """Options.

    Attributes:
        speed: Speed [m/s].
        start: Where it starts: x, y and heading [m, m, rad].
        shares: Shares of something; all of it if omitted.
    """

    speed: float = 1.0
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shares: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Outer(Base):
    """Options of a command.

    Attributes:
        mode: Its ``mode``.
        speed: Another speed [m/s].
        file: A file.
        inner: What is nested.
    """

    GROUPS: ClassVar[dict[str, tuple[str, ...]]] = {"motion": ("speed", "start")}

    mode: Literal["slow", "fast"] | None = None
    file: Annotated[Path | None, tyro.conf.Positional] = None
    inner: Inner = field(default_factory=Inner)


def parse(*words: str) -> Outer:
    return tyro.cli(Outer, args=words, config=CONFIG, registry=registry)


def test_options_are_flat_and_what_is_omitted_is_none() -> None:
    assert parse() == Outer()
    given = parse(
        "--speed", "2", "--start", "1", "2", "3", "--gap", "0.5", "--shares", "0.1", "0.2", "--mode", "fast", "x"
    )
    assert given == Outer(2.0, (1.0, 2.0, 3.0), (0.1, 0.2), "fast", Path("x"), Inner(0.5))


def test_choices_that_may_be_omitted_are_choices(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        parse("--mode", "sideways")
    assert ended.value.code == 2
    assert "slow" in capsys.readouterr().err


def test_the_help_has_headings_and_placeholders(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parse("--help")
    shown = " ".join(capsys.readouterr().out.split())
    for said in ("motion options", "inner options", "--speed M/S", "--start METRES METRES RADIANS", "--gap METRES",
                 "--shares SHARE ...", "--mode {slow,fast}", "[FILE]", "Another speed"):  # fmt: skip
        assert said in shown
    assert "None" not in shown
    assert "``" not in shown


def test_docstrings_explain_attributes_and_subclasses_have_the_last_word() -> None:
    found = explanations(Outer)
    assert found["speed"] == "Another speed [m/s]."
    assert found["mode"] == "Its mode."
    assert found["shares"] == "Shares of something; all of it if omitted."
    assert explanations(Inner)["gap"] == "Width of a gap in a wall [m]."


@pytest.mark.parametrize(
    ("kind", "text", "expected"),
    [
        (float, "How long [s].", "SECONDS"),
        (float | None, "How often [Hz].", "HERTZ"),
        (float, "Weight.", "NUMBER"),
        (int, "Runs of 5 [s].", "NUMBER"),
        (Path, "Folder for results.", "FOLDER"),
        (Path | None, "Where to.", "FILE"),
        (str, "Robot profile: a name or a TOML file.", "NAME|FILE"),
        (str, "Name.", "NAME"),
        (tuple[int, ...], "Team sizes.", "NUMBER ..."),
        (bool, "Whether.", None),
        (Literal["a", "b"], "Which.", None),
    ],
)
def test_placeholders(kind: object, text: str, expected: str | None) -> None:
    assert placeholder(kind, text) == expected


@pytest.mark.parametrize("name", COMMANDS)
def test_no_help_shows_what_only_python_knows(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([name, "--help"])
    shown = capsys.readouterr().out
    assert not {word for word in ("{None}", "None", "STR", "INT", "FLOAT", "``") if word in shown.split()}


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_of_a_command_is_explained(name: str) -> None:
    options = COMMANDS[name].load()
    assert set(options.__dataclass_fields__) - {"GROUPS"} <= set(explanations(options))
