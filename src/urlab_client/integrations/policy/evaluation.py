"""Evaluation of policies: success rate and return over many seeded episodes, with confidence intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from statistics import NormalDist
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from urlab_client.aio.client import URLabClient
from urlab_client.integrations.policy.policy import Policy
from urlab_client.integrations.policy.runner import run
from urlab_client.protocol.base import Floats
from urlab_client.values.plain import Serializable

if TYPE_CHECKING:
    from urlab_client.integrations.gym import URLabBatchEnv, URLabVectorEnv

RESAMPLES: Final = 10_000
_SEED_BITS: Final = 31  # every server keeps at least this many

OnEpisode = Callable[["Outcome"], None]
"""Callback invoked with the outcome after each episode."""


class Estimate(Serializable, Struct, frozen=True):
    """A number with its confidence interval.

    Attributes:
        value: The estimate.
        low: Lower end of the interval.
        high: Upper end of the interval.
    """

    value: float
    low: float
    high: float


class Outcome(Serializable, Struct, frozen=True, kw_only=True):
    """The result of one episode.

    Attributes:
        seed: Seed of the episode; the same seed repeats it.
        total: Return of the episode: the sum of its rewards.
        actions: Number of actions.
        success: Whether the episode was a success; None if the task defines none.
    """

    seed: int
    total: float
    actions: int
    success: bool | None


class Evaluation(Serializable, Struct, frozen=True, kw_only=True):
    """The result of many episodes.

    Attributes:
        confidence: Coverage of the intervals, 0 to 1.
        success_rate: Proportion of successes, with Wilson's score interval; None if the task defines none.
        mean_return: Mean of the returns, with a percentile bootstrap interval.
        mean_actions: Mean number of actions, with a percentile bootstrap interval.
        outcomes: The episodes.
    """

    confidence: float
    success_rate: Estimate | None
    mean_return: Estimate
    mean_actions: Estimate
    outcomes: list[Outcome]

    @classmethod
    def of(cls, outcomes: Sequence[Outcome], confidence: float) -> Evaluation:
        """Summarise episodes.

        Raises:
            ValueError: There are no episodes, or the confidence is not between 0 and 1.
        """
        if not outcomes:
            raise ValueError("there are no episodes to evaluate")
        if not 0 < confidence < 1:
            raise ValueError(f"confidence must be between 0 and 1, not {confidence}")
        successes = [outcome.success for outcome in outcomes if outcome.success is not None]
        return cls(
            confidence=confidence,
            success_rate=wilson(sum(successes), len(successes), confidence) if successes else None,
            mean_return=bootstrap_mean([outcome.total for outcome in outcomes], confidence),
            mean_actions=bootstrap_mean([float(outcome.actions) for outcome in outcomes], confidence),
            outcomes=list(outcomes),
        )


def wilson(successes: int, n: int, confidence: float = 0.95) -> Estimate:
    """Return a proportion with the score interval of E. B. Wilson (1927).

    The interval keeps its coverage with few episodes and with rates near 0 and 1.

    Args:
        successes: Number of successes.
        n: Number of episodes.
        confidence: Coverage, 0 to 1.
    """
    z = NormalDist().inv_cdf(0.5 + confidence / 2.0)
    share, weight = successes / n, z * z / n
    centre = (share + weight / 2.0) / (1.0 + weight)
    half = z / (1.0 + weight) * math.sqrt(share * (1.0 - share) / n + weight / (4.0 * n))
    return Estimate(share, max(0.0, centre - half), min(1.0, centre + half))


def bootstrap_mean(values: Sequence[float], confidence: float = 0.95) -> Estimate:
    """Return a mean with the percentile interval of B. Efron's bootstrap (1979), of 10,000 seeded resamples.

    Args:
        values: One value per episode.
        confidence: Coverage, 0 to 1.
    """
    given = np.asarray(values, dtype=np.float64)
    rng = np.random.default_rng(0)
    means = np.array([given[rng.integers(len(given), size=len(given))].mean() for _ in range(RESAMPLES)])
    low, high = np.quantile(means, [0.5 - confidence / 2.0, 0.5 + confidence / 2.0])
    return Estimate(float(given.mean()), float(low), float(high))


def episode_seeds(seed: int, episodes: int) -> list[int]:
    """Return the seeds of an evaluation's episodes. A longer evaluation begins with the same seeds.

    Raises:
        ValueError: The number of episodes is below 1, or the seed is negative.
    """
    if episodes < 1 or seed < 0:
        raise ValueError(f"episodes must be at least 1 and the seed at least 0, not {episodes} and {seed}")
    return [int(np.random.SeedSequence([seed, i]).generate_state(1)[0]) % 2**_SEED_BITS for i in range(episodes)]


def evaluate_in(
    env: URLabBatchEnv | URLabVectorEnv,
    network: Callable[[Any], Floats],
    *,
    episodes: int = 100,
    seed: int = 0,
    confidence: float = 0.95,
    on_episode: OnEpisode | None = None,
    history: int = 1,
) -> Evaluation:
    """Evaluate a network that maps observations to actions, in a batch of environments or over servers.

    Each episode has its own seed, so its outcome does not depend on the number of environments.

    Args:
        env: The environments, with `max_episode_steps` and `autoreset_mode=AutoresetMode.DISABLED`.
        network: Function that maps an observation, flat or a dictionary, to an action, shape (n,), which is clipped to
            the bounds of the action space. With dictionaries, it is the action of the only articulation with actuators.
        episodes: Number of episodes.
        seed: Seed of the evaluation.
        confidence: Coverage of the intervals, 0 to 1.
        on_episode: Callback invoked with the outcome after each episode.
        history: Number of observations that the network maps at once, oldest first, if they are flat. In the beginning
            the first one is repeated.

    Raises:
        ValueError: A number is out of range, the network does not fit the spaces, the environments lack
            `max_episode_steps` or the autoreset mode, or dictionary actions have more than one articulation.
        URLabError: A server failed.
    """
    if env.autoreset_mode.name != "DISABLED" or env.max_episode_steps is None:
        raise ValueError("an evaluation needs a batch with autoreset_mode=AutoresetMode.DISABLED and max_episode_steps")
    from urlab_client.integrations.gym.vectorized import of_one

    seeds = episode_seeds(seed, episodes)
    space: Any = env.single_action_space
    driven: str | None = None
    if env.mapping.mode == "dict":
        if len(space) != 1:
            raise ValueError(f"an evaluation controls one articulation, not {len(space)}: {', '.join(space)}")
        ((driven, space),) = space.items()
    found: dict[int, Outcome] = {}
    for first in range(0, episodes, env.num_envs):
        some = seeds[first : first + env.num_envs]
        count = len(some)
        mask = np.arange(env.num_envs) < count
        padded: list[int | None] = [*some, *[None] * (env.num_envs - count)]
        options = {} if first == 0 else {"reset_mask": mask}
        observations, infos = env.reset(seed=padded, options=options)
        _raise_any(infos, mask)
        going, totals, lengths = mask.copy(), np.zeros(env.num_envs), np.zeros(env.num_envs, dtype=np.int64)
        actions = np.zeros((env.num_envs, *space.shape), dtype=space.dtype)
        seen = [observations] * history
        while going.any():
            seen = [*seen[1:], observations]
            latest = joined(seen)
            for i in np.flatnonzero(going):
                actions[i] = _fitting(network(of_one(latest, int(i))), space)
            given = actions if driven is None else {driven: actions}
            observations, rewards, terminated, truncated, infos = env.step(given)
            _raise_any(infos, going)
            totals[going] += rewards[going]
            lengths[going] += 1
            for i in np.flatnonzero(going & (terminated | truncated)):
                success = bool(infos["success"][i]) if "success" in infos else None
                outcome = Outcome(seed=some[i], total=float(totals[i]), actions=int(lengths[i]), success=success)
                found[first + int(i)] = outcome
                if on_episode is not None:
                    on_episode(outcome)
            going &= ~(terminated | truncated)
    return Evaluation.of([found[i] for i in range(episodes)], confidence)


async def evaluate_on(
    client: URLabClient,
    policy: Policy,
    *,
    articulation: str | None = None,
    episodes: int = 100,
    seconds: float = 10.0,
    seed: int = 0,
    confidence: float = 0.95,
    on_episode: OnEpisode | None = None,
) -> Evaluation:
    """Evaluate a policy on its robot. A fall ends an episode; an episode without a fall is a success.

    Args:
        client: A discovered client. Episodes differ if its server varies its scene.
        policy: The policy.
        articulation: Key, actor id or class name of the robot, instead of the declared one.
        episodes: Number of episodes.
        seconds: Duration of an episode, simulated seconds.
        seed: Seed of the evaluation.
        confidence: Coverage of the intervals, 0 to 1.
        on_episode: Callback invoked with the outcome after each episode.

    Raises:
        PolicyMismatch: The policy cannot control this robot in this session.
        URLabError: The server refused a request.
        ValueError: A number is out of range.
    """
    outcomes: list[Outcome] = []
    for each in episode_seeds(seed, episodes):
        result = await run(client, policy, articulation=articulation, seconds=seconds, seed=each, until_fall=True)
        total = result.reward * result.actions
        outcomes.append(Outcome(seed=each, total=total, actions=result.actions, success=result.falls == 0))
        if on_episode is not None:
            on_episode(outcomes[-1])
    return Evaluation.of(outcomes, confidence)


def joined(observations: Sequence[Any]) -> Any:
    """Return observations, oldest first, as the input of a network: one as it is, several concatenated."""
    return observations[0] if len(observations) == 1 else np.concatenate(observations, axis=-1)


def _raise_any(infos: dict[str, Any], which: NDArray[np.bool_]) -> None:
    """Raise the first error of these environments: an unfinished episode has no outcome."""
    for error in infos["error"][which] if "error" in infos else ():
        if error is not None:
            raise error


def _fitting(output: Floats, space: Any) -> Floats:
    if output.shape != space.shape:
        raise ValueError(f"the network returned {output.size} numbers, but an action has {space.shape[0]}")
    return np.clip(output, space.low, space.high)
