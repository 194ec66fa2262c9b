"""Who stands where and what the teacher commands there: the poses and commands of a run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from triform.control import Teacher
from triform.dataset.configuration import CollectionConfig
from triform.simulation import Drive, sample_starts
from triform.simulation.kinematics import integrate, limit_twists
from triform.types import FloatArray


def demonstrate(config: CollectionConfig, runs: Sequence[int]) -> list[tuple[FloatArray, FloatArray]]:
    """Poses (T, N, 3) and the teacher's body twists (T, N, 3) of the records of every run.

    What a run holds depends on the configuration and the run alone, not on the runs computed with it.
    """
    teacher = Teacher(config.teacher, config.distance, config.gain, config.max_speed)
    roll_outs = [run for run in runs if config.is_roll_out(run)]
    blocks = [run for run in runs if not config.is_roll_out(run)]
    return [*_roll_outs(config, teacher, roll_outs), *(_block(config, teacher, run) for run in blocks)]


def _roll_outs(config: CollectionConfig, teacher: Teacher, runs: Sequence[int]) -> list[tuple[FloatArray, FloatArray]]:
    """Let the teacher drive every run from its start, all of them in lock-step.

    The speed limit acts on the motion and not on the label. Between two records a command is held, and the pose
    follows it exactly, so a step of 0.1 s equals ten of 0.01 s.
    """
    if not runs:
        return []
    seed = config.start_seed(placements=False)
    poses = np.concatenate([sample_starts(config.robots, 1, seed, first=run) for run in runs])
    drive = Drive(max_speed=config.speed_limit)
    driven = np.empty((len(runs), config.steps, config.robots, 3))
    commands = np.empty_like(driven)
    for step in range(config.steps):
        driven[:, step] = poses
        commands[:, step] = twists = teacher.label(poses)
        poses = integrate(poses, limit_twists(twists, drive), config.step_period)
    if not any(config.jitter):
        return list(zip(driven, commands, strict=True))
    jittered = [_jitter(config, run, each) for run, each in zip(runs, driven, strict=True)]
    return [(each, teacher.label(each)) for each in jittered]


def _jitter(config: CollectionConfig, run: int, poses: FloatArray) -> FloatArray:
    deviations = np.resize(config.jitter, len(poses))
    offsets = config.jitter_generator(run).standard_normal((*poses.shape[:2], 2))
    return np.concatenate([poses[..., :2] + deviations[:, None, None] * offsets, poses[..., 2:]], axis=-1)


def _block(config: CollectionConfig, teacher: Teacher, run: int) -> tuple[FloatArray, FloatArray]:
    first = (run - config.runs) * config.block_placements
    seed = config.start_seed(placements=True)
    poses = sample_starts(config.robots, config.run_records(run), seed, first=first)
    return poses, teacher.label(poses)
