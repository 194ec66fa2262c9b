"""The figure of an ablation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from triform.figures.style import BLUE, GREY, INK, Figure, figure_style, plt

#: Marker, colour, filling and place beside the row's line of each measure.
_MEASURES = (("success", "s", GREY, "white", 0.17), ("strict", "o", BLUE, BLUE, -0.17))


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
            for measure, marker, colour, filling, aside in _MEASURES:
                rates = np.array([100 * summary[measure] for summary in own])
                low, high = 100 * np.array([summary[f"{measure}_interval"] for summary in own]).T
                axes.errorbar(
                    rates, places + aside, xerr=np.maximum(0.0, [rates - low, high - rates]), ls="none", marker=marker,
                    ms=4, color=colour, mfc=filling, elinewidth=0.8, clip_on=False, zorder=3, label=measure,
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
