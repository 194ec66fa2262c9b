"""LiDAR scans per second, beside VMAS and IR-SIM on equal worlds."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator

import numpy as np

from benchmarks.report import Aim, Row
from benchmarks.scenes import start_poses
from benchmarks.settings import Settings, Watch
from benchmarks.timing import Side, Spread, compare
from triform.simulation import ROBOMASTER_EP, Arena, World, cast_scans, get_profile
from triform.threads import limit_threads
from triform.types import FloatArray, ScanConfig

ROBOTS = 7
SCAN = ScanConfig()
_WORK = f"{ROBOTS} boxes of 0.32 m x 0.24 m, {SCAN.rays} rays, {SCAN.range_max:g} m"
#: Two ranges differ if they are farther apart than this [m]; VMAS computes in single precision.
_DIFFERENT = 1e-3


def measure(settings: Settings, watch: Watch) -> Iterator[Row]:
    """Scans against VMAS on each number of threads, and against IR-SIM with and without its step."""
    worlds = 8 if settings.quick else 256
    yield from _against_vmas(settings, watch, worlds)
    yield from _against_irsim(settings, watch, worlds)


def _casting(poses: FloatArray, scan: ScanConfig, threads: int) -> Callable[[], FloatArray]:
    active = np.ones(poses.shape[:2], dtype=np.bool_)

    def cast() -> FloatArray:
        with limit_threads(threads):
            return cast_scans(poses, active, ROBOMASTER_EP, Arena.open(), scan)

    return cast


def _against_vmas(settings: Settings, watch: Watch, worlds: int) -> Iterator[Row]:
    what = f"scans/s against VMAS, {_WORK}, {worlds} worlds"
    try:
        from benchmarks.peers.vmas_lidar import VmasLidars
    except ModuleNotFoundError as error:
        yield _missing(what, 40, error)
        return
    poses = start_poses(ROBOTS, worlds)
    peer = VmasLidars(poses, ROBOMASTER_EP, SCAN)
    same = _agreement(_casting(poses, SCAN, 1)(), peer.ranges())
    for threads in settings.thread_counts:
        sides = [
            Side("triform", _casting(poses, SCAN, threads), worlds * ROBOTS),
            Side("VMAS", functools.partial(peer.measure, threads), worlds * ROBOTS),
        ]
        seconds = compare(sides, settings, watch, what)
        note = (
            f"{same} VMAS computes in single precision, every ray with every box; triform in double precision, only "
            "the rays that can meet a box."
        )
        yield _comparison(f"{what}, {_threads(threads)}", seconds, 40, note)


def _against_irsim(settings: Settings, watch: Watch, worlds: int) -> Iterator[Row]:
    what = f"scans/s against IR-SIM, {_WORK}, 1 thread"
    try:
        from benchmarks.peers.irsim_lidar import IrsimWorld, same_angles
    except ModuleNotFoundError as error:
        yield _missing(what, 200, error)
        return
    profile = get_profile("ideal")
    scan = same_angles(SCAN)
    poses = start_poses(ROBOTS, worlds)
    single = 8
    peers = [IrsimWorld(each, ROBOMASTER_EP, scan, profile.control_period) for each in poses[:single]]
    same = _agreement(_casting(poses[:single], scan, 1)(), np.array([peer.ranges() for peer in peers]))
    own = World(poses, profile)
    still = np.zeros_like(poses)

    def step() -> None:
        with limit_threads(1):
            own.apply(still, profile.control_period)

    def all_peers(work: Callable[[IrsimWorld], None]) -> Callable[[], None]:
        def turn() -> None:
            for peer in peers:
                work(peer)

        return turn

    sensing = [
        Side("triform", _casting(poses, scan, 1), worlds * ROBOTS),
        Side("IR-SIM", all_peers(IrsimWorld.sense), single * ROBOTS),
    ]
    note = f"{same} IR-SIM has one world at a time and takes {single} in turn; triform has {worlds} at once."
    yield _comparison(f"{what}, sensing alone", compare(sensing, settings, watch, what), 200, note)
    stepping = [
        Side("triform", step, worlds * ROBOTS),
        Side("IR-SIM", all_peers(IrsimWorld.step), single * ROBOTS),
    ]
    seconds = compare(stepping, settings, watch, what)
    note = (
        f"Robots stand still. In the step of 0.1 s triform integrates {profile.control_period / profile.time_step:.0f} "
        "times and looks for contacts each time; IR-SIM does both once."
    )
    yield _comparison(f"{what}, a step of the world with its scans", seconds, 200, note)


def _comparison(what: str, seconds: dict[str, FloatArray], aim: float, note: str) -> Row:
    """A row of how many times as many scans triform makes as the other side."""
    own, peer = seconds
    sides = {name: Spread.of(1 / each, "scans/s") for name, each in seconds.items()}
    return Row(what, Spread.of(seconds[peer] / seconds[own], "x"), Aim(">=", aim), sides, note)


def _missing(what: str, aim: float, error: ModuleNotFoundError) -> Row:
    return Row(what, None, Aim(">=", aim), note=f"{error.name} is not installed; the extra bench brings it")


def _threads(count: int) -> str:
    return f"{count} thread{'s' * (count > 1)}"


def _agreement(own: FloatArray, peer: FloatArray) -> str:
    """How far the ranges of both sides are from equal, in words."""
    difference = np.abs(np.minimum(own, SCAN.range_max) - peer)
    share = float(np.mean(difference > _DIFFERENT))
    exponent = math.ceil(math.log10(max(float(difference.max()), 1e-300)))
    if share == 0:
        return f"Equal work: no range differs by more than 1e{exponent} m."
    return f"{100 * share:.2g} % of the ranges differ by more than {_DIFFERENT:g} m."
