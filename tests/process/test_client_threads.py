"""Several clients in the threads of one process, from their very first use on."""

from __future__ import annotations

import subprocess
import sys

# Each child has met no struct yet: the first use is what matters.
FIRST_USE = """
import os, sys, threading
import msgspec
from urlab_client.protocol.codec import decode_reply
from urlab_client.errors import ProtocolError
from urlab_client.server.dialects import ALPHA
from urlab_client.server.rpc.requests import RequestReader

HELLO = {"op": "hello_ok", "session_id": "", "urlab_version": "", "mujoco_version": "", "articulations": [{}]}
frame = msgspec.msgpack.encode(HELLO)
sys.setswitchinterval(1e-6)

def first_use(together, number):
    together.wait()
    if number == 0:
        RequestReader()
    for op in ALPHA.ops.values():
        try:
            decode_reply(op, op.reply, frame)
        except ProtocolError:
            pass

for _ in range(6):
    child = os.fork()
    if child == 0:
        together = threading.Barrier(4)
        threads = [threading.Thread(target=first_use, args=[together, number]) for number in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
"""


def test_threads_may_decode_for_the_first_time_together() -> None:
    """Without `codec.building` more than half of the children crash inside msgspec."""
    done = subprocess.run([sys.executable, "-c", FIRST_USE], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
