"""Pictures of a batch: what a policy sees there is what it sees on a server."""

from __future__ import annotations

import subprocess
import sys
from typing import Any, Literal

import mujoco
import numpy as np
import pytest

from urlab_client.enums import CameraMode
from urlab_client.integrations.gym import URLabBatchEnv, URLabVectorEnv
from urlab_client.integrations.gym.engines import ThreadedBatch
from urlab_client.randomise import Randomisation, Vary
from urlab_client.server import SimulatedServer

MODES = {
    "arm/overview": CameraMode.REAL,
    "arm/wrist": CameraMode.DEPTH,
    "quadruped/side": CameraMode.INSTANCE,  # it follows the robot's centre of mass
    "quadruped/head": CameraMode.SEMANTIC,
}
LOOK = Randomisation(
    vary=(
        Vary(what="camera_position", on="quadruped/side", add=(-0.2, 0.2)),
        Vary(what="camera_rotation", on="arm/wrist", add=(-0.1, 0.1)),
        Vary(what="colour", on="*", scale=(0.5, 1.5)),
        Vary(what="light_position", on="*", add=(-0.5, 0.5)),
        Vary(what="light_colour", on="*", scale=(0.3, 1.0)),
        Vary(what="specular", on="*", set=(0.0, 1.0)),
        Vary(what="shininess", on="arm/*", scale=(0.2, 1.0)),
    )
)


@pytest.mark.usefixtures("opengl")
@pytest.mark.parametrize("quality", ["fast", pytest.param("high", marks=pytest.mark.long)])
def test_a_batch_sees_what_a_server_shows(quality: Literal["fast", "high"], made: list[Any]) -> None:
    options: Any = {"space_mode": "dict", "cameras": list(MODES), "n_substeps": 20, "reset_noise": 0.2}
    options |= {"render_mode": "rgb_array", "render_camera": "arm/wrist"}
    with SimulatedServer(
        *("arm", "quadruped"),
        play=True,
        render_quality=quality,
        camera_size=(48, 32),
        camera_modes={name: mode for name, mode in MODES.items() if mode is not CameraMode.REAL},
        randomise=LOOK,
    ) as server:
        address = f"{server.address}:{server.step_port}"
        batch, wire = URLabBatchEnv(address, 2, **options), URLabVectorEnv([address], **options)
        made += [batch, wire]
        assert wire.single_observation_space == batch.single_observation_space
        seen = [(wire.reset(seed=6)[0], batch.reset(seed=5)[0])]
        hold = {key: np.zeros(space.shape, np.float32) for key, space in batch.action_space.items()}  # type: ignore[attr-defined]
        seen.append((wire.step({key: values[:1] for key, values in hold.items()})[0], batch.step(hold)[0]))
        for camera, mode in MODES.items():
            for expected, ours in seen:
                assert np.array_equal(ours["cameras"][camera][1], expected["cameras"][camera][0]), camera
                assert len(np.unique(ours["cameras"][camera][1])) > 2, "there is something in it"
                if mode is not CameraMode.SEMANTIC:
                    assert not np.array_equal(*ours["cameras"][camera]), "each copy has a look of its own"
        assert np.array_equal(batch.render()[1], wire.render()[0])  # type: ignore[index]


def test_a_batch_refuses_cameras_that_it_cannot_show(made: list[Any]) -> None:
    with SimulatedServer("arm", play=True) as server:
        address = f"{server.address}:{server.step_port}"
        with pytest.raises(KeyError, match="nose"):
            URLabBatchEnv(address, 1, space_mode="dict", cameras=["arm/nose"])
        with pytest.raises(KeyError, match="nose"):
            URLabBatchEnv(address, 1, render_mode="rgb_array", render_camera="arm/nose")
        with pytest.raises(ValueError, match="a flat observation cannot contain images"):
            URLabBatchEnv(address, 1, cameras=["arm/wrist"])
        batch = URLabBatchEnv(address, 1)
        made.append(batch)
        assert batch.render() is None


def test_what_follows_from_a_varied_camera_is_known_before_mujoco_has_batches() -> None:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body pos='1 0 0'><freejoint/><geom size='0.1'/>"
        "<camera mode='trackcom' pos='0 0 2'/></body></worldbody></mujoco>"
    )
    batch = ThreadedBatch(model, 2)
    local, derived = batch.expand("cam_pos"), batch.expand("cam_poscom0")
    local[1] = [[0.0, 0.0, 3.0]]
    batch.set_const(np.array([1]))
    assert derived.tolist() == [[[0.0, 0.0, 2.0]], [[0.0, 0.0, 3.0]]]
    assert batch.expand("cam_pos")[1].tolist() == [[0.0, 0.0, 3.0]]


@pytest.mark.opengl
@pytest.mark.long
def test_a_program_that_forgets_to_close_a_batch_ends(tmp_path: Any) -> None:
    script = tmp_path / "forgetful.py"
    script.write_text(
        "from urlab_client.integrations.gym import URLabBatchEnv\n"
        "env = URLabBatchEnv('sim://arm?camera-size=32x24', 1, space_mode='dict', cameras=['arm/wrist'])\n"
        "print(env.reset(seed=0)[0]['cameras']['arm/wrist'].shape)\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "(1, 24, 32, 3)\n", "")
