"""How many threads a parallel kernel is worth."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numba

#: Rays that one more thread should have to cast, about 2 ms of work, before it is woken: on a machine whose cores
#: are busy otherwise, waiting for a second thread can take a whole time slice (10 ms and more).
RAYS_PER_THREAD = 1_000_000
#: The same where every ray is cast by itself, at its own moment or perturbed angle: about 20 times slower.
MOVING_RAYS_PER_THREAD = 50_000


@contextmanager
def threads_for(rays: int, rays_per_thread: int) -> Iterator[None]:
    """Let the kernels called inside use no more threads than ``rays`` are worth; results never depend on it."""
    allowed = numba.get_num_threads()
    numba.set_num_threads(min(allowed, max(1, rays // rays_per_thread)))
    try:
        yield
    finally:
        numba.set_num_threads(allowed)
