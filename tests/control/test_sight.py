"""When a robot may trust its LiDAR, against the definition."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from triform.control import Sight, has_sight
from triform.control.sight import BLIND_TURNS, MOST_UNKNOWN

ranges = st.lists(st.sampled_from([np.nan, np.inf, -np.inf, 0.5, 8.0]), min_size=1, max_size=40)


@given(ranges, st.data())
def test_a_turn_has_sight_if_something_returns_and_most_is_known(values: list[float], data: st.DataObject) -> None:
    looks = data.draw(st.lists(st.booleans(), min_size=len(values), max_size=len(values)).filter(any))
    seen = [value for value, look in zip(values, looks, strict=True) if look]
    unknown = sum(value != value for value in seen)
    returned = any(value == -np.inf or 0 < value < np.inf for value in seen)
    assert has_sight(np.array(values), np.array(looks)) == (returned and unknown <= MOST_UNKNOWN * len(seen))


@given(st.lists(st.booleans(), max_size=20))
def test_trust_is_lost_turn_by_turn_and_comes_back_at_once(turns: list[bool]) -> None:
    sight = Sight()
    assert sight.trust == 0
    for sees in turns:
        before = sight.trust
        sight.note(sees)
        assert sight.trust == (1 if sees else max(0, before - 1 / BLIND_TURNS)) or abs(sight.trust - before) < 0.34
        assert 0 <= sight.trust <= 1
    if any(turns):
        since = turns[::-1].index(True)
        assert abs(sight.trust - max(0, 1 - since / BLIND_TURNS)) < 1e-12
    else:
        assert sight.trust == 0
