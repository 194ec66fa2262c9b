"""Which states a training draws from: those that the teacher visits, and in rounds those that the learner visits.

A learner that only sees its teacher's states does not learn to come back from its own mistakes (DAgger). So at some
moments of a training the policy of that moment drives teams itself; where they went joins the states, and the teacher
labels them.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from triform.control import GnnController, LearnedPolicy, Triangulating, TriangulatingLaw
from triform.dataset import StateBuffer, fresh_inputs, joined
from triform.evaluation.rollout import rollout
from triform.policy import GnnConfig, GnnRuntime, PolicyRuntime, PolicySpec
from triform.policy.export import export_policy
from triform.policy.network import PolicyNetwork
from triform.policy.weights import save_policy
from triform.simulation import World, get_profile, sample_starts
from triform.training.precision import matrix_products
from triform.training.presets import TrainConfig
from triform.training.processes import Processes
from triform.types import SENSING_RANGE, Controller, FloatArray, PrivilegedView

#: Time between two recorded states [s].
_PERIOD = 0.5
#: Everything happens in the first seconds of a run [s]; of what comes later a share is kept.
_BUSY = 15.0
_KEPT_LATER = 0.35
#: First words of the seeds of independent random streams.
_STARTS, _WORLDS, _DISTURBANCE, _CHOICE = range(4)


@dataclass(frozen=True)
class Rollouts:
    """Some runs of one team size.

    Attributes:
        robots: Team size.
        runs: How many.
        duration: Length of each [s].
        profile: Name of the robot profile.
    """

    robots: int
    runs: int
    duration: float
    profile: str = "ideal"


#: Where the teacher goes. It sees the others displaced at random, by as much as ``_DISTURBANCES`` in turn [d*].
TEACHER_ROLLOUTS = tuple(
    Rollouts(*each)
    for each in (
        (2, 10, 10), (3, 30, 15), (4, 60, 20), (5, 100, 25), (6, 100, 30), (7, 150, 40), (8, 150, 40), (9, 200, 40),
        (10, 150, 40), (11, 150, 40), (13, 150, 40), (16, 60, 50), (20, 50, 60), (25, 40, 90), (35, 16, 120),
        (50, 10, 120), (100, 4, 150),
    )
)  # fmt: skip
_DISTURBANCES = (0.0, 0.02, 0.05)
#: Where the learner goes in each of its rounds.
LEARNER_ROLLOUTS = (
    *(Rollouts(robots, 20, 40, "hardware") for robots in (4, 7, 9)),
    *(Rollouts(robots, 20, 40, "turtlebot4") for robots in (5, 9, 13)),
    *(Rollouts(robots, 15, 50, "turtlebot3-burger") for robots in (6, 10)),
    *(
        Rollouts(*each)
        for each in (
            (3, 20, 15), (5, 60, 20), (7, 60, 25), (9, 70, 25), (11, 60, 25), (13, 60, 25), (25, 12, 60), (50, 4, 90),
        )
    ),
)  # fmt: skip


class _Disturbed:
    """A controller that is shown poses with random displacements."""

    privileged = True

    def __init__(self, controller: Controller[PrivilegedView], deviation: float, rng: np.random.Generator) -> None:
        self._controller, self._deviation, self._rng = controller, deviation, rng

    @property
    def description(self) -> dict[str, Any]:
        return self._controller.description

    def command(self, view: PrivilegedView) -> FloatArray:
        offsets = self._deviation * self._rng.standard_normal((*view.active.shape, 2))
        poses = np.concatenate([view.poses[..., :2] + offsets, view.poses[..., 2:]], axis=-1)
        return self._controller.command(replace(view, poses=poses))


def teacher_states(law: TriangulatingLaw, seed: int, rollouts: Sequence[Rollouts] = TEACHER_ROLLOUTS) -> StateBuffer:
    """States that teams driven by the law visit; a function of the arguments alone."""
    parts = []
    for each in rollouts:
        for number, deviation in enumerate(_DISTURBANCES):
            share = replace(each, runs=len(range(number, each.runs, len(_DISTURBANCES))))
            rng = np.random.default_rng([seed, _DISTURBANCE, each.robots, number])
            if share.runs > 0:
                parts.append(_driven(_Disturbed(Triangulating(law=law), deviation, rng), share, (seed, number)))
    return joined(parts)


def learner_states(
    policy: PolicyNetwork,
    spec: PolicySpec,
    seed: int,
    number: int,
    rollouts: Sequence[Rollouts] = LEARNER_ROLLOUTS,
) -> StateBuffer:
    """States that teams driven by the policy visit in its round ``number``, counted from 1."""
    with tempfile.TemporaryDirectory(prefix="triform-learner-") as folder:
        save_policy(Path(folder), policy, spec)
        rng = np.random.default_rng(seed)
        # Robots compute in float32, whatever the training rounds.
        with matrix_products("float32"):
            export_policy(Path(folder), fresh_inputs(rng, 64, spec))
        controller: Controller[PrivilegedView]
        if isinstance(spec.network, GnnConfig):
            controller = GnnController(GnnRuntime(Path(folder)))
        else:
            controller = LearnedPolicy(PolicyRuntime(Path(folder)))
        stream = (seed, len(_DISTURBANCES) + number)
        return joined([_driven(controller, each, stream, spec.scan.range_max) for each in rollouts])


def collect_states(
    out: Path, config: TrainConfig, policy: PolicyNetwork, number: int, processes: Processes
) -> StateBuffer:
    """All states to draw from in round ``number`` of a training, where round 0 has the teacher's alone.

    Every round's own states are kept in ``out``, so that a training that is resumed has the same ones. The first
    process makes them.

    Args:
        out: Folder of the training.
        config: What is trained.
        policy: The learner at the beginning of the round.
        number: Which round.
        processes: The processes that train together.
    """
    files = [out / f"visited-{each}.npz" for each in range(number + 1)]
    # Rounds of no steps have not been here for theirs.
    missing = [each for each in range(number + 1) if not files[each].exists()] if processes.first else []
    for each in missing:
        if each == 0:
            states = teacher_states(config.law, config.seed)
        else:
            states = learner_states(policy, config.spec(), config.seed, each)
        states.save(files[each])
    processes.wait()
    return joined([StateBuffer.load(file) for file in files])


def _driven(
    controller: Controller[PrivilegedView],
    rollouts: Rollouts,
    stream: tuple[int, int],
    reach: float = SENSING_RANGE,
) -> StateBuffer:
    """States of the runs of one rollouts, whose robots have LiDARs that reach so far [m]."""
    profile = get_profile(rollouts.profile).seeing(reach)
    seed = int(np.random.SeedSequence([*stream, _STARTS]).generate_state(1, np.uint64)[0])
    seeds = np.random.SeedSequence([*stream, _WORLDS, rollouts.robots]).spawn(rollouts.runs)
    world = World(sample_starts(rollouts.robots, rollouts.runs, seed), profile, seeds=seeds)
    trajectory = rollout(world, controller, rollouts.duration)
    every = round(_PERIOD / profile.control_period)
    positions, time = trajectory.positions[:, ::every], trajectory.time[::every]
    rng = np.random.default_rng([*stream, _CHOICE, rollouts.robots])
    kept = rng.random(positions.shape[:2]) < np.where(time < _BUSY, 1.0, _KEPT_LATER)
    return StateBuffer.of_teams(positions[kept])
