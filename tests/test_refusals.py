"""What is refused says what was given, what is wrong with it, and what would do."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from children import signals_kept

from urlab_client import ProtocolError, URLabClient, URLabRPCError
from urlab_client.aio.arguments import integer
from urlab_client.cli import main
from urlab_client.integrations.record.recorder import record
from urlab_client.integrations.record.transitions import check_episodes
from urlab_client.keys import KeyFileError, KeyPair, public_keys, read_pair
from urlab_client.protocol.topics import articulation_filter, resolve_endpoint
from urlab_client.randomise import Push, Randomisation, Vary
from urlab_client.server import SimulatedServer, faults
from urlab_client.simulation.joint_recording import decode_csv, decode_json
from urlab_client.values.pictures import jpeg
from urlab_client.values.plain import read, read_array, read_bytes
from urlab_client.values.rotation import normalized

FAR = "tcp://192.0.2.1"
KEY = "k" * 40
refused: Any = partial  # type checkers see that it is wrong, too
BLACK = np.zeros((2, 2, 3), np.uint8)


@pytest.mark.parametrize(
    ("call", "kind", "said"),
    [
        (refused(integer, "n_steps", "two"), TypeError, "n_steps takes an integer, got 'two'."),
        (refused(URLabClient, encoding="xml"), ValueError, "encoding must be msgpack or json, not 'xml'"),
        (refused(URLabClient, shm_dir="/tmp"), ValueError, "shm_dir is for transport='shm'"),
        (refused(URLabClient, rcv_timeout_ms=0), ValueError, "rcv_timeout_ms must be above 0, got 0"),
        (refused(URLabClient, read_only=True, step_mode="direct"), ValueError, "read_only needs transport='zmq'"),
        (refused(URLabClient, read_only=True, transport="shm"), ValueError, "read_only needs transport='zmq'"),
        (refused(URLabClient, "sim://arm", read_only=True), ValueError, "read_only needs transport='zmq'"),
        (refused(URLabClient, FAR, client_key="a"), ValueError, "client_key requires server_key: the client must know"),
        (
            refused(URLabClient, "ipc://a", server_key=KEY),
            ValueError,
            "server_key requires a tcp:// address, got 'ipc://a'",
        ),
        (
            refused(record, None, "a.mcap", image_format="gif"),
            ValueError,
            "image_format must be 'jpeg' or 'png', not 'gif'",
        ),
        (refused(check_episodes, "best"), ValueError, "only must be kept, success or all, not 'best'"),
        (refused(Randomisation.of, 3), TypeError, "a randomisation is a Randomisation, JSON or a TOML file, got 3"),
        (
            refused(SimulatedServer, actor_names="both"),
            ValueError,
            "actor_names must be 'model' or 'plugin', not 'both'",
        ),
        (refused(SimulatedServer, dialect="gamma"), ValueError, "dialect must be alpha or beta, not 'gamma'"),
        (
            refused(SimulatedServer, camera_size=(0, 3)),
            ValueError,
            "camera_size must be a width and a height of at least",
        ),
        (
            refused(SimulatedServer, user_channels={"lamp": 1.0}),
            ValueError,
            "user_channels: 'lamp' does not say ROBOT/",
        ),
        (
            refused(SimulatedServer, user_channels={"scene/lamp": {"a": 1}}),
            ValueError,
            "user_channels: 'scene/lamp' cannot begin with {'a': 1}",
        ),
        (
            refused(SimulatedServer, instance_index=-1),
            ValueError,
            "instance_index must be a number from 0 to 5000, not -1",
        ),
        (refused(SimulatedServer, instance_index=5001), ValueError, "instance_index must be a number from 0 to 5000"),
        (
            refused(SimulatedServer, state_port=65536),
            ValueError,
            "state_port must be a number from 0 to 65535, not 65536",
        ),
        (refused(SimulatedServer, render_quality="best"), ValueError, "render_quality must be "),
        (
            refused(SimulatedServer, "a.json", "b.json"),
            ValueError,
            "only one level can be open: a.json, b.json",
        ),
        (
            refused(Vary, what="mass", add=(1.0, 2.0), distribution="log-uniform"),
            ValueError,
            "mass: log-uniform is for factors and values above 0",
        ),
        (
            refused(Vary, what="mass", set=(0.0, 2.0), distribution="log-uniform"),
            ValueError,
            "mass: log-uniform is for factors and values above 0",
        ),
        (refused(Vary, what="mass", scale=(-0.5, 1.0)), ValueError, "mass: a factor is at least 0, not -0.5"),
        (refused(Vary, what="mass"), ValueError, "mass needs one of scale, add and set, not none"),
        (refused(Vary, what="kp", add=(1.0, 2.0)), ValueError, "kp takes scale, not add"),
        (refused(Vary, what="gravity", on="arm/*", add=(0.0, 1.0)), ValueError, "gravity applies to the whole scene"),
        (refused(Push, body="arm/hand", force=(0.0, 1.0), every=(3, 2)), ValueError, "push: every takes two numbers"),
        (refused(Push, body="arm/hand", force=(0.0, 1.0), every=(1, 2), lasts=0), ValueError, "push: lasts must be at"),
        (refused(jpeg, BLACK, "real", 0), ValueError, "the quality of a JPEG is 1 to 100, got 0"),
        (refused(jpeg, BLACK, "real", 101), ValueError, "the quality of a JPEG is 1 to 100, got 101"),
        (refused(jpeg, BLACK, "real", max_size=0), ValueError, "max_size is at least 1 pixel, got 0"),
        (
            refused(normalized, (float("nan"), 0, 0, 1)),
            ValueError,
            "a quaternion has finite components, not [nan, 0, 0, 1]",
        ),
        (refused(read, Literal["sim", "wall"], "sun", "clock"), ValueError, "clock: 'sun' does not fit "),
        (refused(read_bytes, 3), ValueError, "int is not base64 text"),
        (refused(read_array, [0.5, 300], np.dtype(np.uint8)), ValueError, "the numbers are not uint8"),
        (faults.Fault, TypeError, "a fault is "),
        (
            refused(faults.Cut, topic="state/full"),
            ValueError,
            "Cut concerns requests; published messages are delayed",
        ),
        (refused(articulation_filter, ""), ValueError, "an articulation key is never empty"),
        (
            refused(resolve_endpoint, "localhost", "a"),
            ProtocolError,
            "endpoint 'localhost': no scheme, expected tcp://HOST:PORT.",
        ),
        (
            refused(resolve_endpoint, "tcp://a:0", "a"),
            ProtocolError,
            "endpoint 'tcp://a:0': no port in 1..65535, expected",
        ),
        (refused(decode_json, b'{"Cameras": []}'), ValueError, "the list 'Frames' is missing"),
        (refused(decode_csv, b""), ValueError, "the table is empty"),
        (refused(decode_csv, b"time,hip\n1,2\n3\n"), ValueError, "row 3 has 1 cells, the header has 2"),
        (refused(decode_csv, b"time,hip\n1,2\n3,nan\n"), ValueError, "row 3 contains a number that is not finite"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_arguments(call: Callable[[], object], kind: type[Exception], said: str) -> None:
    with pytest.raises(kind, match=f"^{re.escape(said)}"):
        call()


def test_keys(tmp_path: Path) -> None:
    public, secret = KeyPair.new().write(tmp_path, "robot")
    with pytest.raises(KeyFileError, match=r"robot\.key exists, and keys are never overwritten") as again:
        KeyPair.new().write(tmp_path, "robot")
    assert again.value.hint == "Choose another name."
    with pytest.raises(KeyFileError, match="contains no secret key") as wrong:
        read_pair(public)
    assert wrong.value.hint == "Name the file that ends in .key_secret."
    secret.chmod(0o644)
    with pytest.raises(KeyFileError, match="open to other users") as shared:
        read_pair(secret)
    assert shared.value.hint == f"Run chmod 600 {secret}"
    (tmp_path / "empty").mkdir()
    with pytest.raises(KeyFileError, match=r"contains no file that ends in \.key"):
        public_keys([tmp_path / "empty"])


def test_an_error_code_has_one_class() -> None:
    with pytest.raises(TypeError, match="error code 'not_ready' is declared twice"):
        type("Again", (URLabRPCError,), {}, code="not_ready")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("view sim://arm --foxglove --save a.rrd", "--save, --connect and --page require --rerun"),
        ("record sim://arm a.mcap --step-mode live --keyframe home", "--keyframe resets the simulation, which needs"),
        ("serve arm --allow-any-client", "--allow-client and --allow-any-client require --server-key FILE"),
        ("serve arm --server-key a.key_secret", "--server-key: say who may connect, with --allow-client PATH or"),
        ("serve arm --camera-mode wrist", "write ACTOR/CAMERA=MODE, for example arm/wrist=depth"),
        ("snapshot tcp://a tcp://b", "give one address or models, not both"),
        ("serve arm --step-port 70000", "a port is a whole number from 0 (any free one) to 65535"),
        ("serve arm --step-port many", "'many': a port is a whole number from 0"),
        ("serve arm --randomise missing.toml", "--randomise: "),
        ("serve nobody", "nobody"),
        ("console sim://arm --public-url ftp://lab", "'ftp://lab' is not a URL of a page"),
        ("convert missing.mcap a.csv", "missing.mcap"),
        ("plot missing.mcap", "missing.mcap"),
        ("info missing.mcap", "missing.mcap"),
        ("evaluate missing.onnx", "missing.toml: cannot be read"),
        ("snapshot sim://arm --mode depth", "--mode depth: without --camera the modes are lit, unlit, wireframe"),
        (
            "ping tcp://localhost --mjcf-options",
            "--mjcf-options is for sim://MODEL; tcp://localhost is already running",
        ),
    ],
)
def test_commands(
    line: str, said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with signals_kept(), suppress(SystemExit):  # of the parser
        assert main(line.split()) == 2
    assert said in capsys.readouterr().err
