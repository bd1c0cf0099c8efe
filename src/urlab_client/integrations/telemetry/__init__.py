"""Observers for `URLabClient(observe=…)` that export to OpenTelemetry and Prometheus.

OpenTelemetry requires the extra `opentelemetry`, Prometheus the extra `prometheus`.
"""

from urlab_client.integrations.telemetry.opentelemetry_observer import OpenTelemetryObserver
from urlab_client.integrations.telemetry.prometheus_metrics import PrometheusObserver, PrometheusServerMetrics

__all__ = ["OpenTelemetryObserver", "PrometheusObserver", "PrometheusServerMetrics"]
