"""OpenTelemetry spans of traced requests: one trace per request, from the robot to each replica.

A request's id, which every replica gets, is the trace id. A span's id is derived from it, the step
and the replica, so no context is sent, and the robot and its replicas export independently.
"""

from __future__ import annotations

import atexit
import hashlib
import logging
import os
import time
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from fogft.metrics.outcomes import Outcome

if TYPE_CHECKING:
    from opentelemetry.trace import SpanContext

log = logging.getLogger(__name__)

_KINDS = {"request": "SERVER", "ask": "CLIENT", "replica": "SERVER", "run": "INTERNAL"}
_STEPS = list(_KINDS)  # each is a child of the one before it
_LEFT_MS = 2000  # to send the remaining spans when the process ends
# OpenTelemetry's endpoint variables: https://opentelemetry.io/docs/specs/otel/protocol/exporter/
_WANTED_BY = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")


class Spans:
    """Exports spans over OTLP (HTTP) in the background; spans that cannot be sent are dropped.

    OpenTelemetry's environment variables apply; `process` is the ``service.name`` of its spans.
    """

    def __init__(self, process: str, pool: str) -> None:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor

        self._provider = TracerProvider(
            resource=Resource.create({"service.name": process, "fogft.pool": pool})
        )
        self._batches = BatchSpanProcessor(OTLPSpanExporter())
        atexit.register(self._batches.force_flush, _LEFT_MS)

    def asked(self, requests: Iterable[Mapping[str, Any]]) -> None:
        """Export the robot's side: a span for each request, and one for each replica asked.

        Requests are as `Ledger.trace` keeps them, with ``service`` and times on the wall clock.
        """
        for line in requests:
            service, request = line["service"], bytes.fromhex(line["request"])
            began, ended = line["at"] - line["took_s"], line["at"]
            told = {"fogft.outcome": line["outcome"], "fogft.replica": line["replica"]}
            failed = line["outcome"] != Outcome.ANSWERED.value
            self._export("request", service, request, "", (began, ended), told=told, failed=failed)
            for replica, after_s in line["asked"].items():
                told = {"fogft.refused": line["refused"].get(replica, "")}
                moments = began + after_s, ended
                failed = bool(told["fogft.refused"])
                self._export("ask", service, request, replica, moments, told=told, failed=failed)

    def ran(self, request: bytes, service: str, replica: str, moments: tuple[float, ...]) -> None:
        """Export the replica's side: the request's time there, and its time in the service.

        `moments`: when it arrived, was passed to the service, and was answered; monotonic.
        """
        past_s = time.time() - time.monotonic()
        arrived, begun, ended = (past_s + moment for moment in moments)
        self._export("replica", service, request, replica, (arrived, ended), told={})
        self._export("run", service, request, replica, (begun, ended), told={})

    def _export(
        self,
        step: str,
        service: str,
        request: bytes,
        replica: str,
        moments: tuple[float, float],
        *,
        told: Mapping[str, str],
        failed: bool = False,
    ) -> None:
        from opentelemetry.sdk.trace import ReadableSpan
        from opentelemetry.trace import SpanKind, Status, StatusCode

        trace = int.from_bytes(request, "big")
        decision: Any = self._provider.sampler.should_sample(None, trace, service).decision
        if not decision.is_sampled():
            return
        parent = None
        if step != "request":
            before = _STEPS[_STEPS.index(step) - 1]
            parent = _context(before, request, "" if before == "request" else replica)
        began_ns, ended_ns = (int(moment * 1e9) for moment in moments)
        who = {"fogft.replica": replica} if replica else {}
        self._batches.on_end(
            ReadableSpan(
                name=f"{service} {step}",
                context=_context(step, request, replica),
                parent=parent,
                resource=self._provider.resource,
                attributes={"rpc.system": "ros2", "rpc.service": service, **who, **told},
                kind=SpanKind[_KINDS[step]],
                status=Status(StatusCode.ERROR if failed else StatusCode.UNSET),
                start_time=began_ns,
                end_time=ended_ns,
            )
        )


def _context(step: str, request: bytes, replica: str) -> SpanContext:
    from opentelemetry.trace import SpanContext, TraceFlags

    who = f"{step} {replica}".encode()
    return SpanContext(
        trace_id=int.from_bytes(request, "big"),
        span_id=int.from_bytes(hashlib.blake2b(request + who, digest_size=8).digest(), "big"),
        is_remote=False,
        trace_flags=TraceFlags(TraceFlags.SAMPLED),
    )


def wanted(process: str, pool: str) -> Spans | None:
    """Return an exporter if the environment names an endpoint, else None."""
    if not any(map(os.environ.get, _WANTED_BY)):
        return None
    try:
        return Spans(process, pool)
    except ImportError as error:
        log.error("otel_missing module=%s hint=%r", error.name, "pip install 'fogft[otel]'")
        return None
