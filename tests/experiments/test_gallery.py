from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import tyro
from PIL import Image

from triform.cli import COMMANDS
from triform.commands.options import CONFIG, registry
from triform.experiments import gallery as module
from triform.experiments.gallery import Card, GalleryConfig, list_cards, run_gallery, shrink
from triform.figures.style import BLUE, SERIES, VERMILLION, rgb
from triform.types import TriformError

CARDS = {card.key: card for card in list_cards()}


@pytest.mark.parametrize("key", CARDS)
def test_every_command_of_the_gallery_parses(key):
    for line in CARDS[key].command.split(" && "):
        words = shlex.split(line)
        assert words[0] == "triform"
        tyro.cli(COMMANDS[words[1]].load(), args=words[2:], config=CONFIG, registry=registry)


def test_the_committed_page_has_the_commands_of_today():
    page = (Path(__file__).parents[2] / "docs" / "gallery" / "index.md").read_text()
    assert re.findall(r"^Command: `(.*)`\.$", page, re.MULTILINE) == [card.command for card in CARDS.values()]
    for name in re.findall(r"\]\(([^)]+)\)", page):
        assert (Path(__file__).parents[2] / "docs" / "gallery" / name).exists()


def picture(folder: Path, ending: str) -> Path:
    path = folder / f"picture.{ending}"
    Image.fromarray(np.full((20, 30, 3), 200, dtype=np.uint8)).save(path)
    return path


def test_the_page_shows_every_picture_with_its_command(tmp_path, monkeypatch, listener):
    cards = [
        Card(
            kind,
            f"A {kind}",
            "It says <so>.",
            f"triform demo --seed {seed}",
            lambda folder, kind=kind: picture(folder, kind),
        )
        for seed, kind in enumerate(("png", "gif"))
    ]
    monkeypatch.setattr(module, "list_cards", lambda threads: cards)
    paths = run_gallery(GalleryConfig(tmp_path / "page"), listener)
    assert [path.name for path in paths] == ["png.png", "gif.gif", "index.md", "index.html"]
    markdown, page = (path.read_text() for path in paths[2:])
    assert re.findall(r"!\[.*\]\((.*)\)", markdown) == ["png.png", "gif.gif"]
    assert "Command: `triform demo --seed 1`.\n" in markdown
    assert re.findall(r'src="data:image/(\w+);base64,', page) == ["png", "gif"]
    assert "It says &lt;so&gt;." in page
    assert "Data" not in page
    assert str(paths[0]) in listener.console.file.getvalue()


def test_a_picture_is_shrunk_and_keeps_the_colours_of_the_style(tmp_path):
    # Two small marks beside very many other colours, as a legend has.
    shades = np.mgrid[0:100, 0:2800].transpose(1, 2, 0) * [255 / 100, 255 / 2800]
    image = np.concatenate([shades, shades[..., :1]], axis=-1).astype(np.uint8)
    image[:24, :24], image[:24, 100:124] = rgb(BLUE), rgb(VERMILLION)
    path = tmp_path / "picture.png"
    Image.fromarray(image).save(path)
    (tmp_path / "small.png").write_bytes(shrink(path))
    with Image.open(tmp_path / "small.png") as small:
        assert small.size == (1400, 50)
        pixels = np.asarray(small.convert("RGB"))
    np.testing.assert_array_equal(pixels[6, 6], rgb(BLUE))
    np.testing.assert_array_equal(pixels[6, 56], rgb(VERMILLION))
    assert len({tuple(rgb(colour)) for colour in SERIES}) == len(SERIES)


def test_a_bad_folder_is_refused_before_anything_is_drawn(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(TriformError, match="cannot write"):
        run_gallery(GalleryConfig(tmp_path / "file" / "page"))
