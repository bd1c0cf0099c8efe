"""Files that are mapped into memory."""

from __future__ import annotations

import weakref
from pathlib import Path

from urlab_client._platform.mapped_files import MappedFile


def test_the_mapping_ends_with_the_last_view_of_it(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"0123")
    file = MappedFile(path)
    held = file.view[1:3]
    mapping = weakref.ref(file._mmap)
    file.close()
    assert bytes(held) == b"12"
    assert mapping() is not None
    held.release()
    del held
    assert mapping() is None, "a file that was closed keeps it"
