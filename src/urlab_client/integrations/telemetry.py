"""Observers for `URLabClient(observe=…)` that export to OpenTelemetry and Prometheus.

OpenTelemetry requires the extra `opentelemetry`, Prometheus the extra `prometheus`. Spans and metrics of OpenTelemetry
follow its semantic conventions for RPC.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from urlab_client._installation import need
from urlab_client.aio.client_types import CallOutcome, CallRecord

if TYPE_CHECKING:
    from opentelemetry.metrics import MeterProvider
    from opentelemetry.trace import TracerProvider
    from prometheus_client import CollectorRegistry

    from urlab_client.server import ServedRequest, SimulatedServer

__all__ = ["OpenTelemetryObserver", "PrometheusObserver", "PrometheusServerMetrics"]

_SCOPE: Final = "urlab_client"
_SYSTEM: Final = "urlab"
_DURATIONS_S: Final = (
    1e-4, 2.5e-4, 5e-4, 1e-3, 2.5e-3, 5e-3, 1e-2, 2.5e-2, 5e-2, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 60.0,
)  # fmt: skip
"""Upper limits of the buckets of durations, seconds: a step takes tenths of a millisecond, an import minutes."""


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
        from opentelemetry import metrics, trace

        self._trace = trace
        self._tracer = trace.get_tracer(_SCOPE, tracer_provider=tracer_provider)
        meter = metrics.get_meter(_SCOPE, meter_provider=meter_provider)
        waits = partial(meter.create_histogram, unit="s", explicit_bucket_boundaries_advisory=_DURATIONS_S)
        self._duration = waits(
            "rpc.client.call.duration", description="Duration of requests, with the wait for other requests."
        )
        self._queued = waits(
            "urlab.client.queue.duration", description="Wait of requests for other requests of the same client."
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


class PrometheusObserver:
    """Counts the requests of clients: `URLabClient(…, observe=PrometheusObserver())`.

    The metrics are `urlab_client_requests_total` by op and outcome, and by op `urlab_client_round_trip_seconds` and
    `urlab_client_queue_seconds`, `urlab_client_sent_bytes_total` and `urlab_client_received_bytes_total`. One observer
    may serve many clients.

    Args:
        registry: Registry of the metrics; by default the global one.

    Raises:
        MissingExtra: `prometheus_client` is not installed.
        ValueError: The registry already has these metrics; share the observer.
    """

    def __init__(self, registry: CollectorRegistry | None = None) -> None:
        need("prometheus_client", extra="prometheus")
        from prometheus_client import REGISTRY, Counter, Histogram

        into = registry or REGISTRY
        prefix = "urlab_client"
        self._requests = Counter(f"{prefix}_requests", "Requests that are over.", ["op", "outcome"], registry=into)
        self._round_trip = Histogram(
            f"{prefix}_round_trip_seconds", "From sending to the reply.", ["op"], registry=into, buckets=_DURATIONS_S
        )
        self._queue = Histogram(
            f"{prefix}_queue_seconds", "Wait for other requests.", ["op"], registry=into, buckets=_DURATIONS_S
        )
        self._sent = Counter(f"{prefix}_sent_bytes", "Size of requests.", ["op"], registry=into)
        self._received = Counter(f"{prefix}_received_bytes", "Size of replies.", ["op"], registry=into)

    def __call__(self, record: CallRecord) -> None:
        """Record a request."""
        op = record.op
        self._requests.labels(op, str(record.outcome)).inc()
        self._queue.labels(op).observe(record.queued_s)
        if record.sent_bytes:
            self._round_trip.labels(op).observe(record.round_trip_s)
            self._sent.labels(op).inc(record.sent_bytes)
            self._received.labels(op).inc(record.received_bytes)


class PrometheusServerMetrics:
    """Counts the requests of a simulated server.

    The metrics are `urlab_server_requests_total` by op and error code (empty on success), and by op
    `urlab_server_request_seconds`, `urlab_server_request_bytes_total` and `urlab_server_reply_bytes_total`. Read on
    scrape: `urlab_server_playing`, `urlab_server_simulation_seconds` and `urlab_server_healthy`.

    Args:
        server: The started server; its requests are counted until it is closed.
        registry: Registry of the metrics; by default the global one.

    Raises:
        MissingExtra: `prometheus_client` is not installed.
        ValueError: The registry already has these metrics.
        RuntimeError: The server is closed.
    """

    def __init__(self, server: SimulatedServer, registry: CollectorRegistry | None = None) -> None:
        need("prometheus_client", extra="prometheus")
        from prometheus_client import REGISTRY, Counter, Gauge, Histogram

        into = registry or REGISTRY
        prefix = "urlab_server"
        self._requests = Counter(f"{prefix}_requests", "Requests answered.", ["op", "error"], registry=into)
        self._seconds = Histogram(
            f"{prefix}_request_seconds", "Time to answer.", ["op"], registry=into, buckets=_DURATIONS_S
        )
        self._asked = Counter(f"{prefix}_request_bytes", "Size of requests.", ["op"], registry=into)
        self._answered = Counter(f"{prefix}_reply_bytes", "Size of replies.", ["op"], registry=into)
        playing = Gauge(f"{prefix}_playing", "1 while a play session runs.", registry=into)
        playing.set_function(lambda: float(server.sim_time is not None))
        simulated = Gauge(f"{prefix}_simulation_seconds", "Simulation time of the play session.", registry=into)
        simulated.set_function(lambda: server.sim_time or 0.0)
        healthy = Gauge(f"{prefix}_healthy", "1 while all threads of the server run.", registry=into)
        healthy.set_function(lambda: float(server.failure is None))
        server.add_request_callback(self._count)

    def _count(self, served: ServedRequest) -> None:
        self._requests.labels(served.op, served.error).inc()
        self._seconds.labels(served.op).observe(served.seconds)
        self._asked.labels(served.op).inc(served.request_bytes)
        self._answered.labels(served.op).inc(served.reply_bytes)
