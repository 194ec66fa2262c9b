"""The page over a controller under many conditions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from triform.evaluation.incidents import MEETING, MEETING_GAP, PUSH_LENGTH
from triform.evaluation.overrides import FOOTPRINTS
from triform.experiments.conditions import SWEEPS, Condition, ConditionsConfig
from triform.report.page import Section
from triform.report.tables import format_value
from triform.simulation import Footprint

#: Heading, key in a summary and format of the columns after value, robots, runs and intervals.
_COLUMNS = (
    ("hold", "strict_hold_mean", "%"),
    ("strict at", "strict_time_median", "s"),
    ("drift", "settled_speed_median", "cm/s"),
    ("median error", "formation_error_median", "%%"),
    ("closest", "min_distance", "m"),
    ("overlaps", "collisions", "d"),
    ("hits", "arena_hits", "d"),
)

#: What a condition needs said besides its title.
_NOTES: dict[Condition, str] = {
    "scan-rate": "Scans per second, and commands too where the profile keeps both in step.",
    "latency": "Time from a finished scan until a command can use it; commands come once per control period.",
    "speed": "The largest speed of the base; what a controller asks beyond it is shortened.",
    "acceleration": "The ideal profile has no limit of its own.",
    "lag": "Time constant with which the base's velocity follows the command.",
    "team-size": "Teams of more than 13 robots get three times the duration. A team of two can never be strict.",
    "distance": "A robot sees as far as 2 d*, and starts grow with d*.",
}


def list_sections(
    config: ConditionsConfig,
    summaries: Sequence[dict[str, Any]],
    skipped: Mapping[str, str],
    failures: int,
    privileged: bool,
) -> list[Section]:
    """Return the sections of the page: all conditions in one figure, a table for each, and failed runs.

    Args:
        config: What was run.
        summaries: What ``ConditionSweep.summaries`` returned.
        skipped: Cells that could not be run, with the reason.
        failures: How many failed runs are drawn.
        privileged: Whether the controller sees true poses.
    """
    found = {summary["condition"] for summary in summaries}
    sections = [_overview(config, skipped, privileged)]
    for condition in SWEEPS:
        if condition in found:
            own = [summary for summary in summaries if summary["condition"] == condition]
            sections.append(_condition(config, condition, own))
    if failures:
        text = (
            f"The first failed run of {failures} cells with a failed run, one of every condition in turns. Where every "
            "robot started (ring), went (line) and ended (footprint, white line to the front), and the final graph, "
            "dashed where it is longer than robots can sense. A run fails if it does not end strict, and that of two "
            "robots if it is no success."
        )
        sections.append(_section(config.command(), "Failed runs", text, ([], []), "failures.png"))
    return sections


def _overview(config: ConditionsConfig, skipped: Mapping[str, str], privileged: bool) -> Section:
    parts = [
        f"Controller {config.controller}, {config.runs} random starts per value and team size with seed {config.seed}, "
        f"{config.duration:g} s each. One condition at a time differs from the profile {config.profile}, the arena "
        f"{config.arena} and a prescribed distance of {config.distance:g} m. Strict: the run ends in a true "
        "triangulation; success: the formation error of the last 5 s is below 10 %. Bars and intervals are Wilson's, "
        "of 95 %. Hold: mean share of the last 5 s in which a run is strict; strict at: median time from which runs "
        "are strict to the end; drift: median speed of their robots in the last 5 s; closest: smallest distance "
        "between two centres; overlaps: runs in which two footprints ever overlapped; hits: runs in which one "
        "overlapped a wall or pillar."
    ]
    if privileged:
        parts.append("This controller sees true poses at once: what a LiDAR does to scans does not reach it.")
    if skipped:
        parts.append(f"Left out: {'; '.join(f'{name} ({why})' for name, why in skipped.items())}.")
    return _section(config.command(), "All conditions", " ".join(parts), ([], []), "conditions.png")


def _condition(config: ConditionsConfig, condition: Condition, summaries: Sequence[dict[str, Any]]) -> Section:
    sweep = SWEEPS[condition]
    headings = [sweep.heading, "robots", "runs", "strict", "interval", "success", "interval"]
    if condition == "team-size":
        headings = headings[1:]
    rows = []
    for summary in summaries:
        row = [summary["label"], str(summary["robots"]), str(summary["runs"])]
        for measure in ("strict", "success"):
            low, high = (format_value(bound, "%") for bound in summary[f"{measure}_interval"])
            row += [format_value(summary[measure], "%"), f"{low.removesuffix(' %')} to {high}"]
        row += [format_value(summary[key], kind) for _, key, kind in _COLUMNS]
        rows.append(row[1:] if condition == "team-size" else row)
    headings += [heading for heading, _, _ in _COLUMNS]
    title = condition.replace("-", " ").capitalize()
    return _section(config.command(condition), title, _note(config, condition), (headings, rows))


def _note(config: ConditionsConfig, condition: Condition) -> str:
    if condition == "incident":
        return (
            f"Stuck: one robot never moves. Leaves: one is gone from {config.incident_time:g} s on. Meet: teams of "
            f"{MEETING[0]} and {MEETING[1]}, whose nearest robots start {MEETING_GAP:g} d* apart. Pushed: at "
            f"{config.incident_time:g} s one robot is moved by {PUSH_LENGTH:g} d* away from the team's centre. Times "
            "are counted from the start. What comes before a robot leaves or is pushed does not count, except overlaps "
            "and hits."
        )
    if condition == "footprint":
        return "; ".join(f"{name}: {_outline(footprint)}" for name, footprint in FOOTPRINTS.items()) + "."
    return _NOTES.get(condition, f"Everything but the {condition.replace('-', ' ')} as above.")


def _outline(footprint: Footprint) -> str:
    if footprint.is_circle:
        return f"a circle of radius {footprint.half_length:g} m"
    return f"a box of {footprint.length:g} m x {footprint.width:g} m"


def _section(command: str, title: str, text: str, table: tuple[list[str], list[list[str]]], image: str = "") -> Section:
    key = title.lower().replace(" ", "-")
    return Section(key, title, text, command, *table, image, ["conditions.json", "conditions.parquet"])
