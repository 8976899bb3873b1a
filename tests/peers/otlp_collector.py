"""A collector of OpenTelemetry (OTLP over HTTP): parses requests by the definitions of its makers,
and prints each as a JSON line. The first request of each path is refused with 503."""

import argparse
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from opentelemetry.proto.collector.metrics.v1.metrics_service_pb2 import ExportMetricsServiceRequest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from opentelemetry.proto.trace.v1.trace_pb2 import Span

import lifetime


def attributes(of):
    return {one.key: one.value.string_value for one in of}


def points(metric):
    kind = metric.WhichOneof("data")
    for point in getattr(metric, kind).data_points:
        shown = {"attributes": attributes(point.attributes), "time": point.time_unix_nano,
                 "start": point.start_time_unix_nano}
        if kind == "summary":
            quantiles = {str(one.quantile): one.value for one in point.quantile_values}
            yield {**shown, "count": point.count, "quantiles": quantiles}
        else:
            yield {**shown, "value": point.as_int}


def metrics(body):
    request = ExportMetricsServiceRequest.FromString(body)
    for of in request.resource_metrics:
        for scope in of.scope_metrics:
            for metric in scope.metrics:
                yield {"resource": attributes(of.resource.attributes), "metric": metric.name,
                       "unit": metric.unit, "kind": metric.WhichOneof("data"),
                       "monotonic": metric.sum.is_monotonic, "points": list(points(metric))}


def traces(body):
    request = ExportTraceServiceRequest.FromString(body)
    for of in request.resource_spans:
        service = attributes(of.resource.attributes)["service.name"]
        for scope in of.scope_spans:
            for span in scope.spans:
                yield {"service": service, "span": span.name, "trace": span.trace_id.hex(),
                       "id": span.span_id.hex(), "parent": span.parent_span_id.hex(),
                       "kind": Span.SpanKind.Name(span.kind),
                       "nanos": span.end_time_unix_nano - span.start_time_unix_nano,
                       "attributes": attributes(span.attributes)}


PATHS = {"/v1/metrics": metrics, "/v1/traces": traces}


class Collector(BaseHTTPRequestHandler):
    refused = set()

    def do_POST(self):
        body = self.rfile.read(int(self.headers["Content-Length"]))
        status = 200
        if self.path not in self.refused:
            self.refused.add(self.path)
            status = 503
        elif self.headers["Content-Type"] != "application/x-protobuf":
            status = 415
        else:
            lifetime.say(path=self.path, parsed=list(PATHS[self.path](body)))
        self.send_response(status)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, *_):
        pass


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--port", type=int, default=4318)
    parser.add_argument("--limit", type=float, default=120.0)
    args = parser.parse_args()
    lifetime.bound(args.limit)
    server = ThreadingHTTPServer(("127.0.0.1", args.port), Collector)
    lifetime.say(ready=args.port)
    server.serve_forever()


main()
