"""How runs of thirteen robots end, by formation error: complete triangulations and misfit robots in them.

Run: python benchmarks/strained.py (about 15 s). Prints a Markdown table.
"""

from __future__ import annotations

import itertools

import numpy as np

from triform.evaluation.scenario import Scenario
from triform.geometry import gabriel_graph
from triform.simulation import sample_starts
from triform.types import BoolArray, FloatArray

ROBOTS, RUNS, SEED = 13, 100, 7
BINS = (0.0, 0.025, 0.06, 0.1, np.inf)


def is_complete(graph: BoolArray) -> bool:
    """Whether a connected graph (N, N) has only triangles as bounded faces, whatever their size, and no loose edge."""
    links = graph.astype(int)
    triangles = np.trace(links @ links @ links) // 6
    every_edge = bool(((links @ links)[graph] > 0).all())
    return every_edge and triangles == links.sum() // 2 - len(graph) + 1


def has_misfit(graph: BoolArray, positions: FloatArray) -> bool:
    """Whether a robot that is surrounded has other than six neighbours."""
    for i in range(len(graph)):
        around = np.flatnonzero(graph[i])
        bearing = np.sort(np.arctan2(*(positions[around] - positions[i]).T[::-1]))
        if len(around) < 4 or len(around) == 6:
            continue
        if np.diff(np.append(bearing, bearing[0] + 2 * np.pi)).max() < 1.8:
            return True
    return False


def main() -> None:
    """Print the table."""
    scenario = Scenario()
    poses = sample_starts(ROBOTS, RUNS, SEED)
    trajectory, table = scenario.run(poses, seed=SEED)
    errors = table["formation_error"]
    ends = trajectory.poses[:, -1, :, :2]
    graphs = gabriel_graph(ends)
    complete = np.array([is_complete(graph) for graph in graphs])
    misfit = np.array([has_misfit(graph, end) for graph, end in zip(graphs, ends, strict=True)])
    print("| formation error | runs | complete triangulations | with a misfit robot |\n|---|---|---|---|")
    for low, high in itertools.pairwise(BINS):
        chosen = (errors >= low) & (errors < high)
        name = f"{100 * low:g} to {100 * high:g} %" if np.isfinite(high) else f"above {100 * low:g} %"
        print(f"| {name} | {chosen.sum()} | {complete[chosen].sum()} | {misfit[chosen].sum()} |")


if __name__ == "__main__":
    main()
