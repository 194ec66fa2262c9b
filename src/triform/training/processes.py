"""One training in several processes, as ``torchrun`` starts them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, distributed

from triform.types import TriformError


@dataclass(frozen=True)
class Processes:
    """The processes of a training.

    Attributes:
        rank: Number of this process; the first one, 0, writes and reports.
        count: How many there are.
    """

    rank: int = 0
    count: int = 1

    @property
    def first(self) -> bool:
        """Whether this process writes and reports."""
        return self.rank == 0

    def share(self, items: int) -> tuple[int, int]:
        """First and last (exclusive) of ``items`` items that fall to this process."""
        return items * self.rank // self.count, items * (self.rank + 1) // self.count

    def add(self, values: Tensor) -> None:
        """Sum ``values`` over all processes, in place; all get the same bits.

        Raises:
            TriformError: If another process is gone.
        """
        if self.count > 1:
            try:
                distributed.all_reduce(values)
            except RuntimeError as error:
                raise TriformError(
                    f"process {self.rank} of {self.count} lost the others; continue with --resume from the last saved "
                    f"state ({str(error).splitlines()[0]})"
                ) from error

    def wait(self) -> None:
        """Wait until all processes have come here.

        Raises:
            TriformError: If another process is gone.
        """
        self.add(torch.zeros(1))


#: A training in one process.
ALONE = Processes()


def launched() -> Processes:
    """The processes that ``torchrun`` started; a process started otherwise is alone."""
    return Processes(int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1")))


def local_device(device: str) -> str:
    """The device of this process: of several GPUs of a machine, each process takes one."""
    return f"cuda:{os.environ.get('LOCAL_RANK', '0')}" if device == "cuda" else device


@contextmanager
def joined(device: torch.device) -> Iterator[Processes]:
    """Join the processes that ``torchrun`` started, over Gloo on the CPU and NCCL on GPUs.

    Raises:
        TriformError: If they cannot be reached.
    """
    processes = launched()
    if processes.count == 1:
        yield processes
        return
    try:
        if device.type == "cuda":
            torch.cuda.set_device(device)
        # Numbers that the host needs travel over Gloo even where gradients travel over NCCL.
        distributed.init_process_group("cpu:gloo,cuda:nccl" if device.type == "cuda" else "gloo")
    except (RuntimeError, ValueError) as error:
        raise TriformError(f"the {processes.count} processes cannot reach each other: {error}") from error
    yield processes
    # Not after an error: leaving a group that has lost a member may wait for it.
    distributed.destroy_process_group()
