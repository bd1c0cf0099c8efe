"""What clients and servers do, in OpenTelemetry and in Prometheus, read back with their own libraries."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from children import child
from opentelemetry.sdk.metrics import MeterProvider
from opentelemetry.sdk.metrics.export import InMemoryMetricReader
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from opentelemetry.trace import SpanKind, StatusCode
from prometheus_client import CollectorRegistry
from prometheus_client.parser import text_string_to_metric_families
from starlette.testclient import TestClient

import urlab_client
import urlab_client.aio
from urlab_client.errors import UnknownKeyframe
from urlab_client.integrations.telemetry import OpenTelemetryObserver, PrometheusObserver, PrometheusServerMetrics
from urlab_client.protocol.messages.session import Reset
from urlab_client.server import ServedRequest, SimulatedServer
from urlab_client.web import Access, app, apps


@pytest.fixture(scope="module")
def server() -> Iterator[SimulatedServer]:
    with SimulatedServer("arm", play=True) as running:
        yield running


def points(reader: InMemoryMetricReader) -> dict[str, Any]:
    """Return the data points of all metrics, by name."""
    data: Any = reader.get_metrics_data()
    metrics = (metric for each in data.resource_metrics for scope in each.scope_metrics for metric in scope.metrics)
    return {metric.name: (metric.unit, list(metric.data.data_points)) for metric in metrics}


@pytest.mark.parametrize("flavour", ["blocking", "async"])
async def test_requests_are_spans_of_the_span_they_are_made_in_and_are_measured(
    server: SimulatedServer, flavour: str
) -> None:
    spans, reader = InMemorySpanExporter(), InMemoryMetricReader()
    tracing = TracerProvider()
    tracing.add_span_processor(SimpleSpanProcessor(spans))
    observer = OpenTelemetryObserver(tracer_provider=tracing, meter_provider=MeterProvider([reader]))
    options = server.client_options() | {"step_mode": "direct", "observe": observer}
    with tracing.get_tracer("test").start_as_current_span("episode") as episode:
        if flavour == "blocking":
            with urlab_client.URLabClient(**options) as client:
                client.discover()
                client.step()
                with pytest.raises(UnknownKeyframe):
                    client.call(Reset(keyframe_name="nonsense"))
        else:
            async with urlab_client.aio.URLabClient(**options) as asynchronous:
                await asynchronous.discover()
                await asynchronous.step()
                with pytest.raises(UnknownKeyframe):
                    await asynchronous.call(Reset(keyframe_name="nonsense"))

    made = {span.name: span for span in spans.get_finished_spans()}
    step, reset = made["step"], made["reset"]
    assert step.kind is SpanKind.CLIENT
    assert step.parent is not None
    assert step.parent.span_id == episode.get_span_context().span_id
    about = dict(step.attributes or {})
    assert about["rpc.system.name"] == "urlab"
    assert about["rpc.method"] == "step"
    assert (about["server.address"], about["server.port"]) == ("127.0.0.1", server.step_port)
    assert about["urlab.response.size"] > 0  # type: ignore[operator]
    assert (step.end_time or 0) > (step.start_time or 0)
    assert step.status.status_code is StatusCode.UNSET
    assert reset.status.status_code is StatusCode.ERROR
    assert dict(reset.attributes or {})["rpc.response.status_code"] == "unknown_keyframe"
    assert dict(reset.attributes or {})["error.type"] == "unknown_keyframe"

    measured = points(reader)
    unit, calls = measured["rpc.client.call.duration"]
    assert unit == "s"
    step_calls = [point for point in calls if point.attributes["rpc.method"] == "step"]
    assert [point.count for point in step_calls] == [1]
    assert 0 < step_calls[0].sum < 60
    assert {"urlab.client.queue.duration", "urlab.client.request.size", "urlab.client.response.size"} < measured.keys()


def samples(text: str) -> dict[tuple[str, tuple[str, ...]], float]:
    """Return what Prometheus reads in a text: values by name, and the labels' values in the order of their names."""
    return {
        (one.name, tuple(value for _, value in sorted(one.labels.items()))): one.value
        for family in text_string_to_metric_families(text)
        for one in family.samples
    }


def test_the_console_shows_the_metrics_of_its_client_to_those_who_may_come_in(server: SimulatedServer) -> None:
    registry = CollectorRegistry()
    with urlab_client.URLabClient(**server.client_options(), observe=PrometheusObserver(registry)) as client:
        client.discover()
        client.meta()
    site = app(urlab_client.aio.URLabClient(), access=Access(), metrics=registry)
    with_no_lifespan = TestClient(site, base_url="http://localhost")
    assert with_no_lifespan.get("/metrics").status_code == 401
    key = site.state.access.admit(site.state.access.invite())
    answer = with_no_lifespan.get("/metrics", headers={"authorization": f"Bearer {key}"})
    assert answer.headers["content-type"].startswith("text/plain; version=")
    read = samples(answer.text)
    assert read["urlab_client_requests_total", ("meta", "ok")] == 2
    assert read["urlab_client_received_bytes_total", ("hello",)] > 1000
    assert read["urlab_client_round_trip_seconds_count", ("meta",)] == 2
    assert read["urlab_client_queue_seconds_sum", ("meta",)] == 0
    for root, metrics in ((site, registry), (app(urlab_client.aio.URLabClient(), access=Access(tokens=False)), None)):
        http = TestClient(root, base_url="http://localhost", headers={"authorization": f"Bearer {key}"})
        paths = http.get("/api/openapi.json").json()["paths"]
        assert ("/metrics" in paths) == (metrics is not None) == (http.get("/metrics").status_code == 200)
    several = apps({"one": urlab_client.aio.URLabClient()}, access=site.state.access, metrics=registry)
    http = TestClient(several, base_url="http://localhost")
    assert http.get("/metrics").status_code == 401
    assert http.get("/metrics", headers={"authorization": f"Bearer {key}"}).text == answer.text


def test_a_server_counts_what_it_answers_and_bears_callbacks_that_fail(
    server: SimulatedServer, caplog: pytest.LogCaptureFixture
) -> None:
    from prometheus_client import generate_latest

    def broken(served: ServedRequest) -> None:
        raise RuntimeError

    registry = CollectorRegistry()
    server.add_request_callback(broken)
    PrometheusServerMetrics(server, registry)
    with urlab_client.URLabClient(**server.client_options(), step_mode="direct") as client:
        client.discover()
        client.step(3)
        with pytest.raises(UnknownKeyframe):
            client.call(Reset(keyframe_name="nonsense"))
        read = samples(generate_latest(registry).decode())
        assert read["urlab_server_requests_total", ("", "step")] == 1
        assert read["urlab_server_requests_total", ("unknown_keyframe", "reset")] == 1
        assert read["urlab_server_reply_bytes_total", ("step",)] > 0
        assert read["urlab_server_playing", ()] == 1
        assert read["urlab_server_simulation_seconds", ()] == pytest.approx(client.sim_time)
        assert read["urlab_server_healthy", ()] == 1
    assert "failed on a request of step" in caplog.text


def test_urlab_serve_has_metrics_on_a_port_of_their_own() -> None:
    import urllib.request

    command = ["-m", "urlab_client", "serve", "ball", "--json", "--until-eof", "--metrics-port", "0"]
    command += [f"--{name}-port=0" for name in ("step", "state", "ctrl", "info", "camera")]
    with child(*command, stderr=None) as process:
        assert process.stdout is not None
        ready = json.loads(process.stdout.readline())
        with urllib.request.urlopen(f"http://127.0.0.1:{ready['metrics_port']}/metrics", timeout=30) as page:
            read = samples(page.read().decode())
        assert read["urlab_server_healthy", ()] == 1
        assert read["urlab_server_playing", ()] == 0
        process.communicate("", timeout=30)
    assert process.returncode == 0
