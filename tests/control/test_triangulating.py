"""The triangulating law against a slow restatement of it, and the controller against the law."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from shapely.geometry import LineString, Point

from tests.formations import hangs_by_its_words
from triform.control import Triangulating, TriangulatingLaw, triangulating
from triform.control.triangulating_kernels import (
    LAW_EDGE_FEATURES,
    LAW_FEATURES,
    _circle_centre,
    hidden,
    law_workspace,
    triangulate,
)
from triform.geometry import body_to_world
from triform.geometry.cells import SMALL_TEAM
from triform.threads import limit_threads
from triform.types import ConfigurationError, PrivilegedView, Scan, ScanConfig, TriformError, View

LAW = TriangulatingLaw()
NAMES = [each.name for each in fields(TriangulatingLaw)]
seeds = st.integers(0, 2**32 - 1)


def gabriel(points: np.ndarray, sight: float = np.inf) -> np.ndarray:
    """The Gabriel graph by its definition: nobody else is inside the circle whose diameter is the edge."""
    lengths = np.linalg.norm(points[:, None] - points[None], axis=2)
    middles = (points[:, None] + points[None]) / 2
    inside = np.linalg.norm(middles[:, :, None] - points, axis=3) < lengths[..., None] / 2
    own = np.arange(len(points))
    inside[own, :, own] = inside[:, own, own] = False
    linked: np.ndarray = (lengths <= sight) & ~inside.any(axis=2)
    linked[own, own] = False
    return linked


def circle_centre(points: np.ndarray) -> np.ndarray:
    """Badoiu and Clarkson: from the first point, step k goes the share 1 / (k + 1) of the way to the farthest one."""
    centre = points[0]
    for k in range(1, 25):
        centre = centre + (points[np.linalg.norm(points - centre, axis=1).argmax()] - centre) / (k + 1)
    return centre


def ramp(value: float, begin: float, width: float) -> float:
    return float(np.clip((value - begin) / width, 0.0, 1.0))


def law_by_its_words(others: np.ndarray, law: TriangulatingLaw) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
    """Velocity, amplitude of the noise, terms and features of a robot that sees ``others``, as the docstrings say."""
    if len(others) == 0:
        return np.zeros(2), 0.0, np.zeros((0, LAW_EDGE_FEATURES)), np.zeros(LAW_FEATURES)
    points = np.concatenate([np.zeros((1, 2)), others])
    linked = gabriel(points, law.sight)
    radii = np.linalg.norm(points, axis=1)
    terms = np.zeros((len(points), LAW_EDGE_FEATURES))
    away, bridge, in_triangle, largest, smallest = np.zeros(2), False, False, 0.0, 0.0
    for j in range(1, len(points)):
        unit, strain = points[j] / radii[j], radii[j] - 1.0
        shares = bool((linked[0] & linked[j]).any())
        along = law.contact_gain * min(radii[j] - law.contact_range, 0.0)
        across = 0.0
        if linked[0, j]:
            bridge |= not shares and len(points) > 2
            in_triangle |= shares
            yields = shares and strain >= law.yield_strain and linked[j].sum() > law.firm_degree
            pull = law.yield_strain - law.yield_slope * (strain - law.yield_strain) if yields else strain
            along += law.gain * pull + law.far_gain * max(radii[j] - law.far_range, 0.0)
            across = law.odd_gain * strain
            largest, smallest = max(largest, abs(strain)), min(smallest, strain)
        else:
            along += law.gain * min(strain, 0.0) + law.hinge_pull * hangs_by_its_words(points, linked, law.sight, j)
            away += unit
        terms[j] = [*(along * unit + across * np.array([-unit[1], unit[0]])), linked[0, j], shares]
    lengths = np.linalg.norm(points[:, None] - points[None], axis=2)
    near = (np.maximum(radii[:, None], radii[None]) <= min(law.sight - 0.7, 2.3)) & linked
    loose = ramp(lengths[near].max(initial=0.0), law.loose_length, law.loose_width)
    loose *= 1.0 - ramp(-smallest, law.squeeze_limit, law.squeeze_width)
    centre = circle_centre(points)
    compaction = loose * centre / max(np.linalg.norm(centre), 0.2)
    velocity = terms[:, :2].sum(axis=0) + law.compaction_speed * compaction
    strained = ramp(largest, law.strain_limit, law.strain_width)
    noise = law.strain_push * strained
    if bridge:
        noise = law.bridge_push
        if not in_triangle:
            velocity = velocity + law.bridge_pull * away / (np.linalg.norm(away) + 1e-9)
    return velocity, noise, terms[1:], np.array([bridge, strained, loose, *compaction])


def law_by_kernel(others: np.ndarray, law: TriangulatingLaw) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
    """The same by the compiled law."""
    points = np.concatenate([np.zeros((1, 2)), others.reshape(-1, 2)])
    workspace = law_workspace(len(points))
    workspace.x[:], workspace.y[:] = points.T
    workspace.edge_features[:], workspace.features[:] = np.nan, np.nan
    v_x, v_y, noise = triangulate(len(points), law.constants, workspace)
    return np.array([v_x, v_y]), noise, workspace.edge_features[1:], workspace.features


def random_others(seed: int) -> np.ndarray:
    """Anywhere, or near the places of a triangular lattice, where the law's finer terms matter."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 14)) if rng.random() < 0.8 else 30
    if rng.random() < 0.4:
        return rng.uniform(-1.5, 1.5, (count, 2))
    places = np.array([(a + b / 2, b * np.sqrt(0.75)) for a in range(-3, 4) for b in range(-3, 4) if (a, b) != (0, 0)])
    places = places[np.linalg.norm(places, axis=1) < 2.05 + 0.9 * rng.random()]
    chosen = rng.permutation(len(places))[:count]
    return places[chosen] * rng.uniform(0.9, 1.15) + rng.normal(0, rng.choice([0.01, 0.05, 0.15]), (len(chosen), 2))


def random_law(seed: int) -> TriangulatingLaw:
    rng = np.random.default_rng(seed)
    return TriangulatingLaw(**{name: getattr(LAW, name) * rng.uniform(0.7, 1.4) for name in NAMES})


def assert_same_law(found: tuple, wanted: tuple) -> None:
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-7)


@settings(deadline=None, max_examples=150)
@given(seeds, st.one_of(st.none(), seeds))
def test_the_kernel_does_what_the_docstrings_say(seed: int, law_seed: int | None) -> None:
    law = LAW if law_seed is None else random_law(law_seed)
    others = random_others(seed)
    assert_same_law(law_by_kernel(others, law), law_by_its_words(others, law))


def test_random_others_bring_every_term_of_the_law_into_play() -> None:
    features = np.array([law_by_kernel(random_others(seed), LAW)[3] for seed in range(300)])
    for gate in features[:, :3].T:
        assert 0.1 < (gate > 0).mean() < 0.95
        assert (gate < 1).mean() > 0.1
    for name in NAMES:
        other = replace(LAW, **{name: 0.8 * getattr(LAW, name)})
        pairs = [(law_by_kernel(random_others(seed), law)[:2]) for seed in range(300) for law in (LAW, other)]
        changed = [a[1] != b[1] or not np.array_equal(a[0], b[0]) for a, b in zip(pairs[::2], pairs[1::2], strict=True)]
        assert np.mean(changed) > 0.01, name


@settings(deadline=None, max_examples=60)
@given(seeds, st.floats(-np.pi, np.pi))
def test_turns_with_the_others_and_takes_them_in_any_order(seed: int, angle: float) -> None:
    others = random_others(seed)
    velocity, noise, terms, features = law_by_kernel(others, LAW)
    order = np.random.default_rng(seed).permutation(len(others))
    assert_same_law(law_by_kernel(others[order], LAW), (velocity, noise, terms[order], features))
    turned_velocity, turned_push, turned_terms, turned_facts = law_by_kernel(body_to_world(others, angle), LAW)
    turned = np.concatenate([body_to_world(terms[:, :2], angle), terms[:, 2:]], axis=1)
    now = np.concatenate([features[:3], body_to_world(features[3:], angle)])
    found = (turned_velocity, turned_push, turned_terms, turned_facts)
    assert_same_law(found, (body_to_world(velocity, angle), noise, turned, now))


def test_nobody_one_and_two() -> None:
    velocity, noise, _, features = law_by_kernel(np.empty((0, 2)), LAW)
    assert not velocity.any()
    assert not features.any()
    assert noise == 0.0
    for length in (0.5, 0.95, 1.0, 1.05, 1.2, 1.4, 2.0, 2.5):
        velocity, noise, terms, features = law_by_kernel(np.array([[length, 0.0]]), LAW)
        # Two robots have no bridge, and their edge does not yield.
        assert (features[0], *terms[0, 2:]) == (0.0, 1.0, 0.0)
        along = LAW.gain * (length - 1) + LAW.far_gain * max(length - LAW.far_range, 0.0)
        along += LAW.contact_gain * min(length - LAW.contact_range, 0.0)
        # Looseness is asked of what is near.
        along += LAW.compaction_speed * ramp(length, LAW.loose_length, LAW.loose_width) * (length <= LAW.sight - 0.7)
        np.testing.assert_allclose(velocity, [along, LAW.odd_gain * (length - 1)], atol=1e-12)
        assert noise == pytest.approx(LAW.strain_push * ramp(abs(length - 1), LAW.strain_limit, LAW.strain_width))


@settings(deadline=None, max_examples=60)
@given(seeds)
def test_robots_in_one_place_give_finite_commands(seed: int) -> None:
    rng = np.random.default_rng(seed)
    places = np.concatenate([np.zeros((1, 2)), random_others(seed)])
    others = places[rng.integers(0, len(places), 10)]
    for values in law_by_kernel(others, LAW):
        assert np.isfinite(values).all()
    # Those in the robot's own place add nothing.
    _, _, terms, _ = law_by_kernel(others, LAW)
    assert not terms[~others.any(axis=1)].any()


@cache
def lattice_patch(seed: int, robots: int) -> np.ndarray:
    """A random patch of the triangular lattice, grown so that its Gabriel graph is made of whole triangles alone."""
    rng = np.random.default_rng(seed)
    around = [(1, 0), (0, 1), (-1, 1), (-1, 0), (0, -1), (1, -1)]
    patch = [(0, 0), (1, 0), (0, 1)]
    while len(patch) < robots:
        near = sorted({(a + d, b + e) for a, b in patch for d, e in around} - set(patch))
        for k in rng.permutation(len(near)):
            points = in_the_plane([*patch, near[k]])
            linked = gabriel(points)
            lengths = np.linalg.norm(points[:, None] - points[None], axis=2)
            closed = (linked.astype(int) @ linked > 0)[linked].all()
            if closed and np.allclose(lengths[linked], 1.0):
                patch.append(near[k])
                break
    return in_the_plane(patch)


def in_the_plane(patch: list[tuple[int, int]]) -> np.ndarray:
    a, b = np.array(patch, dtype=float).T
    # Not along an axis, so that lengths are rounded.
    return body_to_world(np.stack([a + b / 2, np.sqrt(0.75) * b], axis=1), 0.3)


def view(poses: np.ndarray, active: np.ndarray | None = None, noise: np.ndarray | None = None) -> PrivilegedView:
    shape = poses.shape[:2]
    active = np.ones(shape, dtype=bool) if active is None else active
    return PrivilegedView(Scan(np.full((*shape, 1), np.inf), ScanConfig(rays=1)), active, 0.0, poses, noise=noise)


@pytest.mark.parametrize("sight", [2.1, 2.5, 3.0, 4.0])
@pytest.mark.parametrize("robots", [3, 4, 5, 7, 10, 14, 19, 50])
def test_rests_and_is_not_pushed_in_a_perfect_triangulation(robots: int, sight: float) -> None:
    law = replace(LAW, sight=sight)
    for seed in range(8 if robots < 20 else 1):
        patch = lattice_patch(seed, robots)
        for i in range(robots):
            away = np.delete(patch, i, axis=0) - patch[i]
            velocity, noise, _, features = law_by_kernel(away[np.linalg.norm(away, axis=1) <= sight], law)
            assert np.abs(velocity).max() < 1e-9
            assert noise < 1e-9
            assert not features.any()
        poses = np.concatenate([patch, np.linspace(-3, 3, robots)[:, None]], axis=1)[None]
        command = Triangulating(law=law).command(view(poses, noise=np.full((1, robots, 2), 3.0)))
        np.testing.assert_allclose(command, 0.0, atol=1e-9)


@settings(deadline=None, max_examples=60)
@given(seeds)
def test_the_circle_is_nearly_the_smallest_one(seed: int) -> None:
    points = np.concatenate([np.zeros((1, 2)), random_others(seed)])

    def radius(centre: np.ndarray) -> float:
        return float(np.linalg.norm(points - centre, axis=1).max())

    begin = points.mean(axis=0)
    best = minimize(radius, begin, method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-9, "maxiter": 1000}).fun
    x, y = points.T.copy()
    # Their theorem: after k steps the circle is larger by less than one part in the root of k.
    assert best - 1e-6 <= radius(np.array(_circle_centre(x, y, len(points)))) <= best * (1 + 1 / np.sqrt(24))


@settings(deadline=None, max_examples=100)
@given(seeds, st.floats(0.01, 0.4))
def test_who_is_hidden(seed: int, blocking: float) -> None:
    points = np.concatenate([np.zeros((1, 2)), np.random.default_rng(seed).uniform(-2, 2, (8, 2))])
    x, y = points.T.copy()
    for j in range(1, 9):
        line = LineString([points[0], points[j]])
        discs = [Point(points[k]) for k in range(1, 9) if k != j]
        # A disc that holds an end of the line is around a robot that touches the one there: it hides nobody by that.
        apart = [disc for disc in discs if min(disc.distance(Point(points[k])) for k in (0, j)) > blocking]
        if len(apart) == len(discs):
            assert hidden(x, y, 9, j, blocking) == any(disc.distance(line) < blocking for disc in discs)
        elif hidden(x, y, 9, j, blocking):
            assert any(disc.distance(line) < blocking for disc in discs)


def spread_poses(seed: int, robots: int, spacing: float, side: float) -> np.ndarray:
    """Random poses of centres at least ``spacing`` apart, shape (N, 3)."""
    rng = np.random.default_rng(seed)
    placed: list[np.ndarray] = []
    while len(placed) < robots:
        place = rng.uniform(0, side, 2)
        if all(np.linalg.norm(place - other) >= spacing for other in placed):
            placed.append(place)
    return np.concatenate([np.array(placed), rng.uniform(-np.pi, np.pi, (robots, 1))], axis=1)


def commands_by_its_words(
    poses: np.ndarray, noise: np.ndarray, law: TriangulatingLaw, distance: float, blocking: float, max_speed: float
) -> np.ndarray:
    """Body twists (N, 3) of a team, seen with Shapely and driven by ``law_by_its_words``."""
    out = np.zeros((len(poses), 3))
    for i, pose in enumerate(poses):
        away = np.delete(poses[:, :2], i, axis=0) - pose[:2]
        away = away[np.linalg.norm(away, axis=1) <= law.sight * distance]
        lines = [LineString([(0, 0), place]) for place in away]
        seen = [
            all(Point(away[k]).distance(lines[j]) >= blocking for k in range(len(away)) if k != j)
            for j in range(len(away))
        ]
        body = body_to_world(away[np.array(seen, dtype=bool)] / distance, -pose[2])
        velocity, amplitude, _, _ = law_by_its_words(body, law)
        twist = distance * (velocity + amplitude * noise[i])
        out[i, :2] = twist * min(1.0, max_speed / max(np.linalg.norm(twist), 1e-12))
    return out


@settings(deadline=None, max_examples=80)
@given(seeds, st.integers(1, 9), st.floats(0.6, 1.5), st.sampled_from([0.0, 0.05, 0.14]), st.floats(0.1, 5.0))
def test_a_team_is_driven_by_what_each_robot_sees(
    seed: int, robots: int, distance: float, blocking: float, max_speed: float
) -> None:
    poses = spread_poses(seed, robots, 0.4 * distance, 1.2 * distance * np.sqrt(robots + 1))
    noise = np.random.default_rng(seed).standard_normal((robots, 2))
    controller = Triangulating(distance, max_speed, blocking_radius=blocking)
    found = controller.command(view(poses[None], noise=noise[None]))[0]
    np.testing.assert_allclose(
        found, commands_by_its_words(poses, noise, LAW, distance, blocking, max_speed), atol=1e-7
    )
    assert (np.linalg.norm(found[:, :2], axis=1) <= max_speed * (1 + 1e-12)).all()
    unpushed = controller.command(view(poses[None]))
    np.testing.assert_array_equal(unpushed, controller.command(view(poses[None], noise=np.zeros((1, robots, 2)))))


@settings(deadline=None, max_examples=40)
@given(seeds, st.floats(0.3, 3.0), st.floats(-np.pi, np.pi))
def test_moves_turns_and_grows_with_the_world(seed: int, scale: float, angle: float) -> None:
    poses = spread_poses(seed, 7, 0.4, 3.4)
    noise = np.random.default_rng(seed).standard_normal((1, 7, 2))
    other = poses.copy()
    other[:, :2] = scale * body_to_world(poses[:, :2], angle) + [3.0, -1.0]
    other[:, 2] += angle
    wanted = scale * Triangulating().command(view(poses[None], noise=noise))
    larger = Triangulating(scale, 0.5 * scale, blocking_radius=triangulating.BLOCKING_RADIUS * scale)
    np.testing.assert_allclose(larger.command(view(other[None], noise=noise)), wanted, atol=1e-6)


@settings(deadline=None, max_examples=25)
@given(seeds, st.integers(SMALL_TEAM // 2 + 1, SMALL_TEAM))
def test_cells_change_no_bit_of_a_command(seed: int, robots: int) -> None:
    """Two groups out of sight of each other are one large team, or two small ones."""
    groups = [spread_poses(seed + k, robots, 0.3, 1.1 * np.sqrt(robots)) for k in range(2)]
    groups[1][:, :2] += [0.0, 40.0]
    rng = np.random.default_rng(seed)
    order = rng.permutation(2 * robots)
    poses, noise = np.concatenate(groups)[order], rng.standard_normal((2 * robots, 2))
    active = rng.random(2 * robots) < 0.9
    poses[~active] = np.nan
    together = Triangulating().command(view(poses[None], active[None], noise[None]))[0]
    assert not together[~active].any()
    assert together[active].any()
    for group in range(2):
        own = active & (order // robots == group)
        alone = Triangulating().command(view(poses[None, own], noise=noise[None, own]))[0]
        np.testing.assert_array_equal(alone, together[own])


@pytest.mark.parametrize(("worlds", "robots"), [(1, 300), (7, 50), (7, 6)])
def test_neither_threads_nor_the_batch_nor_who_is_gone_matter(
    worlds: int, robots: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(triangulating, "_ROBOTS_PER_THREAD", 1)
    rng = np.random.default_rng(1)
    poses = np.stack([spread_poses(b, robots, 0.4, 1.1 * np.sqrt(robots)) for b in range(worlds)])
    noise, active = rng.standard_normal((worlds, robots, 2)), rng.random((worlds, robots)) < 0.8
    active[-1] = False
    poses[~active] = np.nan
    with limit_threads(1):
        expected = Triangulating().command(view(poses, active, noise))
    assert not expected[~active].any()
    with limit_threads(3):
        np.testing.assert_array_equal(Triangulating().command(view(poses, active, noise)), expected)
    for b in range(worlds):
        here = active[b]
        only = Triangulating().command(view(poses[b : b + 1, here], noise=noise[b : b + 1, here]))
        np.testing.assert_array_equal(only[0], expected[b, here])


def test_what_cannot_be_used_is_refused() -> None:
    blind = View(Scan(np.full((1, 2, 1), np.inf), ScanConfig(rays=1)), np.ones((1, 2), dtype=bool), 0.0)
    with pytest.raises(TriformError, match="true poses"):
        Triangulating().command(blind)  # type: ignore[arg-type]
    poses = np.zeros((1, 2, 3))
    for axis, value in ((0, np.nan), (1, np.inf), (2, np.nan)):
        bad = poses.copy()
        bad[0, 1, axis] = value
        with pytest.raises(TriformError, match="poses of active robots must be finite"):
            Triangulating().command(view(bad))
        assert not Triangulating().command(view(bad, np.array([[True, False]]))).any()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("value", [-0.1, np.nan, np.inf])
def test_constants_that_make_no_sense_are_refused(name: str, value: float) -> None:
    with pytest.raises(ConfigurationError, match=f"{name} of the law is {value}"):
        TriangulatingLaw(**{name: value})


def test_chosenthat_make_no_sense_are_refused() -> None:
    for name in ("sight", "loose_width", "strain_width"):
        with pytest.raises(ConfigurationError, match=f"{name} of the law is 0"):
            TriangulatingLaw(**{name: 0.0})
    for name, values in {
        "distance": (0.0, -1.0, np.nan, np.inf),
        "max_speed": (0.0, -1.0, np.nan),
        "blocking_radius": (-0.1, np.nan, np.inf),
    }.items():
        for value in values:
            with pytest.raises(ConfigurationError, match=name):
                Triangulating(**{name: value})


def test_the_description_names_every_constant() -> None:
    law = replace(LAW, gain=1.5)
    chosen = {"distance": 0.8, "max_speed": 0.3, "blocking_radius": 0.1}
    described = {"name": "triangulating", **chosen, "law": dict(zip(NAMES, law.constants, strict=True))}
    assert Triangulating(law=law, **chosen).description == described
