"""All limits on what clients can request.

A request that exceeds one is refused with an error that contains the name of the limit.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from urlab_client.protocol import sim_options

_MIB = 2**20


@dataclass(frozen=True, kw_only=True)
class Limits:
    """The limits of a `SimulatedServer`.

    Attributes:
        request_bytes: Size of a request; the connection is closed for one twice as large.
        request_depth: Levels of nesting in a request.
        string_chars: Length of a string in a request: names, ids, paths, labels.
        n_steps: Physics steps of one request. They run in slices, between which the server can stop.
        grid_cells: Cells of one `spawn_grid`.
        actors: Actors of a level.
        scene_bytes: Memory of all compiled models of a level and their simulation, together.
        sensor_values: Total size of all sensor readings of a level, in numbers; each step reports them.
        solver_iterations: Iterations of the solver, of its line search, and of collision detection, each.
        markers: Debug primitives per world; the oldest are removed.
        recording_bytes: Memory of a live recording; the oldest frames are removed.
        recording_file_bytes: Size of a recording that is loaded.
        model_file_bytes: Size of an XML file that a client names, and of each that it includes.
        model_files: Files that a model may consist of.
        model_bytes: Memory of a model that a client names, once compiled.
        data_bytes: Memory of its simulation: MuJoCo's `mjData`, including the arena.
        model_memory_bytes: Memory that its compilation may use in addition.
        model_cpu_s: Processor time of its compilation, seconds.
        model_wall_s: Wall time of its compilation, seconds.
        upload_cache_bytes: Size of the files that clients have sent, and of those that they are sending; the least
            recently used give way.
        camera_side: Width and height of a camera's pictures, pixels.
    """

    request_bytes: int = 64 * _MIB
    request_depth: int = 64
    string_chars: int = 4096
    n_steps: int = 1_000_000
    grid_cells: int = 1024
    actors: int = 4096
    scene_bytes: int = 1024 * _MIB
    sensor_values: int = 1_000_000
    solver_iterations: int = 10_000
    markers: int = 4096
    recording_bytes: int = 256 * _MIB
    recording_file_bytes: int = 256 * _MIB
    model_file_bytes: int = 64 * _MIB
    model_files: int = 4096
    model_bytes: int = 256 * _MIB
    data_bytes: int = 256 * _MIB
    model_memory_bytes: int = 1024 * _MIB
    model_cpu_s: int = 10
    model_wall_s: int = 20
    upload_cache_bytes: int = 1024 * _MIB
    camera_side: int = 8192

    def __post_init__(self) -> None:
        for field in fields(self):
            if getattr(self, field.name) < 1:
                raise ValueError(f"limit {field.name} must be at least 1, not {getattr(self, field.name)}")


def option_problem(name: str, value: Any, limits: Limits) -> str:
    """Return what is wrong with the value of an option, or nothing; options without a range may have any.

    Args:
        name: As in `mjOption`.
        value: A number, or three.
        limits: For the iterations.
    """
    if name in sim_options.ITERATIONS and not 0 <= value <= limits.solver_iterations:
        return f"{name} must be from 0 to the limit solver_iterations, {limits.solver_iterations}, not {value}"
    return sim_options.option_problem(name, value)


def options_problem(option: Any, limits: Limits) -> str:
    """Return what is wrong with a model's `mjOption`, or nothing."""
    problems = (option_problem(name, getattr(option, name), limits) for name in sim_options.RANGED_OPTIONS)
    return next(filter(None, problems), "")
