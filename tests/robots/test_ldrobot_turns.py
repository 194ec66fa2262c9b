"""From packets to turns: resampling against a slow oracle, and times against the clock that made them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.robots.lidar_oracle import pack, slow_turn
from triform.robots.laser_scan import Turn
from triform.robots.ldrobot import LD19, LD20, MODELS, LidarModel, PacketParser, TurnAssembler, get_model
from triform.simulation import Mounting
from triform.types import ConfigurationError, ScanConfig


@dataclass(frozen=True)
class Sent:
    """A packet, when its last sample was measured, and its samples: centidegrees since the start, and millimetres."""

    data: bytes
    made: float
    angles: list[float]
    distances: list[int]


def bright(distance: int) -> int:
    """An intensity that tells a distance [mm] from all near it."""
    return 1 + distance % 251


def revolve(
    model: LidarModel,
    seconds: float,
    rng: np.random.Generator,
    speed: Callable[[float], float],
    stamp: float = 0.0,
    phase: int = 0,
) -> list[Sent]:
    """What a LiDAR sends that turns at ``speed(t)`` [deg/s] and whose clock shows ``stamp`` [s] at the start."""
    sent = []
    angle = float(phase)
    lasts = 12 * np.arange(1, int(seconds * model.samples_per_second / 12)) / model.samples_per_second
    for made in lasts.tolist():
        now = speed(made)
        step = 100 * now / model.samples_per_second
        first, last = int(angle), int(angle + 11 * step)
        distances = rng.integers(200, 7000, 12).tolist()
        data = pack(
            round(now),
            first % 36000,
            [(d, bright(d)) for d in distances],
            last % 36000,
            int(1000 * (made + stamp)) % 30000,
        )
        sent.append(Sent(data, made, [first + k * (last - first) / 11 for k in range(12)], distances))
        angle += 12 * step
    return sent


def assemble(assembler: TurnAssembler, sent: list[Sent], delay: Callable[[int], float] = lambda k: 0.0) -> list[Turn]:
    """Turns of packets that arrive one by one, two milliseconds and ``delay(k)`` after they were made."""
    wire = 47 * 10 / 230400
    return [
        turn
        for k, each in enumerate(sent)
        for turn in assembler.add(PacketParser().feed(each.data), each.made + wire + delay(k))
    ]


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    model=st.sampled_from([LD19, LD20]),
    rays=st.sampled_from([None, 360, 450, 667]),
    # No sample lies just on the edge of a turn or of a ray's reach, where rounding decides.
    mounting=st.builds(
        lambda degrees, upright: Mounting(yaw=math.radians(degrees + 0.0037), upright=upright),
        st.integers(-400, 400),
        st.booleans(),
    ),
    slow_down=st.floats(-0.3, 0.3),
    lost=st.sampled_from([0.0, 0.1, 0.4]),
)
def test_every_ray_has_the_sample_nearest_in_angle(
    seed: int, model: LidarModel, rays: int | None, mounting: Mounting, slow_down: float, lost: float
) -> None:
    rng = np.random.default_rng(seed)
    scan = ScanConfig(rays or model.rays, -math.pi, 0.02, 7.5)
    usual = 360 / model.period
    sent = revolve(
        model, 0.8, rng, lambda t: usual * (1 + slow_down * t), rng.uniform(29, 30), int(rng.integers(36000))
    )
    sent = [each for each in sent if rng.random() >= lost]
    turns = assemble(TurnAssembler(model, scan, mounting), sent)

    # The LiDAR's own angle, clockwise, at which it passes the gap between the last ray and the first.
    seam = mounting.direction * math.degrees(mounting.yaw - scan.angle_min + scan.angle_increment / 2)
    by_turn: dict[int, list[tuple[float, float]]] = {}
    for each in sent:
        for angle, distance in zip(each.angles, each.distances, strict=True):
            turn = math.floor((angle / 100 - seam) / 360)
            by_turn.setdefault(turn, []).append(
                (mounting.yaw - mounting.direction * math.radians(angle / 100), distance / 1000)
            )
    reach = 0.75 * max(scan.angle_increment, 2 * math.pi / model.rays)
    expected = [slow_turn(samples, scan.angles, reach) for samples in by_turn.values()]
    # The first and the last are parts of turns.
    expected = [rows for rows in expected[1:-1] if sum(map(bool, rows)) >= scan.rays / 2]
    assert len(turns) == len(expected)
    for turn, rows in zip(turns, expected, strict=True):
        assert turn.ranges.dtype == np.float32
        for shown, allowed in zip(turn.ranges.tolist(), rows, strict=True):
            assert any(abs(shown - metres) < 1e-6 for metres in allowed) if allowed else math.isnan(shown)
        assert turn.intensities is not None
        told = np.array([0 if math.isnan(metres) else bright(round(1000 * metres)) for metres in turn.ranges.tolist()])
        np.testing.assert_array_equal(turn.intensities, told)


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
@pytest.mark.parametrize("factor", [0.6, 1.0, 1.3])
def test_at_any_speed_at_most_the_ray_beside_the_gap_is_empty(model: LidarModel, factor: float) -> None:
    rng = np.random.default_rng(3)
    turns = assemble(TurnAssembler(model), revolve(model, 2, rng, lambda t: factor * 360 / model.period))
    assert len(turns) in range(int(2 * factor / model.period) - 2, int(2 * factor / model.period) + 1)
    for turn in turns:
        assert set(np.flatnonzero(np.isnan(turn.ranges))) <= {0, model.rays - 1}
        assert factor > 1 or not np.isnan(turn.ranges).any()


def test_turns_do_not_depend_on_how_packets_come() -> None:
    sent = revolve(LD20, 1, np.random.default_rng(5), lambda t: 2160)
    one_by_one = assemble(TurnAssembler(LD20), sent)
    at_once = TurnAssembler(LD20).add(PacketParser().feed(b"".join(each.data for each in sent)), 1.0)
    assert len(one_by_one) == len(at_once) >= 4
    for a, b in zip(one_by_one, at_once, strict=True):
        np.testing.assert_array_equal(a.ranges, b.ranges)


def test_times_are_those_of_the_measurement_whatever_holds_packets_up() -> None:
    """Half of all packets wait for up to 30 ms for others; both clocks drift apart by 100 ppm; the stamp wraps."""
    rng = np.random.default_rng(7)
    sent = revolve(LD19, 12, rng, lambda t: 3600 * (1 + 1e-4), stamp=25.0)
    held, arrivals = [], []
    for each in sent:
        held.append(each)
        if rng.random() < 0.15:
            arrivals.append(held)
            held = []
    assembler = TurnAssembler(LD19)
    turns = [
        turn
        for group in arrivals
        for turn in assembler.add(
            PacketParser().feed(b"".join(each.data for each in group)),
            1000 + group[-1].made * (1 - 1e-4) + 0.00204 + rng.choice([0.0, rng.uniform(0, 0.02)]),
        )
    ]
    assert len(turns) > 110
    seam = 36000 * 0.5 + 40
    for turn in turns[10:]:
        whole = round((turn.started - 1000) * 10 - seam / 36000)
        exact = (whole + seam / 36000) * 0.1
        assert turn.started - 1000 == pytest.approx(exact, abs=0.004)
        assert turn.ended - turn.started == pytest.approx(0.1, abs=0.002)
    starts = np.array([turn.started for turn in turns])
    assert (np.diff(starts) > 0.09).all()


def test_a_lidar_that_starts_again_begins_anew() -> None:
    rng = np.random.default_rng(9)
    before = revolve(LD19, 1, rng, lambda t: 3600, stamp=3.0)
    for stamp, pause in ((0.0, 0.4), (17.0, 0.0), (29.0, 2.5), (3.9, 40.0)):
        assembler = TurnAssembler(LD19)
        assert len(assemble(assembler, before)) >= 8
        after = [
            Sent(each.data, each.made + 1 + pause, each.angles, each.distances)
            for each in revolve(LD19, 1, rng, lambda t: 3600, stamp, 9000)
        ]
        turns = assemble(assembler, after)
        assert len(turns) in (8, 9)
        for turn in turns:
            assert 1 + pause <= turn.started < turn.ended <= 2.01 + pause
            assert not np.isnan(turn.ranges).any()


def test_a_gap_within_a_turn_is_no_measurement_and_a_long_one_drops_it() -> None:
    sent = revolve(LD19, 1, np.random.default_rng(11), lambda t: 3600)
    turns = assemble(TurnAssembler(LD19), [each for k, each in enumerate(sent) if k not in (120, 121)])
    missing = [int(np.isnan(turn.ranges).sum()) for turn in turns]
    assert sorted(missing)[:-1] == [0] * (len(turns) - 1)
    assert max(missing) in range(22, 26)
    whole = assemble(TurnAssembler(LD19), sent)
    # Twelve and a half turns of packets are gone, less than a second's worth of each turn counts as one turn.
    holes = assemble(TurnAssembler(LD19), [each for k, each in enumerate(sent) if not 100 <= k < 240])
    assert len(holes) < len(whole) - 2
    assert all(np.isnan(turn.ranges).mean() <= 0.5 for turn in holes)


def test_one_sample_back_across_the_gap_ends_no_turn() -> None:
    """Uneven speed makes the LiDAR seem to step back by a sample just behind the gap."""
    sent = revolve(LD19, 1, np.random.default_rng(13), lambda t: 3600, phase=18040 - 960 * 20)
    crossing = next(k for k, each in enumerate(sent) if each.angles[0] == 18040)
    again = [*sent[:crossing], *sent[crossing - 1 : crossing], *sent[crossing:]]
    smooth, stepped = (assemble(TurnAssembler(LD19), each) for each in (sent, again))
    assert len(smooth) == len(stepped)
    for a, b in zip(smooth, stepped, strict=True):
        np.testing.assert_array_equal(a.ranges, b.ranges)


def test_distances_become_ranges_after_rep_117() -> None:
    scan = ScanConfig(450, -math.pi, 0.1, 2.0)
    cases = {
        0: math.inf,
        1: -math.inf,
        99: -math.inf,
        100: 0.1,
        1234: 1.234,
        2000: 2.0,
        2001: math.inf,
        65535: math.inf,
    }
    for distance, expected in cases.items():
        sent = [
            pack(3600, k * 960 % 36000, [(distance, 9)] * 12, (k * 960 + 880) % 36000, int(k * 8 / 3))
            for k in range(100)
        ]
        turns = TurnAssembler(LD19, scan).add(PacketParser().feed(b"".join(sent)), 5.0)
        assert turns
        assert (turns[0].ranges == np.float32(expected)).all()


def test_of_equally_near_samples_the_nearer_range_counts() -> None:
    def still(k: int) -> bytes:
        """All twelve samples in one direction; nothing, near, far in turn."""
        return pack(3600, k * 80 % 36000, [(0, 0), (900, 1), (1800, 1)] * 4, k * 80 % 36000, int(k * 2 / 9) % 30000)

    turns = TurnAssembler(LD19).add(PacketParser().feed(b"".join(map(still, range(1000)))), 1.0)
    assert turns
    assert (turns[0].ranges == np.float32(0.9)).all()


def test_left_is_left() -> None:
    """A LiDAR counts clockwise: what it sees at 90 degrees is on its right, and on its left if it hangs upside down."""
    sent = [
        pack(3600, start, [(1000 if 8000 < start < 9500 else 5000, 9)] * 12, (start + 880) % 36000, int(k * 8 / 3))
        for k, start in enumerate(np.arange(0, 96000, 960) % 36000)
    ]
    for yaw, upright in itertools.product((0.0, math.pi / 2, math.pi), (True, False)):
        mounting = Mounting(yaw=yaw, upright=upright)
        (turn, *_) = TurnAssembler(LD19, mounting=mounting).add(PacketParser().feed(b"".join(sent)), 5.0)
        seen = LD19.scan_config().angles[turn.ranges < 2]
        assert abs(math.remainder(seen[len(seen) // 2] - (yaw - mounting.direction * math.pi / 2), 2 * math.pi)) < 0.2


def test_models_are_checked() -> None:
    assert {name: model.rays for name, model in MODELS.items()} == {
        "ld19": 450,
        "ld06": 450,
        "stl-19p": 500,
        "ld20": 667,
        "ld14p": 667,
    }
    assert LD20.scan_config(2.0) == ScanConfig(667, -math.pi, 0.1, 2.0)
    assert get_model("LD06") is LD19
    with pytest.raises(ConfigurationError, match="period is 0"):
        LidarModel("none", 4500, 0, 0.1, 8)
    with pytest.raises(ConfigurationError, match="range_min"):
        LidarModel("none", 4500, 0.1, 9, 8)


@pytest.mark.parametrize(
    ("name", "maker"),
    [("rplidar-a1", "RPLIDAR"), ("YDLIDAR X4", "YDLIDAR"), ("urg-04lx", "Hokuyo"), ("TiM561", "SICK")],
)
def test_lidars_of_others_are_sent_to_ros(name: str, maker: str) -> None:
    with pytest.raises(ConfigurationError, match=rf"^the LiDAR {name!r} is one of .*{maker}, .*ROS 2 driver[^\n]*$"):
        get_model(name)
    with pytest.raises(
        ConfigurationError, match=r"no LiDAR model 'ld18' \(did you mean 'ld19'\?\); there are ld19, ld06"
    ):
        get_model("ld18")
