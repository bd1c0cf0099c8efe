"""Writers and readers in processes of their own: nothing torn is accepted.

`URLAB_HAMMER_S=10` runs the long form.
"""

from __future__ import annotations

import mmap
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hammer import STRIDE

from urlab_client._platform.processors import processor_fence
from urlab_client.protocol.shm import Region, region_size

SECONDS = os.environ.get("URLAB_HAMMER_S", "0.3")
HAMMER = Path(__file__).parents[1] / "support" / "hammer.py"


def side(role: str, path: Path) -> subprocess.Popen[str]:
    command = [sys.executable, str(HAMMER), role, str(path), SECONDS]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


@pytest.mark.timeout(200 + 3 * float(SECONDS))
def test_nothing_torn_is_accepted(tmp_path: Path) -> None:
    path = tmp_path / "region"
    path.write_bytes(bytes(region_size(STRIDE)))
    with path.open("r+b") as file, mmap.mmap(file.fileno(), 0) as mapping:
        Region.lay_out(memoryview(mapping), STRIDE, fence=processor_fence()).release()
    sides = [side(role, path) for role in ("write", "read", "read")]
    try:
        for process in sides:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
        for process in sides:
            assert process.stdin is not None
            process.stdin.write("go\n")
            process.stdin.flush()
        outputs = [process.communicate(timeout=100 + 2 * float(SECONDS))[0] for process in sides]
    finally:
        for process in sides:
            process.kill()
    assert [process.returncode for process in sides] == [0] * len(sides)
    written, *read = outputs
    counts = [tuple(map(int, line.split())) for line in read]
    sys.stdout.write(f"{written} written; reads, accepted, wrong: {counts}\n")
    assert int(written) > 0
    for _, accepted, wrong in counts:
        assert accepted > 0
        assert wrong == 0
