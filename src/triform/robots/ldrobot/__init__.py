"""LDROBOT's LiDARs LD06, LD19, STL-19P, LD14P and LD20: packets, turns, serial port, and an emulator."""

from __future__ import annotations

from triform.robots.ldrobot.emulator import LidarEmulator
from triform.robots.ldrobot.models import LD19, LD20, MODELS, STL_19P, LidarModel, get_model
from triform.robots.ldrobot.packets import LARGEST_INTENSITY, PACKET, PacketParser, Packets, encode_packets
from triform.robots.ldrobot.port import LidarError, LidarPort
from triform.robots.ldrobot.turns import TurnAssembler

__all__ = [
    "LARGEST_INTENSITY",
    "LD19",
    "LD20",
    "MODELS",
    "PACKET",
    "STL_19P",
    "LidarEmulator",
    "LidarError",
    "LidarModel",
    "LidarPort",
    "PacketParser",
    "Packets",
    "TurnAssembler",
    "encode_packets",
    "get_model",
]
