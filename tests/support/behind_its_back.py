"""Somebody else at the server, of whom no client is told."""

from __future__ import annotations

import asyncio

import msgspec
import zmq
from waiting import DEADLINE_S

from urlab_client.aio import URLabClient
from urlab_client.server import SimulatedServer


async def behind_its_back(server: SimulatedServer, client: URLabClient, op: str) -> None:
    """Do what somebody at the editor does, where no client is told."""

    def ask() -> None:
        with zmq.Context() as context, context.socket(zmq.REQ) as socket:
            socket.linger = 0
            socket.rcvtimeo = round(1e3 * DEADLINE_S)
            socket.connect(f"tcp://127.0.0.1:{server.client_options()['step_port']}")
            socket.send(msgspec.msgpack.encode({"op": op, "session_id": client.session_id}))
            assert msgspec.msgpack.decode(socket.recv())["op"] == f"{op}_ok"

    await asyncio.to_thread(ask)
