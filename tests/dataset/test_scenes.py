"""Views to learn the triangulating law from: their labels, what they show, and what varies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from shapely.geometry import LineString, Point

from triform.control import Triangulating, TriangulatingLaw
from triform.dataset import SceneConfig, StateBuffer, Views, draw_views
from triform.dataset.scenes import SEEN, SceneDraws, buffered_states, draw_body, draw_positions, scene_draws
from triform.geometry import body_to_world
from triform.simulation import ROBOMASTER_EP, Footprint
from triform.types import ConfigurationError, MapConfig, PrivilegedView, Scan, ScanConfig

#: Nothing is random but headings, and who is listed first.
PLAIN = SceneConfig(
    placed=0.0, jitter=(0.0,), distances=(1.0, 1.0), usual=1.0, noisy=0.0, dropping=0.0, walled=0.0, pillared=0.0,
    views=64,
)  # fmt: skip
#: So that no robot is seen farther than a scan reaches.
LAW = TriangulatingLaw(sight=2.0)
seeds = st.integers(0, 2**32 - 1)


def draws_of(placed: float, sizes: tuple[int, int], jitter: Sequence[float] = (0.0,)) -> SceneDraws:
    return scene_draws(SceneConfig(placed=placed, sizes=sizes, jitter=tuple(jitter)))


def draw(
    seed: int, maps: int, config: SceneConfig, visited: StateBuffer | None = None, law: TriangulatingLaw = LAW
) -> Views:
    visited = StateBuffer.none() if visited is None else visited
    return draw_views(np.random.default_rng(seed), maps, law, config, visited, ScanConfig(), MapConfig())


def spread(seed: int, robots: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    placed: list[np.ndarray] = []
    while len(placed) < robots:
        place = rng.uniform(0, 1.1 * np.sqrt(robots + 1), 2)
        if all(np.linalg.norm(place - other) >= 0.45 for other in placed):
            placed.append(place)
    return np.array(placed)


def in_sight(positions: np.ndarray, i: int) -> list[int]:
    """Who is within sight of robot i and not behind a disc around another one."""
    eye = positions[i]
    near = [j for j in range(len(positions)) if j != i and np.linalg.norm(positions[j] - eye) <= LAW.sight]
    lines = {j: LineString([eye, positions[j]]) for j in near}
    return [j for j in near if all(Point(positions[k]).distance(lines[j]) >= 0.14 for k in near if k != j)]


def looking(views: Views, positions: np.ndarray) -> list[tuple[int, float]]:
    """Which robot each view is of, and its heading: the only ones under which all agree with what is seen."""
    robots = len(positions)
    for first in range(robots):
        found = []
        for m in range(robots):
            i = (first + m) % robots
            sight = in_sight(positions, i)
            seen = views.seen[m][np.isfinite(views.seen[m, :, 0]), :2]
            if len(seen) != len(sight) or not sight:
                break
            away = positions[sight] - positions[i]
            heading = float(np.angle((away[0] @ [1, 1j]) / (seen[0] @ [1, 1j])))
            if not np.allclose(body_to_world(away, -heading), seen, atol=1e-9):
                break
            found.append((i, heading))
        else:
            return found
    raise AssertionError("what is seen fits no robots")


def commands(poses: np.ndarray, push: float, max_speed: float = 0.5) -> np.ndarray:
    shape = poses.shape[:1]
    view = PrivilegedView(
        Scan(np.full((1, *shape, 1), np.inf), ScanConfig(rays=1)), np.ones((1, *shape), dtype=bool), 0.0, poses[None],
        noise=np.full((1, *shape, 2), push),
    )  # fmt: skip
    return Triangulating(max_speed=max_speed, law=LAW).command(view)[0]


@settings(deadline=None, max_examples=25)
@given(seeds, st.integers(2, 9))
def test_the_label_is_what_the_law_does_there(seed: int, robots: int) -> None:
    positions = spread(seed, robots)
    if not all(in_sight(positions, i) for i in range(robots)):
        return
    visited = StateBuffer.of_teams(positions[None])
    views = draw(seed, robots, PLAIN, visited)
    free = draw(seed, robots, replace(PLAIN, max_speed=1e9), visited)
    np.testing.assert_array_equal(free.maps, views.maps)
    for m, (i, heading) in enumerate(looking(views, positions)):
        poses = np.concatenate([positions, np.zeros((robots, 1))], axis=1)
        poses[i, 2] = heading
        np.testing.assert_allclose(views.commands[m, :3], commands(poses, 0.0)[i], atol=1e-9)
        pushed = commands(poses, 1.0, 1e9)[i] - commands(poses, 0.0, 1e9)[i]
        np.testing.assert_allclose(views.commands[m, 3], pushed[:2], atol=1e-9)
        # What each robot adds is known, and with a bridge there is a pull besides.
        told = views.seen[m][np.isfinite(views.seen[m, :, 0])]
        rest = free.commands[m, :2] - told[:, 2:4].sum(axis=0) - LAW.compaction_speed * views.features[m, 3:]
        assert views.features[m, 0] in (0.0, 1.0)
        assert np.linalg.norm(rest) < (LAW.bridge_pull if views.features[m, 0] else 0.0) + 1e-9
        assert set(told[:, 4:].reshape(-1)) <= {0.0, 1.0}


@settings(deadline=None, max_examples=40)
@given(seeds, st.integers(2, 9))
def test_the_map_shows_the_robots_that_are_there(seed: int, robots: int) -> None:
    positions = spread(seed, robots)
    if not all(in_sight(positions, i) for i in range(robots)):
        return
    views, config = draw(seed, robots, PLAIN, StateBuffer.of_teams(positions[None])), MapConfig()
    for m, (i, heading) in enumerate(looking(views, positions)):
        others = body_to_world(np.delete(positions, i, axis=0) - positions[i], -heading)
        occupied = (np.argwhere(views.maps[m]) + 0.5) * config.cell - config.half_extent
        distance = np.linalg.norm(occupied[:, None] - others[None], axis=2)
        # A corner is 0.2 m from the centre; a cell next to the return's own may be occupied too.
        assert (distance.min(axis=1) <= ROBOMASTER_EP.circumradius + 1.5 * np.sqrt(2) * config.cell).all()
        near = np.linalg.norm(others, axis=1) < 1.4
        lines = [LineString([(0, 0), place]) for place in others]
        clear = [
            all(Point(others[k]).distance(lines[j]) > 0.45 for k in range(len(others)) if k != j)
            for j in range(len(others))
        ]
        shown = (distance < 0.3).any(axis=0)
        assert shown[near & np.array(clear)].all()


def test_views_are_a_function_of_the_generators_state() -> None:
    visited = StateBuffer.of_teams(np.stack([spread(k, 6) for k in range(5)]))
    config = SceneConfig(pillared=0.5)
    one, again, other = (draw(seed, 60, config, visited) for seed in (1, 1, 2))
    for name in ("maps", "commands", "seen", "features"):
        np.testing.assert_array_equal(getattr(one, name), getattr(again, name))
        assert not np.array_equal(getattr(one, name), getattr(other, name))
    assert one.maps.shape == (60, 100, 100)
    assert one.commands.shape == (60, 4)
    assert np.isfinite(one.commands).all()
    assert np.isfinite(one.features).all()
    assert not one.commands[:, 2].any()
    assert (np.linalg.norm(one.commands[:, :2], axis=1) <= config.max_speed + 1e-12).all()
    assert draw(1, 0, config).maps.shape == (0, 100, 100)


@settings(deadline=None, max_examples=40)
@given(seeds, st.tuples(st.integers(1, 12), st.integers(0, 12)))
def test_placements_keep_their_spacing_and_hang_together(seed: int, sizes: tuple[int, int]) -> None:
    least, most = sizes[0], sizes[0] + sizes[1]
    rng, team, nobody = np.random.default_rng(seed), np.empty((most, 2)), StateBuffer.none()
    for _ in range(10):
        robots = draw_positions(rng, buffered_states(nobody), draws_of(0.0, (least, most)), team)
        assert robots == 0 or least <= robots <= most
        placed = team[:robots]
        distance = np.linalg.norm(placed[:, None] - placed[None], axis=2)
        assert (distance[~np.eye(robots, dtype=bool)] >= 0.45 - 1e-12).all()
        # Each is within sight of one that was placed before.
        assert all(distance[k, :k].min() <= 2.0 for k in range(1, robots))


def test_every_size_is_placed() -> None:
    rng, team, nobody = np.random.default_rng(1), np.empty((20, 2)), StateBuffer.none()
    config = SceneConfig()
    counts = [draw_positions(rng, buffered_states(nobody), draws_of(0.15, config.sizes), team) for _ in range(600)]
    assert set(range(2, 21)) <= set(counts) <= {0, *range(2, 21)}
    assert counts.count(0) < 30


def test_visited_states_are_jittered_by_one_of_the_deviations() -> None:
    positions = spread(1, 8)
    visited = StateBuffer.of_teams(positions[None])
    rng, team = np.random.default_rng(2), np.empty((8, 2))
    deviations = np.array([0.0, 0.01, 0.1])
    sizes = []
    for _ in range(600):
        assert draw_positions(rng, buffered_states(visited), draws_of(0.0, (1, 1), deviations), team) == 8
        sizes.append(np.std(team - positions))
    nearest = np.abs(np.array(sizes)[:, None] - deviations).argmin(axis=1)
    assert stats.chisquare(np.bincount(nearest, minlength=3)).pvalue > 0.01
    assert not np.array(sizes)[nearest == 0].any()
    np.testing.assert_allclose(np.mean(np.array(sizes)[nearest == 2]), 0.1, rtol=0.05)


def test_placements_and_visited_states_are_drawn_in_their_shares() -> None:
    positions = spread(1, 3)
    visited = StateBuffer.of_teams(positions[None])
    rng, team, placed = np.random.default_rng(3), np.empty((9, 2)), 0
    for _ in range(1000):
        robots = draw_positions(rng, buffered_states(visited), draws_of(0.3, (3, 3)), team)
        placed += robots == 3 and not np.array_equal(team[:3], positions)
    assert abs(placed - 300) < 60


def test_outlines_and_distances_are_drawn_as_documented() -> None:
    rng, ep = np.random.default_rng(4), ROBOMASTER_EP.body
    draws = scene_draws(SceneConfig(usual=0.7, distances=(0.6, 1.5)))
    drawn = [draw_body(rng, draws) for _ in range(4000)]
    distances = np.array([distance for distance, _ in drawn])
    outlines = np.array([outline for _, outline in drawn], dtype=float)
    sizes = distances[:, None] * outlines[:, :2]
    other = distances[distances != 1.0]
    assert abs(len(other) - 2000) < 150
    assert stats.kstest(np.log(other), stats.uniform(np.log(0.6), np.log(1.5 / 0.6)).cdf).pvalue > 0.01
    usual = np.isclose(sizes, ep[:2]).all(axis=1)
    assert abs(usual.mean() - 0.7) < 0.03
    circles, boxes = sizes[outlines[:, 2] == 1], sizes[~usual & (outlines[:, 2] == 0)]
    assert abs(len(circles) / (len(circles) + len(boxes)) - 0.5) < 0.06
    assert ((circles >= 0.05 - 1e-12) & (circles <= 0.26 + 1e-12)).all()
    np.testing.assert_array_equal(circles[:, 0], circles[:, 1])
    assert ((boxes[:, 0] >= 0.05 - 1e-12) & (boxes[:, 0] <= 0.26 + 1e-12)).all()
    assert ((boxes[:, 1] / boxes[:, 0] >= 0.6 - 1e-12) & (boxes[:, 1] <= boxes[:, 0] + 1e-12)).all()


def test_where_circles_are_usual_other_boxes_stay_boxes() -> None:
    rng = np.random.default_rng(4)
    draws = scene_draws(SceneConfig(footprint=Footprint.circle(0.5), usual=0.5))
    drawn = [draw_body(rng, draws) for _ in range(1000)]
    sizes = np.array([distance * outline.half_length for distance, outline in drawn])
    circles = np.array([outline.is_circle for _, outline in drawn])
    assert circles[np.isclose(sizes, 0.25)].all()
    assert abs(np.isclose(sizes, 0.25).mean() - 0.5) < 0.05
    assert abs(circles.mean() - 0.75) < 0.05


def test_footprints_in_maps_scale_with_the_distance() -> None:
    """Of a robot 1 d* away, the near side is where its outline over d* puts it."""
    visited = StateBuffer.of_teams(np.array([[[0.0, 0.0], [1.0, 0.0]]]))
    cells = (np.arange(100) + 0.5) * 0.04 - 2.0
    away = np.hypot(cells[:, None], cells[None])

    def near_sides(low: float, high: float) -> np.ndarray:
        views = draw(5, 300, replace(PLAIN, distances=(low, high)), visited)
        return np.where(views.maps == 1, away, np.inf).min(axis=(1, 2))

    reach = 2 * np.sqrt(2) * 0.04
    for low, high in ((1.0, 1.0), (0.6, 1.0), (1.0, 1.5)):
        sides = near_sides(low, high)
        assert 1 - ROBOMASTER_EP.circumradius / low - reach <= sides.min() <= 1 - ROBOMASTER_EP.half_length / low
        assert 1 - ROBOMASTER_EP.half_width / high - reach <= sides.max() <= 1 - ROBOMASTER_EP.half_width / high


def test_noise_lost_rays_walls_and_pillars_come_in_their_shares() -> None:
    visited = StateBuffer.of_teams(np.array([[[0.0, 0.0], [1.0, 0.0]]]))
    plain = draw(6, 200, replace(PLAIN, views=1), visited)
    for change in ({"noisy": 1.0, "noise": 0.1}, {"dropping": 1.0, "dropout": 1.0}, {"walled": 1.0}, {"pillared": 1.0}):
        views = draw(6, 200, replace(PLAIN, views=1, **change), visited)
        # The label is that of the robots alone: two robots at rest.
        np.testing.assert_allclose(views.commands, plain.commands, atol=1e-9)
        counts = [each.maps.sum(axis=(1, 2)) for each in (plain, views)]
        if "dropping" in change:
            assert counts[1].mean() < 0.8 * counts[0].mean()
        else:
            assert np.std(counts[1]) > 1.2 * np.std(counts[0])


def test_of_many_in_sight_as_many_are_told_as_there_is_room_for() -> None:
    rng = np.random.default_rng(7)
    radii, angles = 2.4 * np.sqrt(rng.random(120)), rng.uniform(-np.pi, np.pi, 120)
    crowd = np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1)
    # Tiny robots that hide nobody.
    config = replace(PLAIN, views=8, distances=(1.0, 1000.0))
    views = draw(7, 120, config, StateBuffer.of_teams(crowd[None]))
    told = np.isfinite(views.seen[:, :, 0]).sum(axis=1)
    assert told.max() == SEEN
    assert np.isfinite(views.commands).all()
    assert np.isinf(views.seen[~np.isfinite(views.seen[:, :, 0])]).all()


@pytest.mark.parametrize(
    ("name", "values"),
    [
        *((name, (-0.1, 1.1, np.nan)) for name in (
            "placed", "usual", "noisy", "dropping", "dropout", "walled", "pillared"
        )),
        ("sizes", ((0, 3), (4, 3))),
        ("jitter", ((), (-0.1,), (0.0, np.nan), (np.inf,))),
        ("distances", ((0.0, 1.0), (1.1, 1.5), (0.5, 0.9), (0.5, np.inf), (np.nan, 1.0))),
        ("noise", (-0.1, np.nan, np.inf)),
        ("views", (0, -1)),
        ("max_speed", (0.0, -1.0, np.nan)),
    ],
)  # fmt: skip
def test_values_that_make_no_sense_are_refused(name: str, values: tuple) -> None:
    for value in values:
        with pytest.raises(ConfigurationError, match=rf"{name} of scenes (is|are) ") as refusal:
            SceneConfig(**{name: value})
        assert "\n" not in str(refusal.value)
        assert not str(refusal.value).endswith(".")
