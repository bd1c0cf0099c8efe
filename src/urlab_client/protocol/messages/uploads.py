"""Ops that upload a model to the server: the manifest, the missing chunks, the import."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Final

from msgspec import Struct, field

from urlab_client.protocol.base import Int32, Needs, Op, Reply, Request, doc
from urlab_client.values.plain import Serializable

MAX_BLOB_BYTES: Final = 64 << 20
MAX_MODEL_BYTES: Final = 512 << 20
MAX_ASSETS: Final = 4096
MAX_CHUNK_BYTES: Final = 4 << 20


class AssetDigest(Serializable, Struct, kw_only=True):
    """One file of a model."""

    name: Annotated[str, doc("Bare file name, as in the document.")]
    sha256: Annotated[str, doc("64 lower-case hexadecimal digits.")]
    size: Annotated[int, doc("Bytes.")]


class UploadModelManifestOk(Reply, tag="upload_model_manifest_ok", kw_only=True):
    """The open upload, and the files that the server lacks."""

    upload_id: Annotated[str, doc("Id of the upload.")]
    need_xml: Annotated[bool, doc("Whether the document must be sent.")]
    need_assets: Annotated[list[str], doc("Names of the files that must be sent.")]
    max_asset_bytes: Annotated[int, doc("Maximum size of a file, bytes.")] = MAX_BLOB_BYTES
    max_total_bytes: Annotated[int, doc("Maximum size of a model, bytes.")] = MAX_MODEL_BYTES


class UploadModelManifest(Request[UploadModelManifestOk], tag="upload_model_manifest", kw_only=True):
    """Announce the files of a model."""

    xml_sha256: Annotated[str, doc("Hash of the document: 64 lower-case hexadecimal digits.")]
    total_bytes: Annotated[int, doc("Bytes of the document and its files.")] = 0
    assets: Annotated[list[AssetDigest], doc("Its files.")] = field(default_factory=list[AssetDigest])
    step_mode: Annotated[str | None, doc("Step mode to enter with the commit, during play.")] = None


class UploadModelChunkOk(Reply, tag="upload_model_chunk_ok", kw_only=True):
    """How much of a file has arrived."""

    name: Annotated[str, doc("Name of the file; `<xml>` for the document.")]
    received: Annotated[int, doc("Bytes received.")]
    complete: Annotated[bool, doc("Whether the file is complete and its hash matches.")]


class UploadModelChunk(
    Request[UploadModelChunkOk],
    tag="upload_model_chunk",
    kw_only=True,
    forbid_unknown_fields=True,
):
    """Send a chunk of a file."""

    upload_id: Annotated[str, doc("Id of the upload.")]
    kind: Annotated[str, doc("`xml` or `asset`.")]
    name: Annotated[str, doc("Name of the asset.")] = ""
    offset: Annotated[Int32, doc("Offset of the chunk, bytes.")] = 0
    total: Annotated[Int32, doc("Size of the whole file, bytes.")] = 0
    data: Annotated[bytes, doc("Content of the chunk.")]


class UploadModelCommitOk(Reply, tag="upload_model_commit_ok", kw_only=True, omit_defaults=True):
    """The blueprint made from the model. Sizes are those of the running model, if any."""

    imported: Annotated[bool, doc("True.")]
    blueprint_class_path: Annotated[str, doc("Class path for `spawn_actor`.")] = ""
    blueprint_short_name: Annotated[str, doc("Asset name.")] = ""
    nq: Annotated[int | None, doc("`mjModel.nq` of the running model.")] = None
    nv: Annotated[int | None, doc("`mjModel.nv`.")] = None
    nu: Annotated[int | None, doc("`mjModel.nu`.")] = None
    nbody: Annotated[int | None, doc("`mjModel.nbody`.")] = None
    ngeom: Annotated[int | None, doc("`mjModel.ngeom`.")] = None
    mjb: Annotated[bytes | None, doc("The running model in MuJoCo's binary format.")] = None
    warnings: Annotated[list[str] | None, doc("Warnings; servers send none so far.")] = None


class UploadModelCommit(Request[UploadModelCommitOk], tag="upload_model_commit", kw_only=True):
    """Import a completely uploaded model."""

    upload_id: Annotated[str, doc("Id of the upload.")]


_upload_op = partial(Op, ns="scene", needs=Needs.NOTHING, dialects=("beta",))

OPS: Final = (
    _upload_op(
        request=UploadModelManifest,
        errors=("payload_too_large",),
        declares=(
            "op:string",
            "upload_id:string",
            "need_xml:bool",
            "need_assets:array",
            "max_asset_bytes:int",
            "max_total_bytes:int",
        ),
    ),
    _upload_op(
        request=UploadModelChunk,
        timeout=60.0,
        hot=True,
        errors=("payload_too_large", "unknown_upload", "hash_mismatch"),
        undeclared=("data",),
    ),
    _upload_op(
        request=UploadModelCommit,
        timeout=600.0,
        errors=("unknown_upload", "import_failed"),
        declares=(
            "op:string",
            "imported:bool",
            "nq:int?",
            "nv:int?",
            "nu:int?",
            "nbody:int?",
            "ngeom:int?",
            "mjb:object?",
            "warnings:array",
        ),
    ),
)
