"""Draw the curves of training runs: the loss, and the error of a command on held-out demonstrations.

Run: python benchmarks/training_curve.py PICTURE RUN [RUN ...], with the folders of `triform train`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from triform.figures.style import figure_style, save_figure


def scalars(run: Path, name: str) -> tuple[list[int], list[float]]:
    """Maps seen and values of a scalar in a run's log."""
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    found = [(line["maps"], line[name]) for line in lines if line.get(name) is not None]
    return [maps for maps, _ in found], [value for _, value in found]


def draw(runs: list[Path]) -> Figure:
    """Both curves of every run over the maps it has seen."""
    names = (
        ("loss", "command loss (mean square for paper)"),
        ("error_mean", "mean error of a command, held out [m/s]"),
    )
    with figure_style():
        figure, panels = plt.subplots(1, 2, figsize=(10, 4))
        for panel, (name, label) in zip(panels, names, strict=True):
            for run in runs:
                panel.plot(*scalars(run, name), label=run.name, marker="." if name == "error_mean" else "")
            panel.set(xscale="log", yscale="log", xlabel="maps seen", ylabel=label)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(runs))
    return figure


def main() -> None:
    """Read the arguments and write the picture."""
    picture, *runs = (Path(argument) for argument in sys.argv[1:])
    save_figure(draw(runs), picture)


if __name__ == "__main__":
    main()
