"""OpenTelemetry spans of traced requests: one trace a request, from the robot to each replica.

A request's id, which every replica is given, is the trace's. A span's id follows from it and from
who makes the span, so nothing is sent with a request, and the robot and its replicas report apart.

Not here: when requests began and ended (`fogft.proxy`).
"""

from __future__ import annotations

import atexit
import hashlib
import logging
import os
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from fogft.metrics.outcomes import Outcome

if TYPE_CHECKING:
    from opentelemetry.trace import SpanContext, SpanKind

log = logging.getLogger(__name__)

_STEPS = ("request", "ask", "replica", "run")
_LEFT_MS = 2000  # for what is not sent yet when the process ends
# OpenTelemetry's own: where to send to. https://opentelemetry.io/docs/specs/otel/protocol/exporter/
_WANTED_BY = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")


class Spans:
    """Exports spans over OTLP (HTTP) in the background; spans that cannot be sent are dropped.

    OpenTelemetry's environment variables apply: the endpoint, its headers, the sampler.

    Args:
        process: Its kind, as the ``service.name`` of its spans.
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

        Args:
            requests: As `Outcomes.note` has them, with ``service``; moments on the wall clock.
        """
        from opentelemetry.trace import SpanKind

        for line in requests:
            began, ended = line["at"] - line["took_s"], line["at"]
            self._export(
                _Span(line["service"], bytes.fromhex(line["request"])),
                SpanKind.SERVER,
                (began, ended),
                {"fogft.outcome": line["outcome"], "fogft.replica": line["replica"]},
                failed=line["outcome"] != Outcome.ANSWERED.value,
            )
            for replica, after_s in line["asked"].items():
                refused = line["refused"].get(replica, "")
                self._export(
                    _Span(line["service"], bytes.fromhex(line["request"]), replica, "ask"),
                    SpanKind.CLIENT,
                    (began + after_s, ended),
                    {"fogft.refused": refused},
                    failed=bool(refused),
                )

    def ran(self, request: bytes, service: str, replica: str, moments: tuple[float, ...]) -> None:
        """Export the replica's side: the request's time there, and its time in the service.

        Args:
            moments: When it arrived, was passed on to the service, and was answered; monotonic.
        """
        from opentelemetry.trace import SpanKind

        past_s = time.time() - time.monotonic()
        arrived, begun, ended = (past_s + moment for moment in moments)
        stay = _Span(service, request, replica, "replica")
        self._export(stay, SpanKind.SERVER, (arrived, ended), {})
        run = _Span(service, request, replica, "run")
        self._export(run, SpanKind.INTERNAL, (begun, ended), {})

    def _export(
        self,
        span: _Span,
        kind: SpanKind,
        moments: tuple[float, float],
        told: Mapping[str, str],
        *,
        failed: bool = False,
    ) -> None:
        from opentelemetry.sdk.trace import ReadableSpan
        from opentelemetry.trace import Status, StatusCode

        trace = int.from_bytes(span.request, "big")
        decision: Any = self._provider.sampler.should_sample(None, trace, span.service).decision
        if not decision.is_sampled():
            return
        began_ns, ended_ns = (int(moment * 1e9) for moment in moments)
        who = {"fogft.replica": span.replica} if span.replica else {}
        self._batches.on_end(
            ReadableSpan(
                name=f"{span.service} {span.step}",
                context=span.context(),
                parent=span.parent(),
                resource=self._provider.resource,
                attributes={"rpc.system": "ros2", "rpc.service": span.service, **who, **told},
                kind=kind,
                status=Status(StatusCode.ERROR if failed else StatusCode.UNSET),
                start_time=began_ns,
                end_time=ended_ns,
            )
        )


@dataclass(frozen=True)
class _Span:
    """Which span it is: each step of a request is within the one before it."""

    service: str
    request: bytes
    replica: str = ""
    step: str = _STEPS[0]

    def context(self) -> SpanContext:
        from opentelemetry.trace import SpanContext, TraceFlags

        who = f"{self.step} {self.replica}".encode()
        return SpanContext(
            trace_id=int.from_bytes(self.request, "big"),
            span_id=int.from_bytes(
                hashlib.blake2b(self.request + who, digest_size=8).digest(), "big"
            ),
            is_remote=False,
            trace_flags=TraceFlags(TraceFlags.SAMPLED),
        )

    def parent(self) -> SpanContext | None:
        before = _STEPS.index(self.step) - 1
        if before < 0:
            return None
        replica = self.replica if before else ""
        return replace(self, replica=replica, step=_STEPS[before]).context()


def wanted(process: str, pool: str) -> Spans | None:
    """Return an exporter if the environment names an endpoint, else None."""
    if not any(map(os.environ.get, _WANTED_BY)):
        return None
    try:
        return Spans(process, pool)
    except ImportError as error:
        log.error("otel_missing module=%s hint=%r", error.name, "pip install 'fogft[otel]'")
        return None
