from __future__ import annotations

import mmap
import pickle
import struct
from collections.abc import Callable, Iterator
from pathlib import Path, PurePath

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from urlab_client._platform.processors import no_fence
from urlab_client.errors import ProtocolError
from urlab_client.protocol import shm
from urlab_client.protocol.shm import Region

STRIDE = 24


def new_region(n_buffers: int = 2, stride: int = STRIDE) -> tuple[bytearray, Region]:
    buffer = bytearray(b"\xee" * shm.region_size(stride, n_buffers))
    return buffer, Region.lay_out(buffer, stride, n_buffers, fence=no_fence)


def payload_of(publication: int) -> bytes:
    """A payload whose every byte, and whose length, belong to one publication."""
    return bytes([publication % 251]) * (1 + publication * 7 % (STRIDE - 4))


def store_by_store(buffer: bytearray, n_buffers: int) -> Iterator[None]:
    """Publish for ever, yielding between any two stores: a writer that can be stopped anywhere."""
    for publication in range(1, 1000):
        target = publication % n_buffers
        payload = payload_of(publication)
        start = 64 + target * STRIDE
        struct.pack_into("<I", buffer, start, len(payload))
        yield
        half = len(payload) // 2
        buffer[start + 4 : start + 4 + half] = payload[:half]
        yield
        buffer[start + 4 + half : start + 4 + len(payload)] = payload[half:]
        yield
        struct.pack_into("<I", buffer, 24, target)
        yield
        struct.pack_into("<Q", buffer, 16, publication)
        yield


class TestPublishAndRead:
    @given(st.lists(st.binary(min_size=1, max_size=STRIDE - 4), min_size=1, max_size=12), st.integers(2, 64))
    @example([b"x"], 64)
    def test_the_newest_is_read(self, payloads: list[bytes], n_buffers: int) -> None:
        buffer, region = new_region(n_buffers)
        for payload in payloads:
            region.publish(payload)
        reader = shm.Region(memoryview(buffer).toreadonly(), fence=no_fence)
        newest = reader.read_latest()
        assert newest == shm.Publication(len(payloads), payloads[-1])
        assert reader.read_latest(len(payloads)) is None
        header = shm.parse_header(buffer)
        assert (header.stride, header.n_buffers, header.sequence) == (STRIDE, n_buffers, len(payloads))
        assert header.latest_idx == len(payloads) % n_buffers

    @given(st.lists(st.tuples(st.booleans(), st.binary(min_size=1, max_size=STRIDE - 4)), max_size=20))
    def test_following_a_writer(self, steps: list[tuple[bool, bytes]]) -> None:
        buffer, region = new_region()
        reader = shm.Region(buffer, fence=no_fence)
        last_seen, newest, unread = 0, b"", False
        for is_read, payload in steps:
            if is_read:
                publication = reader.read_latest(last_seen)
                assert (publication.payload if publication else None) == (newest if unread else None)
                last_seen = publication.sequence if publication else last_seen
                unread = False
            else:
                region.publish(payload)
                newest, unread = payload, True

    def test_nothing_published_yet(self) -> None:
        _, region = new_region()
        assert region.sequence == 0
        assert region.read_latest() is None

    def test_a_late_reader_of_replies_waits_for_what_comes(self) -> None:
        _, region = new_region()
        region.publish(b"old")
        before = region.sequence
        assert region.read_latest(before) is None
        region.publish(b"new")
        assert region.read_latest(before) == shm.Publication(2, b"new")

    def test_a_region_started_anew_is_news(self) -> None:
        buffer, region = new_region()
        for _ in range(5):
            region.publish(b"old")
        anew = Region.lay_out(buffer, STRIDE, fence=no_fence)
        assert region.read_latest(5) is None
        anew.publish(b"new")
        assert region.read_latest(5) == shm.Publication(1, b"new")

    def test_a_second_writer_goes_on_where_the_first_stopped(self) -> None:
        buffer, region = new_region()
        region.publish(b"one")
        shm.Region(buffer, fence=no_fence).publish(b"two")
        assert region.read_latest() == shm.Publication(2, b"two")

    def test_the_counter_is_64_bits_wide(self) -> None:
        buffer, region = new_region()
        struct.pack_into("<Q", buffer, 16, 2**32 - 1)
        region.publish(b"a")
        assert region.sequence == 2**32
        struct.pack_into("<Q", buffer, 16, 2**64 - 1)
        region.publish(b"a")
        assert region.sequence == 0

    @pytest.mark.parametrize("size", [0, 21])
    def test_a_payload_that_does_not_fit_changes_nothing(self, size: int) -> None:
        buffer, region = new_region()
        region.publish(b"before")
        image = bytes(buffer)
        with pytest.raises(ValueError, match=f"payload of {size} bytes, the slots take 1 to 20"):
            region.publish(bytes(size))
        assert buffer == image

    def test_publishing_needs_a_writable_mapping(self) -> None:
        buffer, _ = new_region()
        with pytest.raises(ValueError, match="mapped read-only"):
            shm.Region(memoryview(buffer).toreadonly(), fence=no_fence).publish(b"x")

    def test_order_of_the_stores(self) -> None:
        buffer = bytearray(shm.region_size(STRIDE))
        seen: list[tuple[bytes, int, int]] = []
        region = Region.lay_out(
            buffer, STRIDE, fence=lambda: seen.append((bytes(buffer[88:95]), buffer[24], buffer[16]))
        )
        seen.clear()
        region.publish(b"abc")
        slot = b"\3\0\0\0abc"
        assert seen == [(slot, 0, 0), (slot, 1, 0), (slot, 1, 1)]


class TestTornReads:
    @given(st.integers(2, 4), st.integers(0, 60), st.lists(st.integers(0, 25), max_size=60))
    def test_a_read_across_any_interleaving_is_whole(self, n_buffers: int, head_start: int, pace: list[int]) -> None:
        buffer, _ = new_region(n_buffers)
        writer = store_by_store(buffer, n_buffers)
        paces = iter(pace)

        def advance(stores: int) -> None:
            for _ in range(stores):
                next(writer)

        def interrupt() -> None:
            advance(next(paces, 0))

        def take(live: memoryview) -> bytes:
            interrupt()
            half = len(live) // 2
            first = bytes(live[:half])
            interrupt()
            return first + bytes(live[half:])

        advance(head_start)
        reader = shm.Region(buffer, fence=interrupt)
        last_seen = 0
        for _ in range(4):
            publication = reader.read_latest(last_seen, take=take)
            if publication is not None:
                # The slot number may be ahead of the count that was read before it.
                possible = range(publication.sequence, publication.sequence + n_buffers)
                assert publication.payload in map(payload_of, possible)
                assert publication.sequence > last_seen
                last_seen = publication.sequence

    @given(st.integers(2, 4), st.integers(1, 4))
    def test_publications_while_copying(self, n_buffers: int, meanwhile: int) -> None:
        _, region = new_region(n_buffers)
        region.publish(b"first")
        copies = 0

        def take(live: memoryview) -> bytes:
            nonlocal copies
            copies += 1
            copy = bytes(live)
            if copies == 1:
                for number in range(meanwhile):
                    region.publish(b"later%d" % number)
            return copy

        publication = region.read_latest(take=take)
        # Only with a slot to spare was the one being copied certainly left alone.
        if meanwhile <= n_buffers - 2:
            assert (publication, copies) == (shm.Publication(1, b"first"), 1)
        else:
            assert (publication, copies) == (shm.Publication(1 + meanwhile, b"later%d" % (meanwhile - 1)), 2)

    def test_a_region_started_anew_while_copying(self) -> None:
        buffer, region = new_region(4)
        for _ in range(9):
            region.publish(b"old")

        def take(live: memoryview) -> bytes:
            copy = bytes(live)
            if copy == b"old":
                Region.lay_out(buffer, STRIDE, 4, fence=no_fence).publish(b"new")
            return copy

        assert region.read_latest(take=take) == shm.Publication(1, b"new")

    def test_a_writer_that_never_rests(self) -> None:
        _, region = new_region()
        region.publish(b"a")
        copies: list[bytes] = []

        def take(live: memoryview) -> bytes:
            copies.append(bytes(live))
            region.publish(b"a")
            return copies[-1]

        assert region.read_latest(take=take) is None
        assert len(copies) == 8
        assert region.sequence != 0

    def test_an_error_over_torn_bytes_is_no_error(self) -> None:
        _, region = new_region()
        region.publish(b"{broken")
        fixed = iter([lambda: region.publish(b'{"a":1}')])

        def take(live: memoryview) -> object:
            copy = bytes(live)
            next(fixed, lambda: None)()
            return msgspec.json.decode(copy)

        assert region.read_latest(take=take) == shm.Publication(2, {"a": 1})

    def test_an_error_over_whole_bytes_is_raised(self) -> None:
        _, region = new_region()
        region.publish(b"{broken")
        with pytest.raises(msgspec.DecodeError):
            region.read_latest(take=msgspec.json.decode)

    def test_a_slot_that_looks_corrupt_only_for_a_moment(self) -> None:
        buffer, _ = new_region()
        repairs: list[Callable[[], None]] = []
        reader = shm.Region(buffer, fence=lambda: repairs.pop()() if repairs else None)
        shm.Region(buffer, fence=no_fence).publish(b"a")
        struct.pack_into("<I", buffer, 64 + STRIDE, 0)
        repairs[:] = [lambda: shm.Region(buffer, fence=no_fence).publish(b"b"), lambda: None, lambda: None]
        assert reader.read_latest() == shm.Publication(2, b"b")


class TestCreateAndAttach:
    def test_not_ready_until_the_last_store(self) -> None:
        buffer = bytearray(shm.region_size(STRIDE))
        region = Region.lay_out(buffer, STRIDE, fence=no_fence)
        region.publish(b"old")
        looks = 0

        def look() -> None:
            nonlocal looks
            looks += 1
            with pytest.raises(shm.RegionNotReady, match="not written yet"):
                shm.Region(buffer, fence=no_fence)

        Region.lay_out(buffer, STRIDE, fence=look)
        assert looks == 2
        assert shm.Region(buffer, fence=no_fence).read_latest() is None

    @given(st.integers(0, 111))
    def test_a_file_that_is_still_growing(self, size: int) -> None:
        buffer, _ = new_region()
        with pytest.raises(shm.RegionNotReady, match=f"{size} bytes, expected"):
            shm.Region(buffer[:size], fence=no_fence)

    def test_a_file_full_of_zeros(self) -> None:
        with pytest.raises(shm.RegionNotReady, match="not written yet"):
            shm.Region(bytearray(112), fence=no_fence)

    def test_bytes_beyond_the_slots_do_not_matter(self) -> None:
        buffer, region = new_region()
        region.publish(b"a")
        assert shm.Region(buffer + b"more", fence=no_fence).read_latest() == shm.Publication(1, b"a")

    @pytest.mark.parametrize(
        ("offset", "value", "problem"),
        [
            (8, 3, "buffer_stride is 3, expected 4 or more"),
            (12, 1, "n_buffers is 1, expected 2 to 64"),
            (12, 65, "n_buffers is 65, expected 2 to 64"),
            (24, 2**32 - 1, "latest_idx is 4294967295, expected below n_buffers"),
        ],
    )
    def test_impossible_fields(self, offset: int, value: int, problem: str) -> None:
        buffer, _ = new_region()
        struct.pack_into("<I", buffer, offset, value)
        with pytest.raises(ProtocolError, match=problem) as caught:
            shm.Region(buffer, fence=no_fence)
        assert not isinstance(caught.value, shm.RegionNotReady)
        assert type(pickle.loads(pickle.dumps(caught.value))) is ProtocolError

    @given(st.binary(max_size=200), st.booleans())
    def test_any_file_is_attached_or_refused(self, image: bytes, plausible: bool) -> None:
        head = struct.pack("<IIII", shm.MAGIC, 1, STRIDE, 2) if plausible else b""
        buffer = bytearray(head + image)
        try:
            region = shm.Region(buffer, fence=no_fence)
            publication = region.read_latest()
        except ProtocolError:
            return
        assert publication is None or 0 < len(publication.payload) <= region.max_payload

    @pytest.mark.parametrize(
        ("offset", "value", "problem"),
        [
            (8, 2**32 - 1, None),
            (12, 64, None),
            (24, 2, "latest_idx is 2, expected below 2"),
            (64 + STRIDE, 2**32 - 1, "slot 1 has a payload of 4294967295 bytes, expected 1 to 20"),
        ],
    )
    def test_a_header_that_changes_later_leads_nowhere(self, offset: int, value: int, problem: str | None) -> None:
        buffer, region = new_region()
        region.publish(b"a")
        struct.pack_into("<I", buffer, offset, value)
        if problem is None:
            assert region.read_latest() == shm.Publication(1, b"a")
        else:
            with pytest.raises(ProtocolError, match=problem):
                region.read_latest()

    def test_between_two_mappings_of_a_file(self, tmp_path: Path) -> None:
        path = tmp_path / shm.STATE_FILE
        path.write_bytes(bytes(shm.region_size(STRIDE)))
        with path.open("r+b") as file:
            ours = mmap.mmap(file.fileno(), 0)
            theirs = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        writer = Region.lay_out(memoryview(ours), STRIDE, fence=no_fence)
        reader = shm.Region(memoryview(theirs), fence=no_fence)
        writer.publish(b"across")
        assert reader.read_latest() == shm.Publication(1, b"across")
        for region, mapping in ((writer, ours), (reader, theirs)):
            with pytest.raises(BufferError):
                mapping.close()
            region.release()
            mapping.close()


class TestSizes:
    def test_defaults_of_the_plugin(self) -> None:
        assert shm.region_size(shm.RPC_STRIDE) == 2_097_216
        assert shm.region_size(16_384) == 32_832
        assert shm.camera_stride(640, 480) == 1_228_804
        assert shm.region_size(shm.camera_stride(640, 480)) == 2_457_672

    @given(st.integers(0, 10**7))
    def test_state_stride(self, snapshot: int) -> None:
        stride = shm.state_stride(snapshot)
        assert stride.bit_count() == 1
        assert stride >= max(16_384, 2 * snapshot)
        assert stride == 16_384 or stride // 2 < 2 * snapshot


class TestFiles:
    def test_camera_file_joins_names_as_they_are(self) -> None:
        assert shm.camera_file("g1_C_0", "head cam") == "cam_g1_C_0_head cam.shm"

    @pytest.mark.parametrize("name", ["", ".", "..", "../x", "a/b", "a\\b", "c:x", "a\0"])
    def test_names_that_lead_elsewhere_are_refused(self, name: str) -> None:
        for names in ((name, "head"), ("g1", name)):
            with pytest.raises(ProtocolError, match="cannot be part of a file name"):
                shm.camera_file(*names)

    def test_directories(self) -> None:
        """Beta statement 98."""
        base = PurePath(Path.cwd().anchor) / "Saved" / "URLabShm"
        session, live = base / "0b1c", base / "live"
        assert shm.region_directories(str(session), shm.STATE_FILE) == (session,)
        for file in (shm.REQUEST_FILE, shm.REPLY_FILE, shm.camera_file("g1", "head")):
            assert shm.region_directories(session, file) == (live, session)
            assert shm.region_directories(f"{live}/", file) == (live,)

    @pytest.mark.parametrize("directory", ["", "live", "./live", "../live"])
    def test_relative_directory(self, directory: str) -> None:
        with pytest.raises(ProtocolError, match="expected an absolute path"):
            shm.region_directories(directory, shm.STATE_FILE)
