"""A page of pictures of what the package does, each with the command that makes it."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from PIL import Image

from triform.control import POLICY, ControllerSpec
from triform.evaluation.events import Event
from triform.evaluation.overrides import Overrides
from triform.evaluation.runs import Execution
from triform.evaluation.scenario import Scenario
from triform.experiments.demo import DemoConfig, DemoRun, drive_team
from triform.experiments.evaluate import EvaluateConfig, run_evaluate
from triform.experiments.reproduce import ReproduceConfig, What, run_reproduce
from triform.figures.film import in_palette, palette_of
from triform.files import write_atomically
from triform.limits import check_threads
from triform.recordings.measure import MeasureConfig, run_measure
from triform.report.listener import SILENT, Listener
from triform.report.output import own_folder
from triform.report.page import Section, spell_command, write_pages
from triform.report.tables import require_parquet
from triform.types import convert_fields

#: Largest width [pixels] and number of colours of the page's pictures.
_WIDTH, _COLOURS = 1400, 128
#: Runs of the contact sheet.
_RUNS = 40


@dataclass(frozen=True)
class GalleryConfig:
    """A page of pictures.

    Attributes:
        output: Folder for the page, as Markdown and HTML, and its pictures.
        threads: Threads of the whole command; one for each processor if omitted.
    """

    output: Path = Path("gallery")
    threads: int | None = None

    def __post_init__(self) -> None:
        convert_fields(self)
        check_threads(self.threads)


@dataclass(frozen=True)
class Card:
    """One picture of the page.

    Attributes:
        key: Name of its file, without the ending.
        title: Heading.
        text: What one sees.
        command: What makes the picture; several commands one after the other.
        make: Makes it in a folder, and returns its file.
    """

    key: str
    title: str
    text: str
    command: str
    make: Callable[[Path], Path]


def run_gallery(config: GalleryConfig, listener: Listener = SILENT) -> list[Path]:
    """Draw all pictures, and write the page.

    Args:
        config: Where to.
        listener: Hears of progress and files.

    Returns:
        The files written, the page last.

    Raises:
        TriformError: The folder cannot be written.
    """
    require_parquet()
    found = list_cards(config.threads)
    written, sections = [], []
    with own_folder(config.output), listener.progress("pictures", len(found)) as advance:
        for card in found:
            with tempfile.TemporaryDirectory() as folder:
                picture = card.make(Path(folder))
                path = config.output / f"{card.key}{picture.suffix}"
                write_atomically(path, picture.read_bytes() if picture.suffix == ".gif" else shrink(picture))
            written.append(path)
            sections.append(Section(card.key, card.title, card.text, card.command, [], [], path.name, []))
            advance()
        introduction = "Every picture, with the command that makes it. The whole page: triform gallery."
        written += write_pages(config.output, "Gallery", sections, introduction=introduction)
    for path in written:
        listener.say(f"wrote {path}")
    return written


def shrink(picture: Path) -> bytes:
    """Return a picture with fewer pixels and colours, as PNG."""
    with Image.open(picture) as opened:
        image = opened.convert("RGB")
    if image.width > _WIDTH:
        image = image.resize((_WIDTH, round(image.height * _WIDTH / image.width)), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    few = in_palette(image, palette_of(image, _COLOURS))
    few.save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()


def list_cards(threads: int | None = None) -> list[Card]:
    """Return all pictures in the order of the page."""
    furnished = DemoConfig(scenario=Scenario(arena="living-room", overrides=Overrides(min_intensity=230.0)))
    return [
        _demo(
            "push",
            "Nine robots form a triangulation",
            "The shipped policy drives nine robots; one is pushed away after 12 s. On the right: what the LiDAR of the "
            "ringed robot returns, the map that its network reads, and the formation error.",
            DemoConfig(speed=2.0, threads=threads, scenario=Scenario(event=Event("push", 12.0), duration=24.0)),
            lambda run, folder: run.animate(folder / "demo.gif"),
        ),
        _reproduced(
            "snapshots",
            "Teams over time",
            "Nine and thirteen robots at the start, after 2, 5, 10 and 20 s, and at the end, each with its way so far.",
            "fig2",
            threads,
        ),
        _demo(
            "sight",
            "What one robot sees",
            "The robot in the middle of the circle, 2 s after the start: returns of its LiDAR, the cells that they "
            "occupy, and the patches that hold some, which are the tokens of its network.",
            DemoConfig(threads=threads),
            lambda run, folder: run.draw_sight(folder / "sight.png"),
        ),
        _demo(
            "fifty",
            "Fifty robots",
            "The law from which the policy learned drives fifty robots, which see true positions up to 3 d*.",
            DemoConfig(ControllerSpec("triangulating"), 50, threads=threads, scenario=Scenario(duration=120.0)),
            _draw,
        ),
        _demo(
            "mixed",
            "A mixed team",
            "Three round TurtleBots on two wheels and two mecanum robots with a simulated LD19 form one triangulation.",
            DemoConfig(robots=5, threads=threads, scenario=Scenario("turtlebot4:3 hardware:2", duration=60.0)),
            _draw,
        ),
        _demo(
            "furniture",
            "Among furniture",
            "Nine robots that wear reflecting tape form a triangulation in a living room.",
            replace(furnished, threads=threads),
            _draw,
        ),
        _demo(
            "tape",
            "What tape is for",
            "The same room: returns of furniture (grey) are dimmer than those of tape, and stay out of the map.",
            replace(furnished, threads=threads),
            lambda run, folder: run.draw_sight(folder / "sight.png"),
        ),
        _reproduced(
            "change",
            "A robot comes, a robot goes",
            "Above, a robot (orange) comes to six; below, one of seven (vermillion) goes; both teams form again.",
            "fig5",
            threads,
        ),
        _sheet(threads),
    ]


def _demo(key: str, title: str, text: str, config: DemoConfig, draw: Callable[[DemoRun, Path], list[Path]]) -> Card:
    """Return the card of a picture that ``triform demo`` draws."""
    command = spell_command(["triform", "demo"], config, never=("output", "threads"))
    return Card(key, title, text, command, lambda folder: draw(drive_team(config), folder)[0])


def _draw(run: DemoRun, folder: Path) -> list[Path]:
    return run.draw(folder / "demo.png")


def _reproduced(key: str, title: str, text: str, what: What, threads: int | None) -> Card:
    """Return the card of a figure of ``triform reproduce``, of as few runs as it takes."""
    config = ReproduceConfig(what, POLICY, runs=1, scenario=Scenario(), execution=Execution(threads=threads))

    def make(folder: Path) -> Path:
        run_reproduce(replace(config, output=folder))
        return folder / f"{what}.png"

    return Card(key, title, text, config.command(what), make)


def _sheet(threads: int | None) -> Card:
    """Return the card of a contact sheet."""
    kept = Path("runs.parquet")
    execution = Execution(threads=threads)
    config = EvaluateConfig(ControllerSpec("policy", "paper"), (9,), _RUNS, keep=kept, execution=execution)

    def make(folder: Path) -> Path:
        run_evaluate(replace(config, keep=folder / kept))
        run_measure(MeasureConfig((folder / kept,), figures=folder, threads=threads))
        return folder / "sheet.png"

    text = (
        f"How {_RUNS} runs of the published method end. Distances are right in most; those in a vermillion frame "
        "failed, nearly all because some edge is in no triangle."
    )
    command = f"{spell_command(['triform', 'evaluate'], config)} && triform measure {kept} --figures figures"
    return Card("sheet", "Many runs at a glance", text, command, make)
