"""Reading from one thread while another one steps."""

from __future__ import annotations

import threading

from urlab_client import URLabClient
from urlab_client.server import SimulatedServer


def test_values_read_under_the_data_lock_belong_together() -> None:
    with SimulatedServer("ball", play=True) as server, URLabClient(**server.client_options()) as client:
        client.discover()
        client.runtime.set_mode("direct")
        (ball,) = client.articulations.values()
        stepped: dict[float, list[float]] = {client.sim_time: ball.qpos_array.tolist()}
        over = threading.Event()

        def step() -> None:
            try:
                for _ in range(100):
                    reply = client.step()
                    stepped[reply.time] = reply.per_articulation[ball.prefix].qpos.tolist()
            finally:
                over.set()

        stepping = threading.Thread(target=step)
        stepping.start()
        read: list[tuple[float, float, list[float], list[float]]] = []
        while not over.is_set():
            with client._data_lock:
                assert client.data is not None
                read.append((client.sim_time, client.data.time, ball.qpos_array.tolist(), client.data.qpos.tolist()))
        stepping.join()
    assert len({time for time, *_ in read}) > 1
    for time, local_time, qpos, local_qpos in read:
        assert time == local_time
        assert stepped[time] == qpos == local_qpos
