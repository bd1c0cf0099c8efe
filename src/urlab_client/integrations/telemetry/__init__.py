"""What a client does, in OpenTelemetry and in Prometheus: observers for `URLabClient(observe=…)`.

OpenTelemetry needs the extra `opentelemetry`, Prometheus the extra `prometheus`.
"""

from urlab_client.integrations.telemetry.opentelemetry_observer import OpenTelemetryObserver
from urlab_client.integrations.telemetry.prometheus_metrics import PrometheusObserver, PrometheusServerMetrics

__all__ = ["OpenTelemetryObserver", "PrometheusObserver", "PrometheusServerMetrics"]
