"""LDROBOT's LiDARs LD19, LD14P and LD20: their packets, their turns, their serial port, and an emulator."""

from __future__ import annotations

from triform.robots.ldrobot.emulator import LidarEmulator
from triform.robots.ldrobot.models import LD19, LD20, MODELS, LidarModel
from triform.robots.ldrobot.packets import PACKET, PacketParser, Packets, encode_packets
from triform.robots.ldrobot.port import LidarError, LidarPort
from triform.robots.ldrobot.turns import TurnAssembler

__all__ = [
    "LD19",
    "LD20",
    "MODELS",
    "PACKET",
    "LidarEmulator",
    "LidarError",
    "LidarModel",
    "LidarPort",
    "PacketParser",
    "Packets",
    "TurnAssembler",
    "encode_packets",
]
