"""Metrics for Prometheus at `/metrics`."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from starlette.requests import Request
from starlette.responses import Response

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry

__all__ = ["showing"]


def showing(registry: CollectorRegistry) -> Callable[[Request], Response]:
    """Return a handler that serves the metrics of a registry in the requested format."""
    from prometheus_client.exposition import choose_encoder  # noqa: PLC0415

    def show(request: Request) -> Response:
        encode_all, media_type = choose_encoder(request.headers.get("accept", ""))
        return Response(encode_all(registry), headers={"content-type": media_type})

    return show
