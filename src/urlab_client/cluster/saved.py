"""Episodes as files in a folder, so that an interrupted run can continue."""

from __future__ import annotations

import contextlib
import json
import os
import zipfile
import zlib
from collections.abc import Generator, Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from urlab_client._platform.files import replaced
from urlab_client.cluster.episodes import Episode, seed_of

_ARRAYS: Final = ("observations", "actions", "rewards")
_ABOUT: Final = "about"
_DAMAGED: Final = (
    *(ValueError, TypeError, AttributeError, LookupError, EOFError, OverflowError, MemoryError, RecursionError),
    *(zipfile.BadZipFile, zlib.error),
)


def save_episode(episode: Episode, folder: str | os.PathLike[str]) -> Path:
    """Write an episode to `folder/episode_ID.npz`, replacing an existing file.

    The file appears only when it is complete; if the driver is killed, there is no file, or the previous one.

    Args:
        episode: The episode.
        folder: The folder, created if missing.

    Returns:
        The file. It contains plain arrays, and everything else as JSON under `about`.

    Raises:
        OSError: The file cannot be written.
    """
    Path(folder).mkdir(parents=True, exist_ok=True)
    path = _path(folder, episode.id)
    arrays = dict[str, NDArray[Any]]()
    places = list[list[str]]()
    for name in _ARRAYS:
        for place, array in _leaves(getattr(episode, name), (name,)):
            arrays[str(len(places))] = array
            places.append([*place])
    about = {field.name: getattr(episode, field.name) for field in fields(episode) if field.name not in _ARRAYS}
    arrays[_ABOUT] = np.array(json.dumps({**about, "arrays": places}))
    with replaced(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **cast("Any", arrays))
    return path


def load_episodes(folder: str | os.PathLike[str]) -> Iterator[Episode]:
    """Read the episodes in a folder one at a time, in the order of their ids.

    Raises:
        OSError: The folder does not exist, or a file cannot be read.
        ValueError: A file does not contain an episode.
    """
    for path in _saved(folder):
        with _opened(path) as (about, file):
            values: dict[str, Any] = {}
            for number, (*place, last) in enumerate(about.pop("arrays")):
                at = values
                for key in place:
                    at = at.setdefault(key, {})
                at[last] = file[str(number)]
            episode = Episode(**about, **values)
        yield episode


def missing_ids(folder: str | os.PathLike[str], n: int, *, seed: int = 0) -> list[int]:
    """Return the ids of a run's episodes that are not yet in a folder: `rollouts(…, n, seed=seed, ids=…)`.

    Args:
        folder: Folder used with `save_episode`; it may not exist yet.
        n: Number of episodes of the run.
        seed: Seed of the run.

    Raises:
        ValueError: An episode in the folder belongs to another run: it has another seed, or an id above n - 1.
    """
    saved = set[int]()
    for path in _saved(folder) if Path(folder).exists() else []:
        with _opened(path) as (about, _):
            i, own = int(about["id"]), about["seed"]
        if not 0 <= i < n or own != seed_of(seed, i):
            raise ValueError(f"{path} does not belong to a run of {n} episodes with seed {seed}: use another folder")
        saved.add(i)
    return [i for i in range(n) if i not in saved]


def _path(folder: str | os.PathLike[str], i: int) -> Path:
    return Path(folder) / f"episode_{i:06}.npz"


def _saved(folder: str | os.PathLike[str]) -> list[Path]:
    return sorted(path for path in Path(folder).iterdir() if path.match("episode_*.npz"))


@contextlib.contextmanager
def _opened(path: Path) -> Generator[tuple[dict[str, Any], Any]]:
    """Yield what an episode's file says and its arrays."""
    try:
        with np.load(path, allow_pickle=False) as file:
            yield json.loads(str(file[_ABOUT])), file
    except _DAMAGED as error:
        raise ValueError(f"{path} does not contain an episode: {error}") from error


def _leaves(values: Any, place: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], NDArray[Any]]]:
    """Yield the arrays of nested dictionaries with their key paths."""
    if not isinstance(values, Mapping):
        yield place, values
        return
    for key, inner in cast("Mapping[str, Any]", values).items():
        yield from _leaves(inner, (*place, key))
