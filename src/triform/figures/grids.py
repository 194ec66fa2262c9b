"""Figures of grids: a controller under many conditions, and the law without each of its terms."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from triform.evaluation.rollout import Trajectory
from triform.figures.runs import Scene, draw_trajectories
from triform.figures.style import BLUE, GREY, INK, SERIES, figure_style, graph_legend
from triform.types import FloatArray

_COLUMNS = 4
#: Labels longer than this stand on a slope.
_LONG_LABEL = 4


@dataclass(frozen=True)
class FailedRun:
    """A run that did not end as it should.

    Attributes:
        trajectory: The run, B = 1.
        scene: What surrounds it.
        title: Which run it is.
    """

    trajectory: Trajectory
    scene: Scene
    title: str


def conditions_figure(summaries: Sequence[dict[str, Any]], headings: Mapping[str, str]) -> Figure:
    """Draw the strict and the success rate over the values of every condition, one panel per condition.

    Bars are Wilson's 95 % intervals.

    Args:
        summaries: What ``Grid.summaries`` returned.
        headings: What is varied, with the unit, by condition, in the order of the panels.
    """
    found = {summary["condition"] for summary in summaries}
    shown = [condition for condition in headings if condition in found]
    sizes = sorted({summary["robots"] for summary in summaries if summary["condition"] != "team-size"})
    colours = {size: SERIES[index % len(SERIES)] for index, size in enumerate(sizes)}
    columns = min(_COLUMNS, len(shown))
    rows = math.ceil(len(shown) / columns)
    with figure_style():
        figure, panels = plt.subplots(rows, columns, figsize=(3.1 * columns, 2.75 * rows + 0.4), squeeze=False)
        for axes, condition in zip(panels.flat, shown, strict=False):
            own = [summary for summary in summaries if summary["condition"] == condition]
            _draw_condition(axes, condition, headings[condition], own, colours)
        for axes in panels.flat[len(shown) :]:
            axes.set_axis_off()
        for axes in panels[:, 0]:
            axes.set_ylabel("runs [%]")
        handles = [Line2D([], [], color=colour, lw=3, label=f"{size} robots") for size, colour in colours.items()]
        handles += [
            Line2D([], [], color=GREY, marker="o", ms=5, label="strict"),
            Line2D([], [], color=GREY, marker="s", ms=5, mfc="white", ls=(0, (2, 2)), label="success"),
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


def _draw_condition(
    axes: Axes, condition: str, heading: str, summaries: Sequence[dict[str, Any]], colours: dict[int, str]
) -> None:
    labels = list(dict.fromkeys(summary["label"] for summary in summaries))
    # In the panel of team sizes, all belong to one series.
    series = [None] if condition == "team-size" else [size for size in colours if _of_size(summaries, size)]
    drawn = [(size, measure) for size in series for measure in ("success", "strict")]
    for index, (size, measure) in enumerate(drawn):
        own = list(summaries) if size is None else _of_size(summaries, size)
        if measure == "strict":
            # Two robots can never be strict, which is no failure.
            own = [summary for summary in own if summary["robots"] > 2]
        if not own:
            continue
        # Side by side, because many values are equal.
        aside = 0.11 * (index - (len(drawn) - 1) / 2)
        rates, bars = _rates(own, measure)
        strict = measure == "strict"
        axes.errorbar(
            [labels.index(summary["label"]) + aside for summary in own],
            rates,
            yerr=bars,
            color=INK if size is None else colours[size],
            marker="o" if strict else "s",
            mfc=None if strict else "white",
            ms=4,
            lw=0.9 if strict else 0.7,
            ls="none" if condition in ("footprint", "arena", "event") else "-" if strict else (0, (2, 2)),
            elinewidth=0.8,
            clip_on=False,
            zorder=3 if strict else 2,
        )
    slope: dict[str, Any] = {"rotation": 30, "ha": "right", "rotation_mode": "anchor"}
    axes.set_xticks(range(len(labels)), labels, **(slope if max(map(len, labels)) > _LONG_LABEL else {}))
    axes.set_xlim(-0.5, len(labels) - 0.5)
    axes.set_ylim(0, 102)
    axes.set_title(heading, loc="left")
    axes.grid(visible=False, axis="x")


def _rates(summaries: Sequence[dict[str, Any]], measure: str) -> tuple[FloatArray, FloatArray]:
    """Return rates (K,) and the lengths of their bars, below and above (2, K) [%]."""
    rates = np.array([100 * summary[measure] for summary in summaries])
    low, high = 100 * np.array([summary[f"{measure}_interval"] for summary in summaries]).T
    return rates, np.maximum(0.0, [rates - low, high - rates])


def _of_size(summaries: Sequence[dict[str, Any]], size: int) -> list[dict[str, Any]]:
    return [summary for summary in summaries if summary["robots"] == size]


def failures_figure(runs: Sequence[FailedRun]) -> Figure:
    """Draw failed runs side by side: where every robot started (ring), went (line) and ended, and the final graph."""
    columns = min(_COLUMNS, len(runs))
    rows = math.ceil(len(runs) / columns)
    with figure_style():
        figure, panels = plt.subplots(rows, columns, figsize=(3.3 * columns, 3.4 * rows + 0.35), squeeze=False)
        for axes, run in zip(panels.flat, runs, strict=False):
            draw_trajectories(axes, run.trajectory, run.scene)
            axes.set_title(run.title, loc="left", fontsize=8)
        for axes in panels.flat[len(runs) :]:
            axes.set_axis_off()
        graph_legend(figure)
    return figure


#: Marker, colour, filling and place beside the row's line of each measure.
_ABLATION_MEASURES = (("success", "s", GREY, "white", 0.17), ("strict", "o", BLUE, BLUE, -0.17))


def ablation_figure(summaries: Sequence[dict[str, Any]], labels: Sequence[str]) -> Figure:
    """Draw the strict and the success rate of every variant, one panel per team size.

    Bars are Wilson's 95 % intervals; the vertical line is the strict rate of the first variant.

    Args:
        summaries: What ``Grid.summaries`` returned.
        labels: Names of the variants, from top to bottom.
    """
    sizes = list(dict.fromkeys(summary["robots"] for summary in summaries))
    with figure_style():
        figure, panels = plt.subplots(
            1, len(sizes), figsize=(1.4 + 1.9 * len(sizes), 0.9 + 0.24 * len(labels)), sharey=True, squeeze=False
        )
        for axes, size in zip(panels.flat, sizes, strict=True):
            own = [summary for summary in summaries if summary["robots"] == size]
            places = np.array([labels.index(summary["label"]) for summary in own])
            for measure, marker, colour, filling, aside in _ABLATION_MEASURES:
                rates, bars = _rates(own, measure)
                axes.errorbar(
                    rates, places + aside, xerr=bars, ls="none", marker=marker, ms=4, color=colour, mfc=filling,
                    elinewidth=0.8, clip_on=False, zorder=3, label=measure,
                )  # fmt: skip
            for summary in own:
                if summary["label"] == labels[0]:
                    axes.axvline(100 * summary["strict"], color=INK, lw=0.7, ls=(0, (3, 3)), zorder=1)
            axes.set_xlim(0, 102)
            axes.set_ylim(len(labels) - 0.5, -0.5)
            axes.set_yticks(range(len(labels)), labels)
            axes.set_title(f"{size} robots", loc="left")
            axes.set_xlabel("runs [%]")
        handles, names = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles[::-1], names[::-1], loc="outside lower center", ncols=2)
    return figure
