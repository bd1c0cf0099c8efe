"""A writer and two readers in processes of their own: no torn payload is accepted, from our regions or the server's.

`URLAB_HAMMER_S=10` runs the long form.
"""

from __future__ import annotations

import mmap
import os
import subprocess
import sys
from pathlib import Path

import pytest

from urlab_client.protocol.fence import processor_fence
from urlab_client.protocol.shm import create, region_size

SECONDS = os.environ.get("URLAB_HAMMER_S", "1")
HAMMER = Path(__file__).parents[1] / "support" / "hammer.py"
STRIDE = 1024


def side(kind: str, path: Path) -> subprocess.Popen[str]:
    command = [sys.executable, str(HAMMER), kind, str(path), SECONDS]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


@pytest.mark.timeout(60 + 3 * float(SECONDS))
def test_nothing_torn_is_accepted(tmp_path: Path) -> None:
    path = tmp_path / "region"
    path.write_bytes(bytes(region_size(STRIDE)))
    with path.open("r+b") as file, mmap.mmap(file.fileno(), 0) as mapping:
        create(memoryview(mapping), STRIDE, fence=processor_fence()).release()
    sides = [side("write", path), side("read", path), side("read", path)]
    outputs = [process.communicate(timeout=30 + 2 * float(SECONDS))[0] for process in sides]
    assert [process.returncode for process in sides] == [0, 0, 0]
    written, *read = outputs
    sys.stdout.write(f"{written.strip()} written; accepted and torn: {[line.strip() for line in read]}\n")
    assert int(written) > 0
    for line in read:
        accepted, torn = map(int, line.split())
        assert accepted > 0
        assert torn == 0
