"""`urlab serve`: run a simulated server until a signal or the end of standard input stops it.

Run a simulated server that any URLab client can talk to. It exits with code 0 on SIGINT (Ctrl-C) and SIGTERM, and with
code 2 if it fails.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import os
import queue
import signal
import threading
from argparse import Namespace
from collections.abc import Generator
from enum import Enum
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from urlab_client._installation import install_command
from urlab_client._platform.threads import daemon
from urlab_client._platform.windows import read_aside
from urlab_client.cli._arguments import DIALECT, Kinds
from urlab_client.cli._common import CommandError, import_mujoco, in_background
from urlab_client.enums import CameraMode
from urlab_client.simulation.controller_config import ControllerConfig

if TYPE_CHECKING:
    from urlab_client.server.simulated import SimulatedServer
    from urlab_client.server.transport.curve_authentication import CurveServer

logger: logging.Logger = logging.getLogger("urlab_client.cli")

_PORTS = {"step": 5559, "state": 5555, "ctrl": 5556, "info": 5557, "camera": 5558}

_PASSED_ON = (
    *("play", "unpaused", "step_mode", "host", "insecure_no_auth", *(f"{name}_port" for name in _PORTS)),
    *("camera_size", "render_quality", "mjcf_options", "randomise", "actor_names"),
    *("shm_dir", "dialect", "instance_id", "instance_index"),
)
"""Options that the server has by the same name."""

# A signal that arrives just before the main thread waits does not interrupt the wait, and on Windows none does.
_WAIT_S = 0.1
_SILENT_S = 10.0  # for a request for metrics
_START_GRACE_S = 0.5  # how long a stop waits for a start in progress; the whole stop may take a second

USAGE = f"""
MODEL+  an MJCF file, the name of a bundled robot (arm, quadruped, ...) or a saved level (.json); each MJCF becomes a
    blueprint and one actor whose id is the file stem
network:
--host HOST=127.0.0.1  interface to bind (default: %(default)s); all but loopback need --server-key or
    --insecure-no-auth
--server-key FILE  encrypt everything and prove this server's identity, with a secret key file from `urlab keys new`
| --allow-client PATH...  with --server-key: admit the client with this public key file, or all clients whose public
    keys are in this folder; repeatable
| --allow-any-client  with --server-key: admit every client that has the server's public key
--insecure-no-auth  serve anyone who can reach the interface: they can read and write files as clients can
--step-port PORT  default 5559; 0: any free one
--state-port PORT  default 5555; 0: any free one
--ctrl-port PORT  default 5556; 0: any free one
--info-port PORT  default 5557; 0: any free one
--camera-port PORT  default 5558; 0: any free one
{DIALECT}
--instance-index INDEX  number of this server among several: ports not given are 5559 + 10 N and the next two
--instance-id NAME=  name of this server among several
--metrics-port PORT  also serve metrics for Prometheus at http://127.0.0.1:PORT/metrics; 0: any free one
| --shm-dir DIR  also serve over shared memory, in a new directory below DIR (on Linux, /dev/shm avoids the disk)
| --no-shm  do not use shared memory (default)
content:
--saved-dir DIR  folder for levels and imported models (default: a temporary folder)
--model-root DIR...  folder below which clients may import MJCF files; repeatable (default: the models' folders)
--actor-names model|plugin  keys of articulations: the MJCF model name (default of the alpha), or names as the plugin
    assigns them, such as robot_C_0 (default of the beta)
physics:
--play  start a play session immediately
--unpaused  let physics run from the start of play
--step-mode auto|live|direct|puppet=auto  auto: live until a client chooses another mode; live, direct or puppet pin
    the mode
--controller ACTOR=KIND...  attach a controller: ACTOR=pd[,kp=N][,kv=N][,torque_limit=N] or ACTOR=passthrough, '*' for
    all actors; repeatable
--scene-mib N  memory limit for all models of a level and their simulation, MiB (default 1024)
--[no-]mjcf-options  use the <option> of the first model; otherwise the alpha ignores them all and the beta merges them
--randomise VARIATION  vary the model at each reset, with the seed of the reset, as a TOML file (or JSON text) declares
cameras:
--camera-mode ACTOR/CAMERA=MODE...  {", ".join(CameraMode)}; repeatable (default: real)
--camera-size WxH  pixels, for cameras without a resolution
--render-quality auto|fast|high=auto  fast: no shadows, reflections or smooth edges; high: with them; auto: fast if the
    CPU renders
for programs that start a server:
--json  print one line of JSON when the server is ready
--until-eof  also exit when standard input closes, so that the server cannot outlive the program that started it; the
    server then ignores SIGINT, unless standard input is a terminal
examples:
urlab serve quadruped --play  a bundled robot at tcp://localhost, in a play session
urlab serve robot.xml --play --unpaused --mjcf-options  your own model, simulated in real time with its own <option>
urlab serve arm ball --step-port 0 --json  two models on any free port, printed as one line of JSON
"""


def _controller(text: str) -> tuple[str, ControllerConfig]:
    actor, equals, value = text.partition("=")
    if not actor or not equals:
        raise argparse.ArgumentTypeError(f"{text!r}: write ACTOR=pd or ACTOR=passthrough ('*' for all actors)")
    try:
        return actor, ControllerConfig.parse(value)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r}: {error}") from None


def _camera_mode(text: str) -> tuple[str, CameraMode]:
    camera, equals, mode = text.rpartition("=")
    actor, slash, name = camera.partition("/")
    if not (equals and actor and slash and name):
        raise argparse.ArgumentTypeError(f"{text!r}: write ACTOR/CAMERA=MODE, for example arm/wrist=depth")
    if mode not in [*CameraMode]:
        raise argparse.ArgumentTypeError(
            f"{text!r}: {mode!r} is not a camera mode; the modes are {', '.join(CameraMode)}"
        )
    return camera, CameraMode(mode)


KINDS: Kinds = {"controller": _controller, "camera_mode": _camera_mode}


def run(arguments: Namespace) -> int:
    """Serve until stopped."""
    _settle_ports(arguments)
    if arguments.metrics_port is not None and find_spec("prometheus_client") is None:
        raise CommandError(f"prometheus_client is not installed; run: {install_command('prometheus')}")
    events: Events = queue.SimpleQueue()
    stop_on_signals(events, ignore_interrupt=arguments.until_eof and not os.isatty(0))
    if arguments.until_eof:
        watch_input(events)
    import_mujoco()
    for folder in arguments.model_root:
        if not folder.is_dir():
            raise CommandError(f"--model-root {folder}: no such folder")
    from urlab_client.server.system.temporary_folder import TemporaryFolder
    from urlab_client.server.system.threads import limit_arenas

    limit_arenas()

    with TemporaryFolder() as temporary:
        server = _server(arguments, arguments.saved_dir or temporary.path)
        starting = start_aside(server, events)
        if next_event(events) is Event.STARTED:
            with server, _metrics(server, arguments) as metrics_port:
                server.add_failure_callback(lambda _: events.put(CommandError(str(server.failure))))
                _announce(server, arguments, metrics_port)
                next_event(events)
            return 0
        starting.join(_START_GRACE_S)
        stuck = starting.is_alive()
        if not stuck:
            server.close()
    if stuck:
        # MuJoCo's compiler cannot be interrupted, and the interpreter must not be torn down while it runs.
        os._exit(0)
    return 0


def _server(arguments: Namespace, saved_dir: Path) -> SimulatedServer:
    from urlab_client.server.limits import Limits
    from urlab_client.server.simulated import SimulatedServer

    options = {name: getattr(arguments, name) for name in _PASSED_ON}
    try:
        return SimulatedServer(
            *arguments.models,
            **options,
            curve=_curve(arguments),
            saved_dir=saved_dir,
            model_roots=arguments.model_root or None,
            controllers=dict(arguments.controller),
            camera_modes=dict(arguments.camera_mode),
            limits=Limits() if arguments.scene_mib is None else Limits(scene_bytes=arguments.scene_mib * 2**20),
        )
    except ValueError as error:
        raise CommandError(str(error)) from None
    except OSError as error:  # only this option reads a file before the start
        raise CommandError(f"--randomise: {error}") from None


def _curve(arguments: Namespace) -> CurveServer | None:
    from urlab_client.server.transport.curve_authentication import CurveServer

    if arguments.server_key is None:
        if arguments.allow_client or arguments.allow_any_client:
            raise CommandError("--allow-client and --allow-any-client require --server-key FILE")
        return None
    if not (arguments.allow_client or arguments.allow_any_client):
        raise CommandError("--server-key: say who may connect, with --allow-client PATH or --allow-any-client")
    return CurveServer(
        server_key=arguments.server_key, allow=arguments.allow_client, allow_any=arguments.allow_any_client
    )


@contextlib.contextmanager
def _metrics(server: SimulatedServer, arguments: Namespace) -> Generator[int | None]:
    """Serve metrics while the block runs; yields their port, or None without `--metrics-port`."""
    if arguments.metrics_port is None:
        yield None
        return
    from prometheus_client import start_http_server

    from urlab_client.integrations.telemetry import PrometheusServerMetrics

    PrometheusServerMetrics(server)
    try:
        http, thread = start_http_server(arguments.metrics_port, addr="127.0.0.1")
    except OSError as error:
        raise CommandError(f"--metrics-port {arguments.metrics_port} cannot be used: {error.strerror}") from None
    # Each connection has a thread, which would wait for a silent peer for ever.
    handler = cast("Any", http.RequestHandlerClass)
    http.RequestHandlerClass = cast("Any", type("Handler", (handler,), {"timeout": _SILENT_S}))
    try:
        yield http.server_port
    finally:
        http.shutdown()
        http.server_close()
        thread.join()


def _announce(server: SimulatedServer, arguments: Namespace, metrics_port: int | None) -> None:
    ports = {name: int(getattr(server, f"{name}_port")) for name in _PORTS}
    if arguments.json:
        ready: dict[str, Any] = {"event": "ready", "address": server.address}
        ready |= {f"{name}_port": number for name, number in ports.items()}
        shm_dir = None if server.shm_dir is None else str(server.shm_dir)
        ready |= {"shm_dir": shm_dir, "saved_dir": str(server.saved_dir), "pid": os.getpid()}
        ready |= {"scene_warnings": server.scene_warnings}
        ready |= {"open_to": server.open_to, "server_key": server.client_options().get("server_key")}
        if metrics_port is not None:
            ready["metrics_port"] = metrics_port
        print(json.dumps(ready), flush=True)
        return
    others = ", ".join(f"{name} {number}" for name, number in ports.items() if name != "step")
    if metrics_port is not None:
        others += f", metrics {metrics_port}"
    models = ", ".join(Path(model).name for model in arguments.models)
    end = "Ctrl-C or the end of standard input" if arguments.until_eof else "Ctrl-C"
    print(
        f"Serving {models} at {server.address}:{ports['step']} ({others}), open to {server.open_to}; {end} ends it.",
        flush=True,
    )


def _settle_ports(arguments: Namespace) -> None:
    """Fill in the ports that were not given: the plugin's defaults, or 0 to derive them from the instance index."""
    from urlab_client.server.dialects import DIALECTS

    defaults = {**_PORTS, "camera": DIALECTS[arguments.dialect].first_camera_port}
    users: dict[int, str] = {}
    for name, default in defaults.items():
        number = getattr(arguments, f"{name}_port")
        if number is None:
            number = default if arguments.instance_index is None else 0
            setattr(arguments, f"{name}_port", number)
        if number and number in users:
            raise CommandError(f"--{users[number]}-port and --{name}-port are both {number}; each needs its own")
        users[number] = name


class Event(Enum):
    """What the main thread waits for."""

    STARTED = "started"
    STOP = "stop"


# Unlike a threading.Event, it may be used in signal handlers. Errors of other threads are raised in the main thread.
Events: TypeAlias = "queue.SimpleQueue[Event | BaseException]"


def start_aside(server: SimulatedServer, events: Events) -> threading.Thread:
    """Start the server off the main thread, which can thus handle a signal while a model compiles."""

    def start() -> None:
        server.start()
        events.put(Event.STARTED)

    thread = daemon("urlab-start", start, failed=events.put)
    thread.start()
    return thread


def next_event(events: Events) -> Event:
    """Wait for the next event, or raise an error of another thread; a signal interrupts the wait."""
    while True:
        with contextlib.suppress(queue.Empty):
            event = events.get(timeout=_WAIT_S)
            if isinstance(event, BaseException):
                raise event
            return event


def stop_on_signals(events: Events, *, ignore_interrupt: bool) -> None:
    """Queue `Event.STOP` on SIGTERM, a closed terminal and, unless it is meant for another process, Ctrl-C."""

    def stop(number: int, frame: FrameType | None) -> None:
        events.put(Event.STOP)

    # Ctrl-C reaches all processes of a terminal, but is meant for the one that started this server.
    signal.signal(signal.SIGINT, signal.SIG_IGN if ignore_interrupt or in_background() else stop)
    signal.signal(signal.SIGTERM, stop)
    hangup = getattr(signal, "SIGHUP", None)
    if hangup is not None and signal.getsignal(hangup) != signal.SIG_IGN:  # nohup ignores it
        signal.signal(hangup, stop)


def watch_input(events: Events) -> None:
    """Queue `Event.STOP` at the end of standard input, which a thread waits for."""

    def watch() -> None:
        # Not through sys.stdin, whose lock this thread would still hold when the interpreter ends.
        with contextlib.suppress(OSError):  # there is no standard input
            while read_aside(0, 4096):
                pass
        events.put(Event.STOP)

    def fail(error: BaseException) -> None:
        logger.error("standard input can no longer be read", exc_info=error)
        events.put(Event.STOP)

    daemon("urlab-stdin", watch, failed=fail).start()
