"""The command line: parses, calls, prints."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import field, fields, make_dataclass
from typing import Annotated, Any

import tyro
from rich.console import Console

from triform import __version__
from triform.types import TriformError

#: Extras of the package, by the modules that they install.
_EXTRAS = {
    "pyarrow": "evaluate",
    "matplotlib": "evaluate",
    "PIL": "evaluate",
    "torch": "train",
    "safetensors": "train",
    "tensorboard": "train",
    "onnx": "train",
    "ray": "ray",
    "serial": "robot",
}


def _collect() -> tuple[Any, Callable[..., Any]]:
    from triform.commands import Collect

    return Collect, Collect.run


def _train() -> tuple[Any, Callable[..., Any]]:
    from triform.commands import Train

    return Train, Train.run


def _export() -> tuple[Any, Callable[..., Any]]:
    from triform.commands import Export

    return Export, Export.run


def _evaluate() -> tuple[Any, Callable[..., Any]]:
    from triform.recordings.measure import RecordedConfig, run_evaluate

    return RecordedConfig, run_evaluate


def _dynamic() -> tuple[Any, Callable[..., Any]]:
    from triform.experiments.dynamic import DynamicConfig, run_dynamic

    return DynamicConfig, run_dynamic


def _conditions() -> tuple[Any, Callable[..., Any]]:
    from triform.experiments.conditions import ConditionsConfig
    from triform.experiments.sweep import run_conditions

    return ConditionsConfig, run_conditions


def _ablate() -> tuple[Any, Callable[..., Any]]:
    from triform.experiments.ablation import CHOSEN, AblateConfig, run_ablate

    return _without(AblateConfig, CHOSEN), run_ablate


def _compare() -> tuple[Any, Callable[..., Any]]:
    from triform.experiments.compare import CHOSEN, CompareConfig, run_compare

    return _without(CompareConfig, CHOSEN), run_compare


def _without(options: type[Any], names: Sequence[str]) -> Any:
    """Return options that are not shown the names that the command chooses itself."""
    hidden = [
        (each.name, Annotated[Any, tyro.conf.Suppress], field(default=each.default))
        for each in fields(options)
        if each.name in names
    ]
    chosen = make_dataclass(options.__name__, hidden, bases=(options,), frozen=True)
    chosen.__doc__ = options.__doc__
    return chosen


def _reproduce() -> tuple[Any, Callable[..., Any]]:
    from triform.experiments.reproduce import ReproduceConfig, What, reproduce

    what = ("what", Annotated[What, tyro.conf.Positional], field(default="all"))
    options = make_dataclass("Reproduce", [what], bases=(ReproduceConfig,), frozen=True)
    options.__doc__ = ReproduceConfig.__doc__
    return options, reproduce


def _demo() -> tuple[Any, Callable[..., Any]]:
    from triform.experiments.demo import DemoConfig, run_demo

    return DemoConfig, run_demo


def _drive() -> tuple[Any, Callable[..., Any]]:
    from triform.robots.drive import DriveConfig, run_drive

    return DriveConfig, run_drive


def _bench() -> tuple[Any, Callable[..., Any]]:
    from triform.timing.robot import BenchConfig, run_bench

    return BenchConfig, run_bench


def _emulate() -> tuple[Any, Callable[..., Any]]:
    from triform.robots.emulate import EmulateConfig, run_emulate

    return EmulateConfig, run_emulate


#: What each command does, and how to load its options and its function.
COMMANDS: dict[str, tuple[str, Callable[[], tuple[Any, Callable[..., Any]]]]] = {
    "demo": ("run one team and draw it", _demo),
    "evaluate": ("measure a controller on many starts, or recorded runs", _evaluate),
    "dynamic": ("measure teams that a robot joins or leaves", _dynamic),
    "conditions": ("measure a controller under many conditions", _conditions),
    "ablate": ("measure the triangulating law without each of its terms", _ablate),
    "compare": ("measure controllers side by side", _compare),
    "reproduce": ("write the paper's tables and figures", _reproduce),
    "drive": ("drive one robot, LiDAR to wheels", _drive),
    "emulate": ("emulate robots, byte for byte, to drive without any", _emulate),
    "bench": ("time one robot's way from scan to command on this computer", _bench),
    "collect": ("collect demonstrations", _collect),
    "train": ("train a policy", _train),
    "export": ("make a trained policy run without PyTorch", _export),
}


def _overview() -> str:
    lines = [f"triform {__version__}", "", "usage: triform COMMAND [options]", ""]
    lines += [f"  {name:<10} {summary}" for name, (summary, _) in COMMANDS.items()]
    return "\n".join([*lines, "", "triform COMMAND --help shows a command's options."])


def _kernels_missing() -> bool:
    """Whether the command that follows compiles its kernels first."""
    from triform.kernels import kernels_compiled

    return not kernels_compiled()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status: 0 done, 1 it could not be done, 2 wrong usage."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    errors = Console(stderr=True)
    if given in (["--version"], ["--help"], ["-h"]):
        sys.stdout.write((__version__ if given == ["--version"] else _overview()) + "\n")
        return 0
    if not given or given[0] not in COMMANDS:
        problem = f"there is no command {given[0]!r}" if given else "a command is missing"
        sys.stderr.write(f"triform: {problem}\n\n{_overview()}\n")
        return 2
    try:
        options, run = COMMANDS[given[0]][1]()
        chosen = tyro.cli(options, prog=f"triform {given[0]}", args=given[1:])
        if _kernels_missing():
            sys.stderr.write("compiling kernels, once after an installation: about a minute\n")
        run(chosen, Console())
    except TriformError as error:
        errors.print(f"triform: {error}", style="red", markup=False, highlight=False, soft_wrap=True)
        return 1
    except ModuleNotFoundError as error:
        extra = _EXTRAS.get((error.name or "").split(".")[0])
        if extra is None:
            raise
        sys.stderr.write(f"triform: {given[0]} needs {error.name}; install it with: pip install 'triform[{extra}]'\n")
        return 1
    except KeyboardInterrupt:
        sys.stderr.write("triform: interrupted; files written so far are kept; train goes on with --resume\n")
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
