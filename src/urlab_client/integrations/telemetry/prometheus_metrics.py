"""Prometheus metrics of the requests of a client or of a simulated server."""

from __future__ import annotations

from typing import TYPE_CHECKING

from urlab_client._extras import need
from urlab_client.integrations.telemetry.durations import DURATIONS_S
from urlab_client.protocol.client_types import CallRecord

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry

    from urlab_client.server import ServedRequest, SimulatedServer

__all__ = ["PrometheusObserver", "PrometheusServerMetrics"]


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
        from prometheus_client import REGISTRY, Counter, Histogram  # noqa: PLC0415

        into = registry or REGISTRY
        prefix = "urlab_client"
        self._requests = Counter(f"{prefix}_requests", "Requests that are over.", ["op", "outcome"], registry=into)
        self._round_trip = Histogram(
            f"{prefix}_round_trip_seconds", "From sending to the reply.", ["op"], registry=into, buckets=DURATIONS_S
        )
        self._queue = Histogram(
            f"{prefix}_queue_seconds", "Wait for other requests.", ["op"], registry=into, buckets=DURATIONS_S
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
        from prometheus_client import REGISTRY, Counter, Gauge, Histogram  # noqa: PLC0415

        into = registry or REGISTRY
        prefix = "urlab_server"
        self._requests = Counter(f"{prefix}_requests", "Requests answered.", ["op", "error"], registry=into)
        self._seconds = Histogram(
            f"{prefix}_request_seconds", "Time to answer.", ["op"], registry=into, buckets=DURATIONS_S
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
