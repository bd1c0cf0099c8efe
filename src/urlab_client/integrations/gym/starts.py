"""Noise on joint positions at the start of episodes, within joint ranges and in joint units."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from urlab_client.aio.arguments import require
from urlab_client.protocol.base import Floats

if TYPE_CHECKING:
    import mujoco

_SLIDE: Final = 2
"""`mjJNT_SLIDE`."""


@dataclass(frozen=True, slots=True)
class ResetNoise:
    """Largest deviation of joints at a reset. A joint with a range stays within it.

    Attributes:
        hinge: Largest deviation of hinge joints, radians.
        slide: Largest deviation of slide joints, metres.
    """

    hinge: float = 0.0
    slide: float = 0.0

    def __post_init__(self) -> None:
        for name, value in (("hinge", self.hinge), ("slide", self.slide)):
            require("reset_noise", value, Real, "a ResetNoise or a number")
            if not 0 <= value < np.inf:
                raise ValueError(f"reset_noise must be 0 or more, not {value} for {name} joints")

    def __bool__(self) -> bool:
        return self.hinge > 0 or self.slide > 0

    def drawn(
        self, rng: np.random.Generator, model: mujoco.MjModel, joints: NDArray[np.intp], positions: Floats
    ) -> Floats:
        """Return positions with noise.

        Args:
            rng: Generator.
            model: The compiled scene.
            joints: Ids of hinge and slide joints.
            positions: Their positions, radians or metres, shape (n,).
        """
        scale = np.where(model.jnt_type[joints] == _SLIDE, self.slide, self.hinge)
        limited = model.jnt_limited[joints].astype(bool)
        lower, upper = model.jnt_range[joints].T
        # A joint that is already outside its range, for example after a keyframe, must not move further out.
        low = np.where(limited, np.clip(positions - scale, np.minimum(lower, positions), None), positions - scale)
        high = np.where(limited, np.clip(positions + scale, None, np.maximum(upper, positions)), positions + scale)
        return rng.uniform(low, high)


def noise_of(reset_noise: float | ResetNoise) -> ResetNoise:
    """Return a `ResetNoise` as given, or one made from a number, which applies to hinge joints only (radians).

    Raises:
        ValueError: The noise is negative or not finite.
    """
    return reset_noise if isinstance(reset_noise, ResetNoise) else ResetNoise(hinge=reset_noise)
