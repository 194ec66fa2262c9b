"""``triform view``: a live team or a recorded run in the browser, or as a file that a browser opens."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from triform.control import POLICY, ControllerSpec
from triform.evaluation.scenario import Scenario
from triform.limits import check_threads
from triform.report.listener import SILENT, Listener
from triform.signals import StopSignals
from triform.threads import limit_threads
from triform.types import convert_fields, require
from triform.viewer.session import Session, Setup

if TYPE_CHECKING:
    from triform.evaluation.rollout import Trajectory
    from triform.recordings.resample import Recording
    from triform.viewer.page import Page, Stage

_LOOPBACK = "127.0.0.1"
_TITLE = "triform"


@dataclass(frozen=True)
class ViewConfig:
    """What to look at, and where.

    Attributes:
        file: A recorded run that triform measure reads; a live team if omitted.
        controller: Controller of a live team: a name such as policy, policy:paper or triangulating, or a class of your
            own as FILE.py:CLASS or MODULE:CLASS.
        robots: Number of robots of a live team; 9 if omitted, or as many as the profiles have.
        seed: The start is a function of team size and seed.
        which: Which run of a file that holds several, from 0.
        rate: Records per second of a recording in .npy [Hz].
        html: Write a page that opens without a server instead: of the recorded run, or of a run of --duration seconds.
        address: Address at which browsers reach the page; by default they run on this computer.
        port: Port of the page; the next free one if it is taken.
        threads: Threads of the simulation; one for each processor if omitted.
        scenario: Everything else about the run.
    """

    file: Path | None = None
    controller: ControllerSpec = POLICY
    robots: int | None = None
    seed: int = 7
    which: int = 0
    rate: float | None = None
    html: Path | None = None
    address: str = _LOOPBACK
    port: int = 8080
    threads: int | None = None
    scenario: Scenario = field(default_factory=Scenario)

    def __post_init__(self) -> None:
        convert_fields(self)
        check_threads(self.threads)
        require(1 <= self.port < 2**16, f"port is {self.port}; it must lie between 1 and {2**16 - 1}")
        require(self.which >= 0, f"which is {self.which}; it must not be negative")
        if self.file is None:
            require(self.which == 0 and self.rate is None, "which and rate are of recorded runs, and no file is given")
            _ = self.setup

    @property
    def setup(self) -> Setup:
        """The live team."""
        robots = self.scenario.team.team_size(self.robots, 9)
        return Setup(self.scenario, self.controller, robots, self.seed)


def run_view(config: ViewConfig, listener: Listener = SILENT, on_open: Callable[[], object] = lambda: None) -> None:
    """Show a page until Ctrl-C, or write one.

    Args:
        config: What to show.
        listener: Hears where the page is.
        on_open: Called when it has heard it.

    Raises:
        TriformError: The file cannot be read or written, the team cannot be steered, or there is no such address.
    """
    # The extra "view" brings viser; options are read and explained without it.
    from triform.figures.runs import Scene
    from triform.recordings.resample import read_recordings
    from triform.viewer.film import FilmPage
    from triform.viewer.live import LivePage
    from triform.viewer.offline import write_page
    from triform.viewer.playback import Playback
    from triform.viewer.server import close_server, open_server

    recording = None if config.file is None else _pick(read_recordings(config.file, config.rate), config.which)
    if config.html is not None:
        trajectory = recording.trajectory if recording else _simulate(config, listener)
        with listener.progress("drawing", 1):
            stage = stage_of(config, trajectory, recording)
            write_page(trajectory, Scene(*stage[:3]), config.html, stage.profiles, _TITLE)
        listener.say(f"wrote {config.html}")
        return
    session = None if recording else Session(config.setup, config.threads)
    server = open_server(config.address, config.port, _TITLE)
    try:
        with StopSignals() as signals:
            page: Page
            if session is not None:
                page = LivePage(server, session)
                session.start()
            else:
                assert recording is not None
                stage = stage_of(config, recording.trajectory, recording)
                playback = Playback(recording.trajectory, stage.distance)
                page = FilmPage(server, playback, stage, recording.label)
            listener.say(f"the page is at http://{config.address}:{server.get_port()}; Ctrl-C ends it")
            if config.address != _LOOPBACK:
                listener.say("whoever reaches that address can use the page")
            on_open()
            page.run(lambda: signals.received)
    finally:
        if session is not None:
            session.stop()
        close_server(server)


def _pick(recordings: list[Recording], which: int) -> Recording:
    require(which < len(recordings), f"which is {which}, and the file holds {len(recordings)}; they count from 0")
    return recordings[which]


def stage_of(config: ViewConfig, trajectory: Trajectory, recording: Recording | None) -> Stage:
    """Return outlines, arena and d* of a run: those that its file has, else those of the options."""
    from triform.viewer.page import Stage

    scenario = config.scenario
    profiles = scenario.team.profiles
    if recording is not None and recording.setting is not None:
        setting = recording.setting
        return Stage(setting.footprint, setting.arena, setting.distance, profiles)
    return Stage(scenario.team.outlines(trajectory.poses.shape[2]), scenario.surroundings, scenario.distance, profiles)


def _simulate(config: ViewConfig, listener: Listener) -> Trajectory:
    """Run the team for as long as the scenario says."""
    setup, scenario = config.setup, config.scenario
    controller = scenario.make_controller(setup.controller)
    poses = scenario.sample_starts(setup.robots, 1, setup.seed)
    bar = listener.progress(f"{setup.robots} robots, {scenario.duration:g} s", scenario.steps * setup.robots)
    with limit_threads(config.threads), bar as advance:
        return scenario.run(poses, controller, setup.seed, [0], advance)[0]
