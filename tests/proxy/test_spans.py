"""A collector of OpenTelemetry gets one trace a request: robot, links and replicas, in order."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from opentelemetry.proto.trace.v1.trace_pb2 import Span

from tests.bench.caller import Caller, payloads
from tests.bench.nodes.service import FLAG, MAP
from tests.proxy.by_hand import ROOT, Parts, wait_for

pytestmark = [pytest.mark.ros, pytest.mark.timeout(180)]

NODE = ROOT / "tests/bench/nodes/service.py"
REQUESTS = 3


class Collector:
    """Takes what is sent over OTLP (HTTP, protobuf)."""

    def __init__(self) -> None:
        self.spans: list[tuple[str, Span]] = []  # with the process's kind
        spans = self.spans

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                for sent in ExportTraceServiceRequest.FromString(body).resource_spans:
                    told = {one.key: one.value.string_value for one in sent.resource.attributes}
                    for scope in sent.scope_spans:
                        spans.extend((told["service.name"], span) for span in scope.spans)
                self.send_response(200)
                self.end_headers()

            def log_message(self, *_: object) -> None:
                """Say nothing."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        self.endpoint = f"http://127.0.0.1:{self._server.server_address[1]}"

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


@pytest.fixture
def collector(monkeypatch: pytest.MonkeyPatch) -> Iterator[Collector]:
    made = Collector()
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", made.endpoint)
    monkeypatch.setenv("OTEL_BSP_SCHEDULE_DELAY", "200")  # milliseconds
    yield made
    made.close()


def test_a_request_is_one_trace_from_the_robot_to_each_replica(
    collector: Collector, tmp_path: Path, ros_domains: Callable[[], int]
) -> None:
    name, type_name = FLAG
    services = f"[{{name: {name}, type: {type_name}, hedging: all, trace: true}}, "
    services += f"{{name: {MAP[0]}, type: {MAP[1]}}}]"
    parts = Parts(tmp_path, ros_domains, services=services, node=NODE)
    caller = None
    try:
        replicas = [parts.replica(slot) for slot in range(2)]
        robot = parts.robot("robot", *replicas)
        wait_for(lambda: [len(one["ready"]) for one in robot.links()] == [2, 2], "both replicas")
        caller = Caller(robot.domain, "spans")
        caller.wait()
        caller.call(name, payloads()[name])

        def whole() -> dict[bytes, list[tuple[str, Span]]]:
            traces = defaultdict(list)
            for kind, span in collector.spans:
                traces[span.trace_id].append((kind, span))
            done = {id: spans for id, spans in traces.items() if len(spans) == 7}
            if len(done) < REQUESTS:  # a copy that lags is dropped: it has no span of the run
                caller.call(name, payloads()[name])
            return done if len(done) >= REQUESTS else {}

        for spans in wait_for(whole, "all spans").values():
            by_id = {span.span_id: span for _, span in spans}
            assert len(by_id) == 7
            tree = sorted((kind, *way(span, by_id)) for kind, span in spans)
            root = f"{name} request"
            assert tree == sorted(
                [
                    ("fogft-robot", root),
                    *[("fogft-robot", root, f"{name} ask {slot}.1") for slot in (0, 1)],
                    *[
                        ("fogft-replica", root, f"{name} ask {slot}.1", f"{name} replica {slot}.1")
                        for slot in (0, 1)
                    ],
                    *[
                        (
                            *("fogft-replica", root, f"{name} ask {slot}.1"),
                            *(f"{name} replica {slot}.1", f"{name} run {slot}.1"),
                        )
                        for slot in (0, 1)
                    ],
                ]
            )
            assert all(one.start_time_unix_nano <= one.end_time_unix_nano for _, one in spans)
        assert not (tmp_path / "trace.jsonl").exists()
    finally:
        if caller is not None:
            caller.close()
        parts.close()


def way(span: Span, by_id: dict[bytes, Span]) -> list[str]:
    """Return the names from the root to a span, with the replica that it is about."""
    told = {one.key: one.value.string_value for one in span.attributes}
    replica = told.get("fogft.replica", "") if span.parent_span_id else ""
    before = way(by_id[span.parent_span_id], by_id) if span.parent_span_id else []
    return [*before, f"{span.name} {replica}".strip()]
