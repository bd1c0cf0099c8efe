"""Files that are mapped into memory."""

from __future__ import annotations

import os
import weakref
from pathlib import Path

import pytest

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


@pytest.mark.parametrize("blocks", [True, False], ids=["with all its blocks", "where systems cannot allocate them"])
def test_a_file_that_was_cut_gets_its_size_back(blocks: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if not blocks:
        monkeypatch.delattr(os, "posix_fallocate", raising=False)
    path = tmp_path / "file"
    file = MappedFile(path, writable=True, size=10_000)
    assert path.stat().st_size == 10_000
    file.view[:4] = b"0123"
    os.truncate(path, 100)
    file.restore()
    assert path.read_bytes() == b"0123" + bytes(9_996)
    file.close()


def test_one_client_excludes_others_until_it_closes_the_file(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"0123")
    first, second = MappedFile(path), MappedFile(path)
    assert first.lock()
    assert not second.lock()
    first.close()
    assert second.lock()
    second.close()
