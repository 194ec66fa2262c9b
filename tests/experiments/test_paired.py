from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from triform.control import ControllerSpec
from triform.evaluation import Scenario
from triform.evaluation.events import Event
from triform.evaluation.statistics import holm, mcnemar, signed_rank
from triform.experiments.cell import Cell
from triform.experiments.paired import compare_rows, explain_p, format_p

RUNS = 12


class Done:
    """A grid that holds tables without running anything."""

    def __init__(self, tables):
        self.tables = tables

    def is_done(self, cell):
        return cell in self.tables

    def table(self, cell):
        return self.tables[cell]


def make_cell(label, robots=5, scenario=None, seed=31):
    scenario = Scenario() if scenario is None else scenario
    labels = {"label": label, "profile": scenario.profile}
    return Cell(labels, scenario, ControllerSpec("expert"), robots, RUNS, seed, label, label)


def make_table(seed, strict=0.5):
    rng = np.random.default_rng(seed)
    ends = rng.random(RUNS) < strict
    return {
        "run": np.arange(RUNS),
        "strict": ends,
        "success": rng.random(RUNS) < 0.8,
        "strict_time": np.where(ends, rng.integers(0, 40, RUNS) / 2, np.nan),
        "converge_time": rng.integers(50, 90, RUNS) / 10,
        "formation_error": rng.random(RUNS),
    }


def shuffled(table, random):
    order = np.array(random.sample(range(RUNS), RUNS))
    return {name: column[order] for name, column in table.items()}


@given(st.integers(0, 99), st.randoms(use_true_random=False))
def test_pairs_are_runs_of_the_same_start_in_whatever_order_tables_are(seed, random):
    first, second = make_cell("first"), make_cell("second")
    tables = make_table(seed), make_table(seed + 100)
    (row,) = compare_rows(Done({first: tables[0], second: tables[1]}), [first, second])
    assert row.key == {"label": "second"}
    assert row.reference == "first"
    for name, test in (("strict", mcnemar), ("strict_time", signed_rank), ("formation_error", signed_rank)):
        np.testing.assert_equal(row.tests[name]["p"], test(tables[0][name], tables[1][name]))
    assert row.tests["strict_time"]["pairs"] == (tables[0]["strict"] & tables[1]["strict"]).sum()
    assert row.tests["strict"]["higher"] == (tables[1]["strict"] & ~tables[0]["strict"]).sum()
    moved = {first: shuffled(tables[0], random), second: shuffled(tables[1], random)}
    np.testing.assert_equal(compare_rows(Done(moved), [first, second])[0].as_json(), row.as_json())


def test_only_runs_that_both_have_are_pairs():
    first, second = make_cell("first"), make_cell("second")
    few = {name: column[3:8] for name, column in make_table(2).items()}
    (row,) = compare_rows(Done({first: make_table(1), second: few}), [first, second])
    assert row.tests["strict"]["pairs"] == 5
    assert row.tests["strict"]["p"] == mcnemar(make_table(1)["strict"][3:8], few["strict"])


@pytest.mark.parametrize(
    "other",
    [
        make_cell("other", robots=7),
        make_cell("other", seed=32),
        make_cell("other", scenario=Scenario(distance=0.8)),
        make_cell("other", robots=9, scenario=Scenario(event=Event("meet"))),
    ],
)
def test_other_starts_are_no_pairs(other):
    first = make_cell("first", robots=9 if other.scenario.event else 5)
    rows = compare_rows(Done({first: make_table(1), other: make_table(2)}), [first, other])
    assert rows == []
    assert explain_p(rows) == ""
    assert format_p(rows, "strict", label="other") == "-"


def test_columns_are_pooled_and_each_counts_once():
    cells = [make_cell(label, robots) for label in ("first", "second") for robots in (5, 7, 5)]
    tables = {cell: make_table(number + 10 * cell.robots) for number, cell in enumerate(cells)}
    (row,) = compare_rows(Done(tables), cells)
    assert row.tests["success"]["pairs"] == 2 * RUNS
    rows = compare_rows(Done(tables), cells, ("label", "robots"))
    assert [each.key["robots"] for each in rows] == [5, 7]
    assert [each.tests["success"]["pairs"] for each in rows] == [RUNS, RUNS]


def test_what_is_not_done_is_not_compared():
    first, second, third = (make_cell(label) for label in ("first", "second", "third"))
    done = {second: make_table(1), third: make_table(2)}
    assert compare_rows(Done(done), [first, second, third]) == []
    (row,) = compare_rows(Done({first: make_table(3), third: make_table(2)}), [first, second, third])
    assert row.key == {"label": "third"}


def test_all_rows_of_a_table_are_corrected_together_and_read_well():
    cells = [make_cell(label) for label in ("first", "same", "worse", "other")]
    good = make_table(1, strict=1.0)
    tables = [good, good, good | {"strict": np.zeros(RUNS, np.bool_)}, make_table(3)]
    rows = compare_rows(Done(dict(zip(cells, tables, strict=True))), cells)
    for name in rows[0].tests:
        found = [row.tests[name] for row in rows]
        assert [each["p_holm"] for each in found] == holm([each["p"] for each in found])
    shown = [format_p(rows, "strict", label=cell.labels["label"]) for cell in cells]
    assert shown[:2] == ["ref", "1.00"]
    # All 12 pairs differ: 3 times 2 in 2^12.
    assert shown[2] == f"{3 * 2 / 2**12:.3f}"
    assert "p: 3 comparisons with first, all columns together (ref)." in explain_p(rows)
    assert format_p(rows, "strict", label="unknown") == "-"


def test_a_value_that_no_pair_defines_has_no_answer():
    cells = [make_cell("first"), make_cell("second")]
    never = make_table(1) | {"strict_time": np.full(RUNS, np.nan)}
    rows = compare_rows(Done(dict.fromkeys(cells, never)), cells)
    assert rows[0].tests["strict_time"]["pairs"] == 0
    assert format_p(rows, "strict_time", label="second") == "-"
    assert format_p(rows, "formation_error", label="second") == "1.00"


@pytest.mark.parametrize("changed", [{"profile": "hardware"}, {"arena": "room-6"}, {"duration": 20.0}])
def test_starts_are_the_same_whatever_else_differs(changed):
    cell = make_cell("a")
    other = replace(cell, scenario=replace(cell.scenario, **changed))
    assert other.starts_key == cell.starts_key
    starts = [each.scenario.sample_starts(5, RUNS, each.seed) for each in (cell, other)]
    np.testing.assert_array_equal(*starts)
