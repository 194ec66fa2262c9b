from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom, binomtest, wilcoxon

from triform.evaluation.statistics import holm, mcnemar, median_interval, signed_rank, wilson_interval

#: Times come in steps, so differences are tied, and some runs have none.
times = st.one_of(st.just(np.nan), st.integers(0, 8).map(lambda step: step / 10))


@given(st.integers(1, 300).flatmap(lambda total: st.tuples(st.integers(0, total), st.just(total))))
def test_intervals_are_wilsons(counted):
    expected = binomtest(*counted).proportion_ci(method="wilson")
    assert wilson_interval(*counted) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_no_runs_have_no_interval():
    assert np.isnan(wilson_interval(0, 0)).all()
    assert np.isnan(median_interval(np.array([]))).all()


@given(st.integers(1, 400))
def test_the_interval_of_a_median_is_the_narrowest_that_a_binomial_distribution_allows(runs):
    low, high = median_interval(np.random.default_rng(runs).permutation(runs).astype(float))
    if runs < 6:
        assert np.isnan([low, high]).all()
        return
    assert low + high == runs - 1
    # The median lies outside if at most `low` of the runs are on one side of it.
    assert 2 * binom.cdf(low, runs, 0.5) <= 0.05 < 2 * binom.cdf(low + 1, runs, 0.5)


@pytest.mark.parametrize("runs", [6, 20, 101])
def test_the_interval_of_a_median_holds_it_95_times_of_100(runs):
    drawn = np.random.default_rng(31).exponential(size=(4000, runs))
    low, high = np.array([median_interval(values) for values in drawn]).T
    covered = ((low <= np.log(2)) & (np.log(2) <= high)).mean()
    assert 0.95 - 0.01 < covered < 0.985


def test_undefined_values_have_no_part_in_the_interval_of_a_median():
    values = np.array([3.0, np.nan, 1.0, 6.0, 2.0, np.inf, 5.0, 4.0])
    assert median_interval(values) == (1.0, 6.0)


def test_the_interval_of_a_median_of_very_many_runs_stays_exact():
    assert median_interval(np.arange(200_000.0)) == (binom.ppf(0.025, 200_000, 0.5) - 1, binom.ppf(0.975, 200_000, 0.5))


@given(st.lists(st.tuples(st.booleans(), st.booleans()), min_size=1, max_size=60))
def test_mcnemars_test_is_a_binomial_test_of_the_pairs_that_differ(pairs):
    first, second = np.array(pairs).T
    gained, lost = sum(b and not a for a, b in pairs), sum(a and not b for a, b in pairs)
    expected = binomtest(gained, gained + lost).pvalue if gained + lost else 1.0
    assert mcnemar(first, second) == pytest.approx(expected)
    assert mcnemar(second, first) == mcnemar(first, second)


@given(st.lists(st.tuples(times, times), min_size=1, max_size=9))
def test_the_signed_rank_test_counts_all_signs_with_ties_too(pairs):
    first, second = np.array(pairs).T
    found = signed_rank(first, second)
    differences = np.round(second - first, 6)
    differences = differences[np.isfinite(differences)]
    if len(differences) == 0:
        assert np.isnan(found)
        return
    signs, sizes = np.sign(differences[differences != 0]), np.abs(differences[differences != 0])
    ranks = np.array([(sizes < size).sum() + ((sizes == size).sum() + 1) / 2 for size in sizes])
    off = abs((signs * ranks).sum())
    all_off = [abs((np.array(each) * ranks).sum()) for each in product((-1, 1), repeat=len(ranks))]
    assert found == pytest.approx(np.mean(np.array(all_off) >= off - 1e-9))


@pytest.mark.parametrize(
    ("pairs", "method"), [(1, "exact"), (12, "exact"), (49, "exact"), (199, "exact"), (201, "approx")]
)
@pytest.mark.parametrize("shift", [0.0, 0.15])
def test_the_signed_rank_test_agrees_with_scipy(pairs, method, shift):
    first, second = np.random.default_rng(pairs).normal(size=(2, pairs))
    expected = wilcoxon(second + shift, first, method=method).pvalue
    assert signed_rank(first, second + shift) == pytest.approx(expected, rel=1e-9)


def test_ties_of_many_pairs_agree_with_scipy():
    rng = np.random.default_rng(32)
    first, second = rng.integers(0, 20, (2, 500)) / 10
    expected = wilcoxon(np.round(second - first, 6), method="approx").pvalue
    assert signed_rank(first, second) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(("test", "kind"), [(mcnemar, np.bool_), (signed_rank, np.float64)])
def test_no_pair_has_no_answer_and_equal_pairs_do_not_differ(test, kind):
    assert np.isnan(test(np.zeros(0, dtype=kind), np.zeros(0, dtype=kind)))
    assert test(np.ones(5, dtype=kind), np.ones(5, dtype=kind)) == 1.0


def test_one_pair_shows_nothing():
    assert mcnemar(np.array([True]), np.array([False])) == 1.0
    assert signed_rank(np.array([1.0]), np.array([2.0])) == 1.0


def test_chance_alone_is_called_a_difference_at_most_5_times_of_100():
    rng = np.random.default_rng(33)
    first, second = rng.integers(0, 2, (2, 2000, 40)) > 0
    assert np.mean([mcnemar(a, b) < 0.05 for a, b in zip(first, second, strict=True)]) < 0.06
    assert np.mean([mcnemar(a, a | b) < 0.05 for a, b in zip(first, second, strict=True)]) > 0.5
    times = rng.integers(50, 90, (2, 2000, 40)) / 10
    assert np.mean([signed_rank(a, b) < 0.05 for a, b in zip(*times, strict=True)]) < 0.06
    assert np.mean([signed_rank(a, b + 1) < 0.05 for a, b in zip(*times, strict=True)]) > 0.5


def test_holms_correction():
    # By hand: 4 x 0.01, 3 x 0.013 (not below 0.04), 2 x 0.03, 1 x 0.2.
    assert holm([0.03, 0.01, 0.2, 0.013]) == pytest.approx([0.06, 0.04, 0.2, 0.04])
    assert holm([0.9, 0.8]) == pytest.approx([1.0, 1.0])
    assert holm([]) == []
    np.testing.assert_allclose(holm([np.nan, 0.02, 0.03]), [np.nan, 0.04, 0.04])


@given(st.lists(st.floats(0, 1), max_size=12), st.randoms(use_true_random=False))
def test_holms_correction_keeps_the_order_and_does_not_depend_on_it(p_values, random):
    adjusted = dict(zip(range(len(p_values)), holm(p_values), strict=True))
    assert all(each >= given for each, given in zip(adjusted.values(), p_values, strict=True))
    shuffled = random.sample(range(len(p_values)), len(p_values))
    assert holm([p_values[place] for place in shuffled]) == [adjusted[place] for place in shuffled]
    ranked = [adjusted[place] for place in sorted(adjusted, key=p_values.__getitem__)]
    assert ranked == sorted(ranked)
