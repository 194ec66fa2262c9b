"""Build of the ROS 2 package, for colcon and for pip."""

from pathlib import Path

from setuptools import setup

NAME = "triform_ros"


def _files(folder: str) -> tuple[str, list[str]]:
    """Files of a folder, and where they are installed."""
    return f"share/{NAME}/{folder}", sorted(str(path) for path in Path(folder).iterdir() if path.is_file())


setup(
    name=NAME,
    version="0.1.0",
    description="The controllers of triform on ROS 2",
    license="Apache-2.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        _files("launch"),
        _files("config"),
    ],
    install_requires=["triform"],
    entry_points={
        "console_scripts": [
            f"controller = {NAME}.controller:main",
            f"gazebo_bridge = {NAME}.gazebo_bridge:main",
        ]
    },
)
