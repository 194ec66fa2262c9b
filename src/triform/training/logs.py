"""Training logs: JSON lines and TensorBoard."""

from __future__ import annotations

import json
import math
import warnings
from pathlib import Path

from triform.files import cannot_write, write_atomically

with warnings.catch_warnings():
    # TensorBoard's own imports warn of NumPy and protobuf deprecations that are not ours to mend.
    warnings.simplefilter("ignore")
    from torch.utils.tensorboard import SummaryWriter

LOG_FILE = "log.jsonl"


class TrainingLog:
    """Appends scalars to ``log.jsonl`` and to TensorBoard; on resumption drops what comes after the resumed step."""

    def __init__(self, out: Path, step: int) -> None:
        self._path = out / LOG_FILE
        kept = []
        if step > 0 and self._path.exists():
            lines = self._path.read_text(encoding="utf-8", errors="replace").splitlines()
            kept = [line for line in lines if _step_of(line) <= step]
        write_atomically(self._path, "".join(line + "\n" for line in kept).encode())
        try:
            self._writer = SummaryWriter(str(out / "tensorboard"), purge_step=step + 1)
        except OSError as error:
            raise cannot_write(out / "tensorboard", error) from error

    def __enter__(self) -> TrainingLog:
        return self

    def write(self, step: int, scalars: dict[str, float]) -> None:
        """Record scalars at a step; what is not a number becomes ``null``."""
        finite = {name: value if math.isfinite(value) else None for name, value in scalars.items()}
        try:
            with self._path.open("a") as file:
                file.write(json.dumps({"step": step, **finite}) + "\n")
        except OSError as error:
            raise cannot_write(self._path, error) from error
        for name, value in scalars.items():
            self._writer.add_scalar(name, value, step)

    def __exit__(self, *_: object) -> None:
        self._writer.close()


def _step_of(line: str) -> float:
    """Step of a log line; a line cut short by a kill comes after every step."""
    try:
        return float(json.loads(line)["step"])
    except (ValueError, KeyError, TypeError):
        return float("inf")
