"""`urlab snapshot`: write a picture of a model, of a saved level, or of what a camera of a running server sees.

Write a picture of models or of a saved level, which this command simulates itself, or of what a camera of a running
server sees, in any mode and without a step. The latter opens a session, which takes the server over from the client
that drives it, unless you pass --handshake. Needs the extra 'urlab-client[demo]'.
"""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from urlab_client._installation import need
from urlab_client._platform.files import replaced
from urlab_client.cli._arguments import MJCF_OPTIONS, WATCHER, handshake, make_client
from urlab_client.cli._common import CommandError, check_ending, import_mujoco
from urlab_client.enums import CameraMode
from urlab_client.errors import URLabTimeoutError
from urlab_client.values.pictures import to_rgb

if TYPE_CHECKING:
    from urlab_client import URLabCameraView, URLabClient

_VIEW_MODES = ("lit", "unlit", "wireframe", "collision")
_FORMATS = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg", ".webp": "webp"}
_TIMEOUT_S = 5.0
_CHUNK = 100  # physics steps per request, for which the server allows 5 s

USAGE = f"""
SOURCE+  MJCF files, names of bundled robots and at most one saved level (.json), as for `urlab serve`; or the address
    of a running server, tcp://HOST[:PORT] or ipc://PATH
-o --output FILE=snapshot.png  a .png, .jpg or .webp file
--camera ARTICULATION/CAMERA  show what this camera sees (default: the whole scene, from outside)
--mode {"|".join((*_VIEW_MODES, *CameraMode))}  the view mode; with --camera the camera's mode (default: lit, or real)
--size WxH=1280x720  size in pixels, also of a camera without a resolution
--keyframe NAME  start play at this keyframe
--seconds S  simulate for this long first
{MJCF_OPTIONS.format("for models")}
--timeout S  how long to wait for a running server (default: 5, and 30 for its first picture)
{WATCHER}
examples:
urlab snapshot quadruped -o quadruped.png  a bundled robot
urlab snapshot robot.xml --keyframe home --seconds 1 -o robot.jpg
    your own model, one second after its keyframe, as JPEG
urlab snapshot arm --camera arm/wrist --mode depth  what a camera of the model sees
urlab snapshot tcp://localhost --camera arm/overview  what a camera of a running server sees
urlab snapshot tcp://localhost --camera arm/overview --handshake robot.hello  alongside its client
"""


def run(arguments: Namespace) -> int:
    """Write the picture."""
    need("PIL", extra="demo")
    if not arguments.output.parent.is_dir():
        raise CommandError(f"{arguments.output}: no such folder")
    check_ending(arguments.output, *_FORMATS)
    _check_mode(arguments)
    if recordings := [source for source in arguments.sources if source.endswith(".mcap")]:
        raise CommandError(f"{recordings[0]} is a recording; urlab plot, view and console show it")
    if pictures := [source for source in arguments.sources if source.endswith((*_FORMATS, ".gif"))]:
        raise CommandError(f"{pictures[0]} is a picture, not a model; write to it with -o {pictures[0]}")
    import_mujoco()
    if any("://" in source for source in arguments.sources):
        image = _of_running_server(arguments)
    else:
        image = _of_models(arguments)
    write_picture(arguments.output, image)
    print(f"{arguments.output}: {image.shape[1]}x{image.shape[0]}")
    return 0


def _check_mode(arguments: Namespace) -> None:
    if arguments.mode is None:
        return
    for_camera = arguments.mode in [*CameraMode]
    if for_camera != (arguments.camera is not None):
        fitting = _VIEW_MODES if for_camera else tuple(CameraMode)
        where = "without --camera" if for_camera else "with --camera"
        raise CommandError(f"--mode {arguments.mode}: {where} the modes are {', '.join(fitting)}")


def _of_models(arguments: Namespace) -> NDArray[np.uint8]:
    from urlab_client import URLabClient
    from urlab_client.server import SimulatedServer
    from urlab_client.simulation.opengl import need_backend

    if arguments.handshake is not None:
        raise CommandError("--handshake is for the address of a running server")
    need_backend()
    camera = arguments.camera
    play = bool(camera or arguments.keyframe or arguments.seconds)
    with SimulatedServer(
        *arguments.sources,
        play=play,
        camera_modes={camera: CameraMode(arguments.mode)} if camera and arguments.mode else {},
        camera_size=arguments.size,
        mjcf_options=arguments.mjcf_options,
    ) as server:
        with URLabClient(**server.client_options(), step_mode="direct") as client:
            client.discover()
            view = client.camera(camera) if camera else None
            if arguments.keyframe:
                client.reset(arguments.keyframe)
            _simulate(client, arguments.seconds or 0.0)
            if camera and view is not None:
                client.step(include_cameras={camera: "sync"})
                return _pixels(view)
            if arguments.mode:
                client.viewport.set_mode(arguments.mode)
        return server.snapshot(arguments.size, frame_all=True)


def _simulate(client: URLabClient, duration: float) -> None:
    model = client.model
    remaining = round(duration / model.opt.timestep) if model is not None else 0
    while remaining > 0:
        client.step(min(remaining, _CHUNK))
        remaining -= _CHUNK


def _of_running_server(arguments: Namespace) -> NDArray[np.uint8]:
    from urlab_client import URLabClient

    if len(arguments.sources) > 1:
        raise CommandError("give one address or models, not both")
    if arguments.keyframe or arguments.seconds:
        raise CommandError("--keyframe and --seconds are for models; a running server is not reset or stepped")
    (address,) = arguments.sources
    timeout_ms = round(1e3 * (arguments.timeout or _TIMEOUT_S))
    with make_client(URLabClient, address, arguments, rcv_timeout_ms=timeout_ms) as client:
        client.discover(handshake=handshake(arguments))
        if arguments.camera is None:
            names = [f"{key}/{camera}" for key, robot in client.articulations.items() for camera in robot.cameras]
            raise CommandError(
                f"{address}: the plugin has no op for the viewport's picture; give --camera, one of "
                f"{', '.join(names) or 'none (is play running?)'}"
            )
        view = client.camera(arguments.camera)
        if arguments.mode not in (None, view.mode):
            raise CommandError(f"--mode {arguments.mode}: {arguments.camera} is a camera of mode {view.mode}")
        try:
            view.capture(**({} if arguments.timeout is None else {"timeout": arguments.timeout}))
        except URLabTimeoutError as error:
            raise CommandError(f"{address}: no picture of {arguments.camera}: {error}") from None
        return _pixels(view)


def _pixels(view: URLabCameraView) -> NDArray[np.uint8]:
    """Return the newest frame as red, green and blue; depth as grey."""
    frame = view.latest_frame
    if frame is None:
        raise CommandError(f"camera {view.name} delivered no picture")
    return to_rgb(frame, view.mode)


def write_picture(path: Path, image: NDArray[np.uint8]) -> None:
    """Write a picture in the format that the file's ending names."""
    from PIL import Image

    with replaced(path) as temporary:
        Image.fromarray(image[:, :, :3]).save(temporary, format=_FORMATS[path.suffix.lower()])  # all are opaque
