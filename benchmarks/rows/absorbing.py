"""Taking a reply over into articulations and the local model."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterator

from benchmarks.canned import server
from benchmarks.harness import Pair, Row, each
from benchmarks.robots import recorded
from urlab_client import aio
from urlab_client.protocol.codec import decode_reply, op_of
from urlab_client.protocol.messages.session import Step, StepOk

__all__ = ["ROWS"]


@contextlib.contextmanager
def _absorbing() -> Iterator[Pair]:
    answers = recorded(30, 8)
    frame, op = answers["step"], op_of(Step)
    reply = decode_reply(op, StepOk, frame)
    with server(answers) as port, asyncio.Runner() as runner:
        client = aio.URLabClient(f"tcp://127.0.0.1:{port}", step_mode="direct")
        runner.run(client.discover())
        state = client._state  # noqa: SLF001  # what follows decoding inside step()
        yield Pair(ours=each(lambda: state.absorb(reply, "step")), floor=each(lambda: decode_reply(op, StepOk, frame)))
        runner.run(client.close())


ROWS = (
    Row(
        name="absorb",
        what="absorbing a standard reply of 8 robots with 30 DoF and a free base each",
        floor="decoding it",
        reach=1.0,
        prepare=_absorbing,
    ),
)
