from __future__ import annotations

import numpy as np
import pytest

from tests.formations import hexagon, still
from triform.evaluation import measure, summarise
from triform.evaluation.statistics import wilson_interval
from triform.report.tables import BRACKETS, format_measure, legend, summary_rows


@pytest.mark.parametrize(
    ("count", "total", "shown"),
    [(97, 100, "97 % (92-99)"), (100, 100, "100 % (96-100)"), (0, 20, "0 % (0-16)"), (1, 1, "100 % (21-100)")],
)
def test_rates_are_shown_with_their_interval(count, total, shown):
    summary = {"strict": count / total, "strict_interval": wilson_interval(count, total)}
    assert format_measure(summary, "strict", "%") == shown


def test_what_has_no_interval_or_no_value_is_shown_without():
    summary = {"hold": 0.5, "error": 0.123, "error_interval": (0.1, 0.2), "never": np.nan, "never_interval": (0.0, 1.0)}
    assert format_measure(summary, "hold", "%") == "50 %"
    assert format_measure(summary, "error", "%%") == "12.3 %"
    assert format_measure(summary, "never", "%") == "-"


def test_every_rate_of_a_table_has_an_interval():
    summary = {"robots": 7, **summarise(measure(still([hexagon(), hexagon(1.5)])))}
    headings, (row,) = summary_rows([summary])
    shown = dict(zip(headings, row, strict=True))
    for heading in ("success", "sensed", "strict", "strict sensed"):
        assert shown[heading] == "50 % (9-91)", heading
    assert shown["overlap"] == "0 % (0-66)"
    assert shown["hold"] == "50 %"
    assert legend(headings).endswith(BRACKETS)
    assert legend(["anything"]) == ""
