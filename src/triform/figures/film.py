"""Frames as files: a GIF for pages, an MP4 for talks."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from PIL import Image

from triform.figures.style import HELD, INK, SERIES, Colours, rgb
from triform.files import write_atomically
from triform.types import IntArray

#: How long a frame is shown, and the last one [ms]; a GIF counts in units of 10 ms.
FRAME_MS, LAST_FRAME_MS = 50, 2000
#: Colours of a GIF, which has room for 256; the last one marks pixels that stay as they were.
_COLOURS, _UNCHANGED = 192, 255
#: Bits of each channel by which a colour finds its place in the palette.
_BITS = 5
#: Quality of an MP4 (smaller is better and larger), and how hard the encoder tries.
_QUALITY = {"crf": "20", "preset": "fast", "threads": "1"}


class _Encoder(Protocol):
    """Makes a file of frames."""

    def add(self, frame: Colours) -> None:
        """Take the next frame, shape (H, W, 3)."""
        ...

    def finish(self) -> bytes:
        """Return the file."""
        ...


def write_film(frames: Iterable[Colours], samples: Sequence[Colours], gif: Path, video: Path | None = None) -> None:
    """Write frames as a GIF that repeats and perhaps as an MP4 (H.264), each whole or not at all.

    Args:
        frames: Pictures of one size with even sides, each of shape (H, W, 3).
        samples: Some of them, which show all colours.
        gif: Where to write the GIF.
        video: Where to write the MP4; there is none if omitted.

    Raises:
        TriformError: A file cannot be written.
        ModuleNotFoundError: PyAV is not installed, and an MP4 is wanted.
    """
    height, width, _ = samples[0].shape
    encoders: dict[Path, _Encoder] = {gif: _Gif(samples)}
    if video is not None:
        encoders[video] = _Video(height, width)
    for frame in frames:
        for encoder in encoders.values():
            encoder.add(frame)
    done = {path: encoder.finish() for path, encoder in encoders.items()}
    for path, data in done.items():
        write_atomically(path, data)


def palette_of(image: Image.Image, colours: int) -> Colours:
    """Return a palette of at most ``colours`` colours for an image, those of the style among them, shape (K, 3)."""
    own = np.array([rgb(colour) for colour in ("#ffffff", *SERIES, INK, HELD)])
    few = image.quantize(colours - len(own), Image.Quantize.MEDIANCUT, kmeans=1, dither=Image.Dither.NONE)
    found = np.array(few.getpalette(), dtype=np.uint8).reshape(-1, 3)
    return np.concatenate([own, found[: colours - len(own)]])


def in_palette(image: Image.Image, palette: Colours) -> Image.Image:
    """Return an image with every pixel in the nearest colour of a palette (K, 3)."""
    pixels = np.asarray(image.convert("RGB")).reshape(-1, 3)
    colours, which = np.unique(pixels @ np.array([1 << 16, 1 << 8, 1]), return_inverse=True)
    given = np.stack([colours >> 16, (colours >> 8) & 255, colours & 255], axis=1)
    nearest = _nearest(given, palette)[which]
    found = Image.fromarray(nearest.reshape(image.height, image.width), mode="P")
    found.putpalette(palette.tobytes())
    return found


def _nearest(colours: IntArray, palette: Colours) -> Colours:
    """Return which colour of a palette (K, 3) is nearest to each of others (M, 3), shape (M,)."""
    # The square of the distance, less that of the colour alone.
    away = (palette.astype(np.float64) ** 2).sum(axis=1) - 2.0 * (colours @ palette.T.astype(np.float64))
    return np.asarray(away.argmin(axis=1), dtype=np.uint8)


class _Gif:
    """A GIF with one palette, whose frames hold only what changes."""

    def __init__(self, samples: Sequence[Colours]) -> None:
        found = palette_of(Image.fromarray(np.concatenate([sample[::2, ::2] for sample in samples])), _COLOURS)
        palette = np.zeros((256, 3), dtype=np.uint8)
        palette[: len(found)] = found
        self._palette = palette.tobytes()
        levels = (np.arange(1 << _BITS) * 255 + 15) // ((1 << _BITS) - 1)
        cells = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(-1, 3)
        self._table = _nearest(cells, found)
        self._frames: list[Image.Image] = []

    def add(self, frame: Colours) -> None:
        red, green, blue = (frame >> (8 - _BITS)).astype(np.uint16).transpose(2, 0, 1)
        picture = Image.fromarray(self._table[(red << 2 * _BITS) | (green << _BITS) | blue], mode="P")
        picture.putpalette(self._palette)
        self._frames.append(picture)

    def finish(self) -> bytes:
        first, *others = self._frames
        buffer = io.BytesIO()
        first.save(
            buffer,
            format="GIF",
            save_all=True,
            append_images=others,
            duration=[FRAME_MS] * len(others) + [LAST_FRAME_MS],
            loop=0,
            optimize=True,
            transparency=_UNCHANGED,
        )
        return buffer.getvalue()


class _Video:
    """An MP4 that every browser and slide program plays."""

    def __init__(self, height: int, width: int) -> None:
        import av

        self._frame_of: Any = av.VideoFrame.from_ndarray
        self._buffer = io.BytesIO()
        self._container: Any = av.open(self._buffer, "w", format="mp4")
        self._stream: Any = self._container.add_stream("libx264", rate=1000 // FRAME_MS, options=_QUALITY)
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"
        self._last: Any = None

    def add(self, frame: Colours) -> None:
        self._last = self._frame_of(frame, format="rgb24")
        self._write(self._last)

    def finish(self) -> bytes:
        for _ in range(LAST_FRAME_MS // FRAME_MS - 1):
            self._last.pts = None
            self._write(self._last)
        self._write(None)
        self._container.close()
        return self._buffer.getvalue()

    def _write(self, frame: Any) -> None:
        self._container.mux(self._stream.encode(frame))
