"""Says that Ray was lost for a process that Ray has ended, which Ray does at once and without a word.

As a script, ``python last_word.py NAME HOST PORT ...``, it reads its standard input: a byte is a farewell, and an end
without one is the end of the process that began the script. It imports nothing of the package, and so begins at once.
"""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Mapping

LOST = (
    "Ray was lost: its {} does not answer any more; what was finished before is safe, so run the same command again to "
    "continue, on a Ray that works"
)
#: How long a server may take to answer [s].
_PATIENCE = 2.0
#: Looks, and time between two of them [s]: servers may end after the process.
_LOOKS, _PERIOD = 5, 0.2


def unreachable(servers: Mapping[str, tuple[str, int]]) -> str:
    """Return the name of the first server, host and port by name, that cannot be reached; empty if all can."""
    for name, place in servers.items():
        try:
            socket.create_connection(place, _PATIENCE).close()
        except OSError:
            return name
    return ""


def _main(words: list[str]) -> None:
    if sys.stdin.buffer.read(1):
        return
    servers = {name: (host, int(port)) for name, host, port in zip(words[::3], words[1::3], words[2::3], strict=True)}
    for _ in range(_LOOKS):
        gone = unreachable(servers)
        if gone:
            sys.stderr.write(f"triform: {LOST.format(gone)}\n")
            return
        time.sleep(_PERIOD)


if __name__ == "__main__":
    _main(sys.argv[1:])
