"""The command line: a table of commands; each is loaded when it is called."""

from __future__ import annotations

import importlib
import io
import os
import reprlib
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from triform.types import TriformError, nearest, printable
from triform.version import __version__

#: Extra and package of the modules that extras install.
_EXTRAS = {
    "pyarrow": ("evaluate", "pyarrow"),
    "matplotlib": ("evaluate", "matplotlib"),
    "PIL": ("evaluate", "pillow"),
    "torch": ("train", "torch"),
    "safetensors": ("train", "safetensors"),
    "tensorboard": ("train", "tensorboard"),
    "onnx": ("train", "onnx"),
    "mujoco": ("mujoco", "MuJoCo"),
    "ray": ("ray", "ray"),
    "serial": ("robot", "pyserial"),
    "foxglove": ("mcap", "foxglove-sdk"),
    "mcap": ("mcap", "mcap"),
    "google": ("mcap", "protobuf"),
    "rosbags": ("mcap", "rosbags"),
    "viser": ("view", "viser"),
    "av": ("video", "PyAV"),
}


@dataclass(frozen=True)
class Command:
    """A command of the command line.

    Attributes:
        group: What people do with it.
        name: Its name.
        summary: What it does.
        example: A command line.
        library: Module of its work, with ``NameConfig`` and ``run_name(config, listener)``; if empty, the command has
            a file ``commands/name.py`` of its own, with a class ``Name`` that has ``run(console)``.
    """

    group: str
    name: str
    summary: str
    example: str
    library: str = ""

    def load(self) -> Any:
        """Import the class of the options, which has ``run(console)``."""
        title = self.name.capitalize()
        if not self.library:
            return getattr(importlib.import_module(f"triform.commands.{self.name}"), title)
        from triform.commands.terminal import on_terminal

        module = importlib.import_module(f"triform.{self.library}")
        return on_terminal(title, getattr(module, f"{title}Config"), getattr(module, f"run_{self.name}"))


_TABLE = (
    ("look", "demo", "run one team and draw it", "--robots 9", "experiments.demo"),
    ("look", "view", "watch a team in the browser, and reach into it", "--robots 9"),
    ("look", "gallery", "draw a page of pictures, each with its command", "--output gallery", "experiments.gallery"),
    ("look", "show", "list profiles, arenas, controllers, policies; print one as TOML", "profile hardware"),
    (
        "measure", "evaluate", "measure a controller on many starts", "--robots 5 9 --runs 100 --json out.json",
        "experiments.evaluate",
    ),
    (
        "measure", "compare", "measure controllers side by side", "--controllers policy mine.py:Springs",
        "experiments.compare",
    ),
    (
        "measure", "conditions", "measure a controller under many conditions", "--which latency arena",
        "experiments.conditions",
    ),
    (
        "measure", "ablate", "measure the triangulating law without each of its terms", "--robots 5 9",
        "experiments.ablation",
    ),
    ("measure", "reproduce", "write the paper's tables and figures", "table1 --runs 100"),
    ("measure", "measure", "measure recorded runs", "take.csv --figures figures"),
    ("learn", "collect", "collect demonstrations", "--preset quick --out data"),
    ("learn", "train", "train a policy", "--preset default --out runs/mine"),
    ("learn", "export", "make a trained policy run without PyTorch", "runs/mine/best"),
    ("drive", "drive", "drive one robot, LiDAR to wheels", "--lidar /dev/ttyUSB0"),
    ("drive", "emulate", "emulate robots, byte for byte, to drive without any", "--robots 4"),
    ("drive", "bench", "time one robot's way from scan to command on this computer", "--rate 8", "timing.robot"),
)  # fmt: skip
COMMANDS = {
    name: Command(group, name, summary, f"triform {name} {example}", *library)
    for group, name, summary, example, *library in _TABLE
}


def _overview() -> str:
    lines = [f"triform {__version__}", "", "usage: triform COMMAND [options]"]
    for group in dict.fromkeys(command.group for command in COMMANDS.values()):
        lines += ["", f"{group}:"]
        for name, command in COMMANDS.items():
            if command.group == group:
                lines += [f"  {name:<11}{command.summary}", f"             {command.example}"]
    return "\n".join([*lines, "", "triform COMMAND --help shows a command's options."])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status: 0 done, 1 it could not be done, 2 wrong usage."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with _output():
            return _run(given)
    except TriformError as error:
        _complain(str(error))
    except ModuleNotFoundError as error:
        extra, package = _EXTRAS.get((error.name or "").split(".")[0], ("", ""))
        if not extra:
            raise
        _complain(
            f"{given[0]} needs {package}, which the extra {extra!r} installs: pip install 'triform[{extra}]', or in a "
            f"checkout pip install '.[{extra}]'"
        )
    except BrokenPipeError:
        # Whoever read the output has seen enough.
        _drop_output()
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        if error.filename is None:
            # Errors of files name their file; this is one of the output.
            _drop_output()
            _complain(f"cannot write the output: {reason}; files written so far are kept")
        else:
            _complain(f"cannot use {reprlib.repr(str(error.filename))}: {reason}")
    except MemoryError:
        _complain("there is not enough memory for this; files written so far are kept")
    except KeyboardInterrupt:
        _complain("interrupted; files written so far are kept; train goes on with --resume")
        return 130
    return 1


def _run(given: list[str]) -> int:
    """Run the command line and return its exit status, unless an error ends it."""
    if given in (["--version"], ["--help"], ["-h"]):
        sys.stdout.write((__version__ if given == ["--version"] else _overview()) + "\n")
        return 0
    if not given or given[0] not in COMMANDS:
        problem = f"there is no command {given[0]!r}{nearest(given[0], COMMANDS)}" if given else "a command is missing"
        _say(f"triform: {problem}\n\n{_overview()}")
        return 2
    command = COMMANDS[given[0]]
    options = command.load()
    from triform.commands.options import CONFIG, registry

    description = f"{command.summary[0].upper()}{command.summary[1:]}. Example: {command.example}"
    with _printable_errors(given):
        chosen = tyro.cli(
            options,
            prog=f"triform {given[0]}",
            args=given[1:],
            description=description,
            config=CONFIG,
            registry=registry,
        )
    from triform.kernels import kernels_compiled

    if not kernels_compiled():
        _say("compiling kernels, once after an installation: about a minute")
    # What users name files and what other programs say is text, not markup.
    chosen.run(Console(markup=False, emoji=False, highlight=False))
    return 0


@contextmanager
def _printable_errors(given: list[str]) -> Iterator[None]:
    """Show arguments that steer a terminal as their escapes in what tyro says of them."""
    if all(map(str.isprintable, given)):
        yield
        return
    held = io.StringIO()
    try:
        with redirect_stderr(held):
            yield
    finally:
        _say("\n".join(map(printable, held.getvalue().split("\n"))))


@contextmanager
def _output() -> Iterator[None]:
    """Make the streams of the program take all text, and find out that they cannot be written before it ends."""
    # A shell can close them (>&-).
    sys.stdout = sys.stdout or Path(os.devnull).open("w")  # noqa: SIM115
    sys.stderr = sys.stderr or Path(os.devnull).open("w")  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        yield
    finally:
        sys.stdout.flush()


def _complain(sentence: str) -> None:
    """Say on standard error why a command ends."""
    _say(f"triform: {printable(sentence)}", "red")


def _say(text: str, style: str | None = None) -> None:
    """Show text on standard error, as far as anything can be shown there."""
    with suppress(OSError):
        Console(stderr=True, markup=False, emoji=False, highlight=False).print(text, style=style, soft_wrap=True)


def _drop_output() -> None:
    """Drop what is still in the buffer of standard output, which would fail once more when the program ends."""
    with suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)


if __name__ == "__main__":
    sys.exit(main())
