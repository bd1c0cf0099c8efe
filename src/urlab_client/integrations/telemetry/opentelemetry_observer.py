"""Requests as OpenTelemetry spans and metrics, named by its semantic conventions for RPC."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from urlab_client._extras import need
from urlab_client.integrations.telemetry.durations import DURATIONS_S
from urlab_client.protocol.client_types import CallOutcome, CallRecord

if TYPE_CHECKING:
    from opentelemetry.metrics import MeterProvider
    from opentelemetry.trace import TracerProvider

__all__ = ["OpenTelemetryObserver"]

_SCOPE: Final = "urlab_client"
_SYSTEM: Final = "urlab"


class OpenTelemetryObserver:
    """Creates a span and measurements for each request: `URLabClient(…, observe=OpenTelemetryObserver())`.

    Spans have the kind `CLIENT` and the name of the op, last from the request to its reply, and are children of the
    span that is current when the call is made. The metrics are `rpc.client.call.duration`,
    `urlab.client.queue.duration`, in seconds, `urlab.client.request.size` and `urlab.client.response.size`, in bytes.
    The providers decide what is exported, and how many spans are sampled at a thousand steps per second.

    Args:
        tracer_provider: Provider of spans; by default the global one.
        meter_provider: Provider of metrics; by default the global one.

    Raises:
        MissingExtra: OpenTelemetry is not installed.
    """

    def __init__(
        self, *, tracer_provider: TracerProvider | None = None, meter_provider: MeterProvider | None = None
    ) -> None:
        need("opentelemetry", extra="opentelemetry")
        from opentelemetry import metrics, trace  # noqa: PLC0415

        self._trace = trace
        self._tracer = trace.get_tracer(_SCOPE, tracer_provider=tracer_provider)
        meter = metrics.get_meter(_SCOPE, meter_provider=meter_provider)
        self._duration = meter.create_histogram(
            "rpc.client.call.duration",
            "s",
            "Duration of requests, with the wait for other requests.",
            explicit_bucket_boundaries_advisory=DURATIONS_S,
        )
        self._queued = meter.create_histogram(
            "urlab.client.queue.duration",
            "s",
            "Wait of requests for other requests of the same client.",
            explicit_bucket_boundaries_advisory=DURATIONS_S,
        )
        self._sent = meter.create_histogram("urlab.client.request.size", "By", "Size of requests.")
        self._received = meter.create_histogram("urlab.client.response.size", "By", "Size of replies.")
        self._servers: dict[str, dict[str, str | int]] = {}

    def __call__(self, record: CallRecord) -> None:
        """Record a request."""
        about: dict[str, str | int] = {
            "rpc.system.name": _SYSTEM,
            "rpc.method": record.op,
            **self._server(record.endpoint),
        }
        if record.error:
            about["error.type"] = record.error
        if record.outcome is CallOutcome.REFUSED:
            about["rpc.response.status_code"] = record.error
        seconds = record.queued_s + record.round_trip_s
        self._duration.record(seconds, about)
        self._queued.record(record.queued_s, about)
        if record.sent_bytes:
            self._sent.record(record.sent_bytes, about)
        if record.received_bytes:
            self._received.record(record.received_bytes, about)
        span = self._tracer.start_span(
            record.op,
            kind=self._trace.SpanKind.CLIENT,
            attributes={
                **about,
                "urlab.queue.duration": record.queued_s,
                "urlab.request.size": record.sent_bytes,
                "urlab.response.size": record.received_bytes,
            },
            start_time=record.started_ns,
        )
        if record.outcome is not CallOutcome.OK:
            span.set_status(self._trace.StatusCode.ERROR, str(record.outcome))
        span.end(record.started_ns + int(1e9 * seconds))

    def _server(self, endpoint: str) -> dict[str, str | int]:
        known = self._servers.get(endpoint)
        if known is None:
            address = urlsplit(endpoint)
            known = self._servers[endpoint] = {"server.address": address.hostname or address.path or endpoint}
            if address.scheme == "tcp" and address.port is not None:
                known["server.port"] = address.port
        return known
