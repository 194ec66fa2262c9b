"""RoboMaster EP: a driver for its wheels and odometry, and an emulator of its plaintext SDK."""

from triform.robots.robomaster.driver import USB_ADDRESS, WIFI_ADDRESS, RoboMaster
from triform.robots.robomaster.emulator import RoboMasterEmulator
from triform.robots.robomaster.protocol import RoboMasterError

__all__ = ["USB_ADDRESS", "WIFI_ADDRESS", "RoboMaster", "RoboMasterEmulator", "RoboMasterError"]
