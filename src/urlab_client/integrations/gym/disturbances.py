"""Disturbances of one environment: pushes, sensor noise, delayed observations and actions, lost samples.

Single, vector and batch environments use one instance per environment, so the same declaration and seed give the same
numbers in all of them.
"""

from __future__ import annotations

import fnmatch
from collections import deque
from collections.abc import Mapping
from typing import Any, Final, cast

import numpy as np

from urlab_client.integrations.gym.spaces import Observation, SpaceMapping
from urlab_client.protocol.base import Floats
from urlab_client.randomise.declaration import Field, Noise, Push, Randomisation, steps_range
from urlab_client.randomise.variation import (
    DELAY_STREAM,
    DROP_STREAM,
    NOISE_STREAM,
    PUSH_STREAM,
    draw_range,
    stream,
)

_SEED_END: Final = 2**31
"""Exclusive upper bound of episode seeds: servers may store them in 32 bits."""


class Disturbances:
    """Disturbances of one environment, drawn anew for each episode.

    Args:
        declaration: The declaration.
        mapping: The articulations as spaces.
        n_task: Length of what a task adds to an observation.
        n_substeps: Physics steps per action.

    Attributes:
        seed: Seed of the episode.
        late_steps: Physics steps of each action during which the set-points before it are still in force.
    """

    def __init__(self, declaration: Randomisation, mapping: SpaceMapping, n_task: int, n_substeps: int) -> None:
        self.seed = -1
        self.late_steps: int = 0
        self._n_substeps = n_substeps
        self._declaration = declaration
        self._mapping = mapping
        self._n_task = n_task
        self._targets = [self._noisy(noise) for noise in declaration.noise]
        self._pushes: list[_PushSchedule] = []
        self._noises: list[tuple[np.random.Generator, list[Floats]]] = []
        self._drops = stream(0, DROP_STREAM)
        self._samples: deque[Observation] = deque(maxlen=1)
        self._shown: Observation = None
        self._chosen: deque[Mapping[str, Floats]] = deque()

    def begin(self, rng: np.random.Generator, keyframe: str | None) -> int:
        """Draw the disturbances of an episode and return its seed, which the environment's generator draws.

        The set-points of the keyframe are in force until the first delayed action is.
        """
        self.seed: int = int(rng.integers(_SEED_END))
        seed = self.seed
        declared = self._declaration
        self._pushes = [_PushSchedule(push, stream(seed, PUSH_STREAM, i)) for i, push in enumerate(declared.push)]
        self._noises = []
        for i, (noise, widths) in enumerate(zip(declared.noise, self._widths, strict=True)):
            generator = stream(seed, NOISE_STREAM, i)
            self._noises.append((generator, [generator.uniform(-noise.bias, noise.bias, n) for n in widths]))
        late = stream(seed, DELAY_STREAM)
        delay = declared.delay
        observation, action, substeps = (
            int(late.integers(low, high, endpoint=True))
            for low, high in map(steps_range, (delay.observation, delay.action, delay.action_substeps))
        )
        self._samples = deque(maxlen=observation + 1)
        self._shown = None
        if declared.delays_actions:
            more, self.late_steps = divmod(substeps, self._n_substeps)
            length = action + more + 2
            self._chosen = deque([self._mapping.held(keyframe)] * length, maxlen=length)
        self._drops = stream(seed, DROP_STREAM)
        return seed

    def delayed(self, set_points: Mapping[str, Floats]) -> tuple[Mapping[str, Floats], Mapping[str, Floats]]:
        """Return the set-points in force during the first `late_steps` physics steps, and those after them."""
        self._chosen.append({key: values.copy() for key, values in set_points.items()})
        return self._chosen[0], self._chosen[1]

    def forces(self) -> dict[str, Floats]:
        """Return the forces on bodies during the next action, N, world frame, shape (3,), and advance the schedules."""
        found: dict[str, Floats] = {}
        for schedule in self._pushes:
            force = schedule.advance()
            if force is not None:
                found[schedule.push.body] = found.get(schedule.push.body, 0.0) + force
        return found

    def seen(self, truth: Observation) -> Observation:
        """Return an observation with noise, delay and lost samples. Pictures have their own latency and are unchanged.

        `truth`, the next observation of the episode, is not modified.
        """
        sample = _copied(truth)
        for noise, targets, (generator, biases) in zip(
            self._declaration.noise, self._targets, self._noises, strict=True
        ):
            for (key, field), bias in zip(targets, biases, strict=True):
                values = self._values(sample, key, field)
                values += bias
                if noise.std:
                    values += generator.normal(0.0, noise.std, values.shape)
                if noise.uniform:
                    values += generator.uniform(-noise.uniform, noise.uniform, values.shape)
        self._samples.append(sample)
        lost = self._declaration.delay.drop and self._drops.random() < self._declaration.delay.drop
        if self._shown is None or not lost:
            self._shown = self._samples[0]
        shown = _copied(self._shown)
        if isinstance(truth, dict) and "cameras" in truth:
            shown["cameras"] = truth["cameras"]
        return shown

    def _noisy(self, noise: Noise) -> list[tuple[str, Field]]:
        """Return the articulations and fields to which noise is added."""
        mapping = self._mapping
        if noise.field == "task":
            if not self._n_task:
                raise ValueError("noise on task: the environment's task adds nothing to the observation")
            return [("", "task")]
        if noise.field not in mapping.fields:
            raise ValueError(
                f"noise on {noise.field}, which is not observed; the observed fields are {', '.join(mapping.fields)}"
            )
        keys = [key for key in mapping.observed if fnmatch.fnmatchcase(key, noise.articulation)]
        if not keys:
            raise ValueError(f"noise on {noise.field}: no observed articulation is called {noise.articulation!r}")
        return [(key, noise.field) for key in keys]

    @property
    def _widths(self) -> list[list[int]]:
        return [
            [self._n_task if field == "task" else self._mapping.width(key, field) for key, field in targets]
            for targets in self._targets
        ]

    def _values(self, sample: Observation, key: str, field: Field) -> Floats:
        """Return the view of a target in a sample."""
        if field != "task":
            return self._mapping.field(sample, key, field)
        return sample["task"] if self._mapping.mode == "dict" else sample[-self._n_task :]


class _PushSchedule:
    """Times and forces of one kind of push."""

    def __init__(self, push: Push, rng: np.random.Generator) -> None:
        self.push = push
        self._rng = rng
        self._wait = self._drawn_wait()
        self._left = 0
        self._force: Floats = np.zeros(3)

    def advance(self) -> Floats | None:
        """Return the force during the next action, or None without a push."""
        if self._left == 0:
            if self._wait > 0:
                self._wait -= 1
                return None
            self._force = draw_range(self._rng, self.push.force, (3,))
            self._left = self.push.lasts
        self._left -= 1
        if self._left == 0:
            self._wait = self._drawn_wait()
        return self._force

    def _drawn_wait(self) -> int:
        low, high = self.push.every
        return int(self._rng.integers(low, high, endpoint=True))


def _copied(tree: Any) -> Any:
    """Copy arrays in dictionaries, without pictures, which are never modified."""
    if isinstance(tree, Mapping):
        entries = cast("Mapping[str, Any]", tree)
        return {key: _copied(entry) for key, entry in entries.items() if key != "cameras"}
    return np.array(tree)
