"""The robots of a team: all of one profile, or a number of each of several."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction

from triform.geometry.footprint import Footprint
from triform.simulation.profiles import Profile
from triform.simulation.shipped import get_profile
from triform.types import convert_fields, converted, require

#: A profile with its number of robots, and what follows.
_KIND = re.compile(r"(\S.*?):(\d+)(?:\s+|$)")
#: Control periods are read as fractions with at most this denominator.
_DENOMINATOR = 1000
#: Robots of several profiles are not commanded in steps shorter than this [s].
_SHORTEST_STEP = 1e-3


@dataclass(frozen=True)
class Composition:
    """A team's composition. Robots of one kind follow each other, in the order of the kinds.

    Attributes:
        profiles: Profile of each kind.
        counts: Robots of each kind; ``None`` for one kind and any number of robots.
    """

    profiles: tuple[Profile, ...]
    counts: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        convert_fields(self)
        require(len(self.profiles) > 0, "a team has no profile; at least one is needed")
        require(
            (self.counts is None and len(self.profiles) == 1)
            or (self.counts is not None and len(self.counts) == len(self.profiles)),
            f"a team has {len(self.profiles)} profiles and robots {self.counts}; a number for each profile is needed",
        )
        for count in self.counts or ():
            require(count >= 1, f"a profile has {count} robots; each has at least 1")
        _ = self.control_period

    @classmethod
    def parse(cls, text: str) -> Composition:
        """Read a profile (a name or a TOML file), or several as ``PROFILE:ROBOTS`` with spaces between.

        Raises:
            ConfigurationError: There is no such profile, or it is one of several without a number of robots.
        """
        names, counts = read_kinds(text)
        return cls(tuple(map(get_profile, names)), counts)

    @classmethod
    def of(cls, profile: Profile | Composition) -> Composition:
        """Return a composition as it is, and that of a team of one profile."""
        return profile if isinstance(profile, Composition) else cls((converted("profile", profile, Profile),))

    @property
    def is_mixed(self) -> bool:
        """Whether there are several kinds."""
        return len(self.profiles) > 1

    @property
    def profile(self) -> Profile:
        """Profile of all robots.

        Raises:
            ConfigurationError: There are several.
        """
        require(
            not self.is_mixed,
            f"a team has robots of {len(self.profiles)} profiles, {', '.join(each.name for each in self.profiles)}; "
            "this works with one",
        )
        return self.profiles[0]

    @property
    def robots(self) -> int | None:
        """Number of robots; ``None`` for any."""
        return None if self.counts is None else sum(self.counts)

    @property
    def control_period(self) -> float:
        """Longest time of which every control period is a multiple [s].

        Raises:
            ConfigurationError: There is none of a millisecond or more.
        """
        periods = [profile.control_period for profile in self.profiles]
        if len(set(periods)) == 1:
            return periods[0]
        fractions = [Fraction(period).limit_denominator(_DENOMINATOR) for period in periods]
        denominator = math.lcm(*(each.denominator for each in fractions))
        step = math.gcd(*(int(each * denominator) for each in fractions)) / denominator
        exact = all(abs(float(each) - period) < 1e-9 for each, period in zip(fractions, periods, strict=True))
        require(
            exact and step >= _SHORTEST_STEP,
            f"control periods of {', '.join(f'{period:g} s' for period in periods)} have no common step of "
            f"{_SHORTEST_STEP:g} s or more; robots of one team need one",
        )
        return step

    def team_size(self, robots: int | None, default: int) -> int:
        """Return the number of robots of a team: what is asked for or the default, unless the profiles say it.

        Raises:
            ConfigurationError: Another number is asked for than the profiles say.
        """
        if self.robots is None:
            return default if robots is None else robots
        require(
            robots in (None, self.robots),
            f"robots is {robots}, and the profiles have {self.robots} robots; omit it or make them equal",
        )
        return self.robots

    def slices(self, robots: int) -> list[slice]:
        """Return which robots of a team each kind has; the last kind has those that joined.

        Raises:
            ConfigurationError: The composition has more robots.
        """
        counts = self.counts or (robots,)
        require(
            robots >= sum(counts),
            f"a team has {robots} robots, and its profiles {' + '.join(map(str, counts))} of them",
        )
        ends = [sum(counts[: kind + 1]) for kind in range(len(counts) - 1)] + [robots]
        return [slice(first, last) for first, last in zip([0, *ends], ends, strict=False)]

    def outlines(self, robots: int) -> Footprint | tuple[Footprint, ...]:
        """Return the outline of all robots, or in a team of several kinds that of each robot."""
        if not self.is_mixed:
            return self.profiles[0].footprint
        slices = self.slices(robots)
        return tuple(
            profile.footprint
            for profile, own in zip(self.profiles, slices, strict=True)
            for _ in range(own.start, own.stop)
        )

    def changed(self, change: Callable[[Profile], Profile]) -> Composition:
        """Return the composition with every profile changed in the same way."""
        return replace(self, profiles=tuple(map(change, self.profiles)))


def read_kinds(text: str) -> tuple[tuple[str, ...], tuple[int, ...] | None]:
    """Read names of profiles and how many robots each has; ``None`` for one profile and any number.

    Raises:
        ConfigurationError: One of several profiles has no number.
    """
    text = converted("profile", text, str).strip()
    kinds = _KIND.findall(text)
    # The path of a file may hold spaces.
    names = [name for name, _ in kinds] or [text]
    unnumbered = any(len(name.split()) > 1 and not name.endswith(".toml") for name in names)
    require(
        not unnumbered and not (kinds and _KIND.sub("", text)),
        f"profile is {text!r}; of several profiles each names its number of robots, as in turtlebot4:3 hardware:2",
    )
    return tuple(names), tuple(int(count) for _, count in kinds) or None
