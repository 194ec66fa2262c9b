"""A robot profile as a TOML file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from triform.geometry.footprint import Footprint
from triform.simulation.intensity import Brightness
from triform.simulation.mounting import Mounting
from triform.simulation.profiles import Drive, LidarConfig, NoiseBand, Profile
from triform.simulation.tables import TomlTable, quoted
from triform.types import ConfigurationError, ScanConfig


def read_profile(path: Path) -> Profile:
    """Read a profile; what the file leaves out is that of the ideal profile.

    Raises:
        ConfigurationError: The file cannot be read, or a key or value is not allowed; the sentence names both.
    """
    top = TomlTable.read(path)
    with _refusing(top):
        values = _values(top, Profile(path.stem), "footprint", "lidar", "drive", "mounting")
        footprint = Footprint.parse(top.text("footprint", "ep"))
        return Profile(
            footprint=footprint,
            lidar=_lidar(top.table("lidar")),
            drive=_drive(top.table("drive")),
            mounting=_mounting(top.table("mounting")),
            **values,
        )


def _lidar(table: TomlTable) -> LidarConfig:
    lidar, scan = LidarConfig(), ScanConfig()
    bands = []
    for band in table.tables("noise", "[{ up_to = inf, absolute = 0.01 }]"):
        with _refusing(band):
            bands.append(NoiseBand(**_values(band, NoiseBand(float("inf")))))
    brightness = table.table("brightness")
    with _refusing(brightness):
        levels = Brightness(**_values(brightness, Brightness()))
    others = "noise", "brightness", "min_intensity"
    shape = _values(table, scan, *others, *_simple(lidar))
    threshold = table.number("min_intensity", 0.0) if "min_intensity" in table.values else None
    with _refusing(table):
        return replace(
            lidar,
            scan=ScanConfig(**shape),
            noise=tuple(bands),
            brightness=levels,
            min_intensity=threshold,
            **_values(table, lidar, *others, *shape),
        )


def _drive(table: TomlTable) -> Drive:
    with _refusing(table):
        return Drive(**_values(table, Drive()))


def _mounting(table: TomlTable) -> Mounting:
    values = _values(table, Mounting(), "blind_sectors")
    sectors = table.rows("blind_sectors", 2, "from, to [deg]")
    with _refusing(table):
        return Mounting(**values, blind_sectors=tuple((begin, end) for begin, end in sectors))


def _simple(ideal: Any) -> dict[str, bool | float | str]:
    """Return the fields of a configuration that are no tables, with their values."""
    return {name: value for name, value in vars(ideal).items() if isinstance(value, bool | int | float | str)}


def _values(table: TomlTable, ideal: Any, *others: str) -> dict[str, Any]:
    """Take the simple fields of a configuration out of a table; those that it leaves out are ``ideal``'s.

    Raises:
        ConfigurationError: A value has another type, or there is a key that is neither a field nor one of ``others``.
    """
    simple = _simple(ideal)
    table.known(*simple, *others)
    take: dict[type, Callable[[str, Any], Any]] = {
        bool: table.flag,
        int: table.whole,
        float: table.number,
        str: table.text,
    }
    return {name: take[type(default)](name, default) for name, default in simple.items()}


@contextmanager
def _refusing(table: TomlTable) -> Iterator[None]:
    """Name file and table in the error of values that do not go together."""
    try:
        yield
    except ConfigurationError as error:
        raise (error if str(table.path) in str(error) else table.refused(error)) from None


def profile_toml(profile: Profile) -> str:
    """Return a profile as the text of a TOML file, with units, to start from."""
    lidar, scan, drive, mounting = profile.lidar, profile.lidar.scan, profile.drive, profile.mounting
    bands = ",\n".join(
        "    { " + ", ".join(f"{name} = {float(value)!r}" for name, value in asdict(band).items()) + " }"
        for band in lidar.noise
    )
    noise = f"[\n{bands},\n]" if bands else "[]"
    bright, threshold = lidar.brightness, lidar.min_intensity
    lines = [
        f"name = {quoted(profile.name)}",
        f'footprint = "{profile.footprint.label}"  # circle:DIAMETER or box:LENGTHxWIDTH [m], around its centre',
        f"control_period = {float(profile.control_period)!r}  # time between two commands [s]",
        f"latency = {float(profile.latency)!r}  # from a finished scan until a command can use it [s]",
        f"time_step = {float(profile.time_step)!r}  # longest integration step of the simulation [s]",
        f"odometry = {str(profile.odometry).lower()}  # whether wheels tell how far the robot has come",
        "",
        "[lidar]",
        f"rays = {scan.rays}  # of a full turn",
        f"angle_min = {float(scan.angle_min)!r}  # angle of the first ray, counter-clockwise from the front [rad]",
        f"range_min = {float(scan.range_min)!r}  # [m]",
        f"range_max = {float(scan.range_max)!r}  # [m]; a team looks as far as its sight, a multiple of d*, instead",
        f"period = {float(lidar.period)!r}  # of one turn [s]",
        f"rolling = {str(lidar.rolling).lower()}  # whether each ray is measured at its own moment of the turn",
        f"dropout = {float(lidar.dropout)!r}  # share of rays that return nothing valid",
        f"angle_noise = {float(lidar.angle_noise)!r}  # standard deviation of a ray's direction [rad]",
        "# Standard deviation of ranges up to a distance [m]: absolute [m] + relative x range; the last up to inf.",
        f"noise = {noise}",
        f"intensities = {str(lidar.intensities).lower()}  # whether it can say how bright its returns are",
        "# Returns that are dimmer, in the LiDAR's own scale, are obstacles; robots then need reflecting tape.",
        "# min_intensity = 230.0" if threshold is None else f"min_intensity = {float(threshold)!r}",
        "",
        "[lidar.brightness]  # how bright a simulated LiDAR sees, in its own scale",
        f"robot = {float(bright.robot)!r}  # with its tape",
        f"obstacle = {float(bright.obstacle)!r}  # of which the arena says nothing else",
        f"falloff = {float(bright.falloff)!r}  # lost per distance [1/m]",
        f"noise = {float(bright.noise)!r}  # standard deviation",
        f"largest = {float(bright.largest)!r}  # end of the scale",
        "",
        "[mounting]  # of the LiDAR on the base",
        f"x = {float(mounting.x)!r}  # forward of the base's centre [m]",
        f"y = {float(mounting.y)!r}  # left of it [m]",
        f"yaw = {float(mounting.yaw)!r}  # direction of the LiDAR's own zero, counter-clockwise from the front [rad]",
        f"upright = {str(mounting.upright).lower()}  # false if it hangs upside down",
        f"blind_sectors = {[[float(each) for each in sector] for sector in mounting.blind_sectors]}"
        "  # where only the robot itself is, [from, to] counter-clockwise from the front [deg]",
        "",
        "[drive]  # inf is no limit",
        f'kind = "{drive.kind}"  # of base: holonomic, or differential: two driven wheels, whose axle is in the middle',
        f"max_speed = {float(drive.max_speed)!r}  # [m/s]",
        f"max_axis_speed = {float(drive.max_axis_speed)!r}  # along x and along y [m/s]",
        f"max_turn_rate = {float(drive.max_turn_rate)!r}  # [rad/s]",
        f"max_acceleration = {float(drive.max_acceleration)!r}  # [m/s^2]",
        f"max_turn_acceleration = {float(drive.max_turn_acceleration)!r}  # [rad/s^2]",
        f"lag = {float(drive.lag)!r}  # time constant of the base [s]",
        f"track = {float(drive.track)!r}  # of a differential base: distance between its wheels [m]",
        f"max_wheel_speed = {float(drive.max_wheel_speed)!r}  # of one of these wheels [m/s]",
        f"reverse = {str(drive.reverse).lower()}  # whether a differential base may drive backwards",
        f"wheel_radius = {float(drive.wheel_radius)!r}  # of these wheels, for simulators that have wheels [m]",
    ]
    return "\n".join(lines) + "\n"
