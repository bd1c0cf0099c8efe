"""Disturbances of one environment: pushes, sensor noise, delayed observations and actions, lost samples.

Single, vector and batch environments use one instance per environment, so the same declaration and seed give the same
numbers in all of them.
"""

from __future__ import annotations

import fnmatch
import itertools
from collections import deque
from collections.abc import Iterator
from typing import Any, Final, cast

import numpy as np

from urlab_client.integrations.gym.spaces import Observation, SpaceMapping, mapped
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
        self.seed: int = -1
        self.late_steps: int = 0
        self._n_substeps = n_substeps
        self._declaration = declaration
        self._mapping = mapping
        self._n_task = n_task
        self._targets = [self._noisy(noise) for noise in declaration.noise]
        self._pushes: list[tuple[str, Iterator[Floats | None]]] = []
        self._noises: list[tuple[np.random.Generator, list[Floats]]] = []
        self._drops = stream(0, DROP_STREAM)
        self._samples: deque[Observation] = deque(maxlen=1)
        self._shown: Observation = None
        self._chosen: deque[Floats] = deque()

    def begin(self, rng: np.random.Generator, keyframe: str | None) -> None:
        """Draw the disturbances of an episode, and first its seed, by the environment's generator.

        The set-points of the keyframe are in force until the first delayed action is.
        """
        seed = self.seed = int(rng.integers(_SEED_END))
        declared, delay = self._declaration, self._declaration.delay
        self._pushes = [
            (push.body, _forces(push, stream(seed, PUSH_STREAM, i))) for i, push in enumerate(declared.push)
        ]
        self._noises = []
        for i, (noise, targets) in enumerate(zip(declared.noise, self._targets, strict=True)):
            generator = stream(seed, NOISE_STREAM, i)
            self._noises.append((generator, [generator.uniform(-noise.bias, noise.bias, n) for *_, n in targets]))
        late = stream(seed, DELAY_STREAM)
        observation, action, substeps = (
            int(late.integers(low, high, endpoint=True))
            for low, high in map(steps_range, (delay.observation, delay.action, delay.action_substeps))
        )
        self._samples = deque(maxlen=observation + 1)
        self._shown = None
        if declared.delays_actions:
            more, self.late_steps = divmod(substeps, self._n_substeps)
            length = action + more + 2
            held = np.concatenate([np.zeros(0), *self._mapping.held(keyframe).values()])
            self._chosen = deque([held] * length, maxlen=length)
        self._drops = stream(seed, DROP_STREAM)

    def delayed(self, set_points: Floats) -> tuple[Floats, Floats]:
        """Return the set-points in force during the first `late_steps` physics steps, and those after them."""
        self._chosen.append(set_points.copy())
        return self._chosen[0], self._chosen[1]

    def forces(self) -> dict[str, Floats]:
        """Return the forces on bodies during the next action, N, world frame, shape (3,), and advance the schedules."""
        found: dict[str, Floats] = {}
        for body, schedule in self._pushes:
            force = next(schedule)
            if force is not None:
                found[body] = found.get(body, 0.0) + force
        return found

    def seen(self, truth: Observation) -> Observation:
        """Return an observation with noise, delay and lost samples. Pictures have their own latency and are unchanged.

        `truth`, the next observation of the episode, is not modified.
        """
        sample = _without_pictures(truth)
        for noise, targets, (generator, biases) in zip(
            self._declaration.noise, self._targets, self._noises, strict=True
        ):
            for (key, field, _), bias in zip(targets, biases, strict=True):
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
        if isinstance(truth, dict) and "cameras" in truth:
            pictures = {"cameras": cast("dict[str, Any]", truth)["cameras"]}
            return {**cast("dict[str, Any]", self._shown), **pictures}
        return self._shown

    def _noisy(self, noise: Noise) -> list[tuple[str, Field, int]]:
        """Return the articulations, fields and their lengths to which noise is added."""
        mapping = self._mapping
        if noise.field == "task":
            if not self._n_task:
                raise ValueError("noise on task: the environment's task adds nothing to the observation")
            return [("", "task", self._n_task)]
        fields = mapping.fields if mapping.observed else ()
        if noise.field not in fields:
            seen = [*fields, *(["task"] if self._n_task else [])]
            raise ValueError(
                f"noise on {noise.field}, which is not observed; the observed fields are {', '.join(seen)}"
            )
        meant = fnmatch.filter(mapping.prefixes.with_aliases(), noise.articulation)
        keys = [key for key in mapping.observed if key in map(mapping.prefixes.key, meant)]
        if not keys:
            raise ValueError(f"noise on {noise.field}: no observed articulation is called {noise.articulation!r}")
        return [(key, noise.field, mapping.width(key, noise.field)) for key in keys]

    def _values(self, sample: Observation, key: str, field: Field) -> Floats:
        """Return the view of a target in a sample."""
        if field != "task":
            return self._mapping.field(sample, key, field)
        return sample["task"] if self._mapping.mode == "dict" else sample[-self._n_task :]


def _forces(push: Push, rng: np.random.Generator) -> Iterator[Floats | None]:
    """Yield the force of one kind of push during each action; None without a push."""
    while True:
        low, high = push.every
        yield from itertools.repeat(None, int(rng.integers(low, high, endpoint=True)))
        yield from itertools.repeat(draw_range(rng, push.force, (3,)), push.lasts)


def _without_pictures(observation: Observation) -> Observation:
    """Copy an observation except for pictures, which are never modified."""
    if isinstance(observation, dict):
        entries = cast("dict[str, Any]", observation)
        observation = {key: entry for key, entry in entries.items() if key != "cameras"}
    return mapped(np.array, observation)
