"""A robot profile as a TOML file."""

from __future__ import annotations

from dataclasses import asdict, fields
from pathlib import Path

from triform.simulation.profiles import Drive, Footprint, LidarConfig, NoiseBand, Profile
from triform.simulation.tables import TomlTable, quoted
from triform.types import ConfigurationError, ScanConfig

_LIMITS = tuple(each.name for each in fields(Drive))


def read_profile(path: Path) -> Profile:
    """Read a profile; what the file leaves out is that of the ideal profile.

    Raises:
        ConfigurationError: The file cannot be read, or a key or value is not allowed; the sentence names both.
    """
    top = TomlTable.read(path)
    ideal = Profile(path.stem)
    top.known("name", "control_period", "latency", "time_step", "odometry", "footprint", "lidar", "drive")
    footprint, lidar, drive = _footprint(top), _lidar(top.table("lidar")), _drive(top.table("drive"))
    try:
        return Profile(
            top.text("name", ideal.name),
            footprint,
            lidar,
            drive,
            top.number("control_period", ideal.control_period),
            top.number("latency", ideal.latency),
            top.number("time_step", ideal.time_step),
            top.flag("odometry", ideal.odometry),
        )
    except ConfigurationError as error:
        raise (error if str(path) in str(error) else top.refused(error)) from None


def _footprint(top: TomlTable) -> Footprint:
    text = top.text("footprint", "ep")
    try:
        return Footprint.parse(text)
    except ConfigurationError as error:
        raise top.refused(error) from None


def _lidar(table: TomlTable) -> LidarConfig:
    scan, ideal = ScanConfig(), LidarConfig()
    table.known("rays", "angle_min", "range_min", "range_max", "period", "rolling", "dropout", "angle_noise", "noise")
    bands = []
    for band in table.tables("noise", "[{ up_to = inf, absolute = 0.01 }]"):
        band.known("up_to", "absolute", "relative")
        values = band.number("up_to", float("inf")), band.number("absolute", 0.0), band.number("relative", 0.0)
        try:
            bands.append(NoiseBand(*values))
        except ConfigurationError as error:
            raise band.refused(error) from None
    shape = (
        table.whole("rays", scan.rays),
        table.number("angle_min", scan.angle_min),
        table.number("range_min", scan.range_min),
        table.number("range_max", scan.range_max),
    )
    rest = (
        table.number("angle_noise", ideal.angle_noise),
        table.number("dropout", ideal.dropout),
        table.flag("rolling", ideal.rolling),
        table.number("period", ideal.period),
    )
    try:
        return LidarConfig(ScanConfig(*shape), tuple(bands), *rest)
    except ConfigurationError as error:
        raise table.refused(error) from None


def _drive(table: TomlTable) -> Drive:
    ideal = Drive()
    table.known(*_LIMITS)
    values = {name: table.number(name, getattr(ideal, name)) for name in _LIMITS}
    try:
        return Drive(**values)
    except ConfigurationError as error:
        raise table.refused(error) from None


def profile_toml(profile: Profile) -> str:
    """Return a profile as the text of a TOML file, with units, to start from."""
    lidar, scan, drive = profile.lidar, profile.lidar.scan, profile.drive
    bands = ",\n".join(
        "    { " + ", ".join(f"{name} = {float(value)!r}" for name, value in asdict(band).items()) + " }"
        for band in lidar.noise
    )
    noise = f"[\n{bands},\n]" if bands else "[]"
    lines = [
        f"name = {quoted(profile.name)}",
        f'footprint = "{profile.footprint.label}"  # circle:DIAMETER or box:LENGTHxWIDTH [m], centred on the LiDAR',
        f"control_period = {float(profile.control_period)!r}  # time between two commands [s]",
        f"latency = {float(profile.latency)!r}  # from a finished scan until a command can use it [s]",
        f"time_step = {float(profile.time_step)!r}  # longest integration step of the simulation [s]",
        f"odometry = {str(profile.odometry).lower()}  # whether wheels tell how far the robot has come",
        "",
        "[lidar]",
        f"rays = {scan.rays}  # of a full turn",
        f"angle_min = {float(scan.angle_min)!r}  # angle of the first ray, counter-clockwise from the front [rad]",
        f"range_min = {float(scan.range_min)!r}  # [m]",
        f"range_max = {float(scan.range_max)!r}  # [m]; a robot uses 2 d* of what its LiDAR reaches",
        f"period = {float(lidar.period)!r}  # of one turn [s]",
        f"rolling = {str(lidar.rolling).lower()}  # whether each ray is measured at its own moment of the turn",
        f"dropout = {float(lidar.dropout)!r}  # share of rays that return nothing valid",
        f"angle_noise = {float(lidar.angle_noise)!r}  # standard deviation of a ray's direction [rad]",
        "# Standard deviation of ranges up to a distance [m]: absolute [m] + relative x range; the last up to inf.",
        f"noise = {noise}",
        "",
        "[drive]  # holonomic base; inf is no limit",
        f"max_speed = {float(drive.max_speed)!r}  # [m/s]",
        f"max_axis_speed = {float(drive.max_axis_speed)!r}  # along x and along y [m/s]",
        f"max_turn_rate = {float(drive.max_turn_rate)!r}  # [rad/s]",
        f"max_acceleration = {float(drive.max_acceleration)!r}  # [m/s^2]",
        f"max_turn_acceleration = {float(drive.max_turn_acceleration)!r}  # [rad/s^2]",
        f"lag = {float(drive.lag)!r}  # time constant of the base [s]",
    ]
    return "\n".join(lines) + "\n"
