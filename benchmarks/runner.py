"""Running groups: each in a process of its own, so that one that fails, or even crashes, loses no other."""

from __future__ import annotations

import os
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from benchmarks.machine import describe
from benchmarks.report import GroupResult, Row, write_report
from benchmarks.settings import Settings, Watch


@dataclass(frozen=True)
class Group:
    """Rows that are measured together.

    Attributes:
        name: Its name on the command line.
        title: Its heading in the report.
        measure: Yields the rows; a function of a module, so that another process can find it.
    """

    name: str
    title: str
    measure: Callable[[Settings, Watch], Iterator[Row]]


def run(groups: Iterable[Group], settings: Settings, output: Path, console: Console) -> list[GroupResult]:
    """Measure groups one after the other and write the report after each.

    Raises:
        TriformError: If the report cannot be written.
    """
    machine = describe(settings.cores)
    results: list[GroupResult] = []
    for group in groups:
        console.rule(group.title)
        results.append(_apart(group, settings))
        for row in results[-1].rows:
            console.print(f"{_mark(row)} {row.what}", markup=False, soft_wrap=True)
        if results[-1].failure:
            console.print(f"{group.name} failed: {results[-1].failure}", style="red", markup=False, soft_wrap=True)
        write_report(output, machine, results, settings.quick)
    return results


def _mark(row: Row) -> str:
    return {None: "  ", True: "✓ ", False: "✗ "}[row.reached]


def _apart(group: Group, settings: Settings) -> GroupResult:
    """Run a group in a fresh process."""
    load, began = os.getloadavg()[0], time.perf_counter()
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        try:
            rows, failure = pool.submit(_measure, group, settings).result()
        except Exception as error:  # noqa: BLE001 - whatever ended the process, the other groups go on
            rows, failure = [], f"its process ended: {error}"
    return GroupResult(group.name, group.title, rows, time.perf_counter() - began, load, failure)


def _measure(group: Group, settings: Settings) -> tuple[list[Row], str | None]:
    """In the group's own process: its rows, and why it did not finish."""
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: settings.cores])
    rows: list[Row] = []
    with Progress(
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        transient=True,
    ) as bar:
        task = bar.add_task("starting", total=None)

        def watch(what: str, done: int, total: int) -> None:
            bar.update(task, description=what, completed=done, total=total)

        try:
            # Row by row, so that those before a failure are kept.
            rows.extend(group.measure(settings, watch))
        except Exception as error:  # noqa: BLE001 - rows that were finished are kept
            traceback.print_exc()
            return rows, f"{type(error).__name__}: {error}"
    return rows, None
