"""Debug drawing in the viewport of a simulated server. Makes the picture in docs/simulated-server-pictures.md."""

import math

from PIL import Image

from urlab_client import URLabClient
from urlab_client.server import ControllerConfig, SimulatedServer

STAND = {"quadruped": ControllerConfig(kp=150.0, kv=4.0)}

with (
    SimulatedServer("quadruped", "arm", play=True, controllers=STAND, render_quality="high") as server,
    URLabClient(**server.client_options(), step_mode="direct") as client,
):
    client.discover()
    arm, dog = client.articulations["arm"], client.articulations["quadruped"]
    dog.control_mode = "ue_controller"
    hand = None
    for step in range(60):
        arm.set_ctrl({"shoulder_pan": 0.9 * math.sin(step / 12)})
        client.step(10)
        before, hand = hand, arm.get_sensors()["grip_position"]
        if before is not None:
            client.debug.draw_line(before, hand, (1.0, 0.9, 0.1), ttl=-1.0, thickness=1.5)
    x, y, z = dog.root_pos_w
    client.debug.draw_marker(hand, (1.0, 0.3, 0.1), ttl=-1.0, label="grip")
    client.debug.draw_box((x, y, z), (0.4, 0.25, 0.15), (0.2, 0.9, 0.4), ttl=-1.0)
    client.debug.draw_arrow((x, y, z + 0.6), (x, y, z + 0.2), (0.3, 0.7, 1.0), ttl=-1.0, thickness=1.5)
    client.debug.draw_axes((0.6, 0.0, 0.01), scale=0.3, ttl=-1.0)
    client.debug.set_overlay_text(f"t = {client.sim_time:.2f} s")
    client.viewport.set_camera((1.8, -1.1, 1.2), rotation_euler=(0.0, -24.0, -128.0), fov=60.0)
    Image.fromarray(server.snapshot((960, 540))).save("viewport.png")
print("viewport.png shows the path of the grip")
