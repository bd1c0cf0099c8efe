"""Handlers of the ops that upload a model."""

from __future__ import annotations

from urlab_client.protocol.messages.uploads import (
    UploadModelChunk,
    UploadModelChunkOk,
    UploadModelCommit,
    UploadModelCommitOk,
    UploadModelManifest,
    UploadModelManifestOk,
)
from urlab_client.server.core import ServerCore
from urlab_client.server.refusal import Refusal
from urlab_client.server.rpc.dispatch import handles
from urlab_client.server.rpc.requests import need, usable


@handles(UploadModelManifest)
def upload_model_manifest(server: ServerCore, request: UploadModelManifest) -> UploadModelManifestOk:
    request.xml_sha256 = usable(request.xml_sha256, "")
    for asset in request.assets:
        asset.name, asset.sha256 = usable(asset.name, ""), usable(asset.sha256, "")
        asset.size = usable(asset.size, -1)
    upload_id, need_xml, need_assets = server.uploads.begin(request)
    return UploadModelManifestOk(upload_id=upload_id, need_xml=need_xml, need_assets=need_assets)


@handles(UploadModelChunk)
def upload_model_chunk(server: ServerCore, request: UploadModelChunk) -> UploadModelChunkOk:
    need(request, request.upload_id, "upload_id")
    request.kind, request.data = usable(request.kind, ""), usable(request.data, b"")
    name, received, complete = server.uploads.receive(request)
    return UploadModelChunkOk(name=name, received=received, complete=complete)


@handles(UploadModelCommit)
def upload_model_commit(server: ServerCore, request: UploadModelCommit) -> UploadModelCommitOk:
    with server.uploads.committed(usable(request.upload_id, "")) as (document, step_mode):
        try:
            blueprint = server.world.blueprints.import_uploaded(document)
        except Refusal as refusal:
            raise Refusal("import_failed", refusal.message) from None
    reply = UploadModelCommitOk(
        imported=True,
        blueprint_class_path=blueprint.class_path,
        blueprint_short_name=blueprint.short_name,
        warnings=[],
    )
    running = server.play.current
    if running is not None:
        if step_mode is not None:
            running.engine.set_mode(step_mode)
        with running.engine.lock:
            model = running.scene.model
            reply.nq, reply.nv, reply.nu = model.nq, model.nv, model.nu
            reply.nbody, reply.ngeom = model.nbody, model.ngeom
            reply.mjb = running.mjb()
    return reply
