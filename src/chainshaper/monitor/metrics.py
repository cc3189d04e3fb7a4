"""Serve the metrics of a watch on a local port, and send them to an OpenTelemetry collector.

Neither may disturb the watch. A scraper may be slow, send nonsense, or connect a thousand times. A
collector may be absent, hang or die: one line says that it is away, and one that it is back.
"""

import contextlib
import logging
import re
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import urlsplit

from chainshaper.values.errors import InputError, OperationError

LONGEST_END_MS = 3_000
"""A collector that does not answer delays the end of the watch by no more than this."""
SCRAPERS = 16
"""With more connections than these at a time, the oldest is closed."""
PATIENCE_S = 5  # a scraper that sends nothing for longer is disconnected
EVERY_MS = 10_000  # between two sends to the collector
_REASON = re.compile(r"\[Errno -?\d+\] ([^'\")\]]+)|reason: (.+)")
"""The innermost reason in a message of the library."""
_LIBRARY = "opentelemetry"


class _Server(ThreadingHTTPServer):
    """An HTTP server with a thread for each of its few connections."""

    daemon_threads = True
    request_queue_size = 128

    def __init__(self, port: int, handler: type[BaseHTTPRequestHandler]) -> None:
        self._open: deque[socket.socket] = deque()
        self._changing = threading.Lock()
        super().__init__(("127.0.0.1", port), handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        with self._changing:
            self._open.append(request)
            if len(self._open) > SCRAPERS:
                with contextlib.suppress(OSError):  # it has just ended by itself
                    self._open.popleft().shutdown(socket.SHUT_RDWR)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        with self._changing, contextlib.suppress(ValueError):
            self._open.remove(request)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print nothing: a scraper that went away is of no interest to the user of the watch."""


@contextlib.contextmanager
def serving(port: int, handler: type[BaseHTTPRequestHandler]) -> Iterator[None]:
    """Answer requests on a local port. Raises OperationError: the port cannot be opened."""
    patient = type("Scraped", (handler,), {"timeout": PATIENCE_S})
    try:
        server = _Server(port, patient)
    except OSError as error:
        raise OperationError(
            f"port {port} cannot be served ({error.strerror}): name another with --metrics"
        ) from error
    with server:
        threading.Thread(target=server.serve_forever, name="metrics", daemon=True).start()
        try:
            yield
        finally:
            server.shutdown()


def check_endpoint(endpoint: str) -> None:
    """Check the address of a collector. Raises InputError: it is not one of HTTP or HTTPS."""
    with contextlib.suppress(ValueError):  # no such port, or half an address of IPv6
        parts = urlsplit(endpoint)
        if parts.scheme in ("http", "https") and parts.hostname and parts.port != 0:
            return
    raise InputError(
        f"{endpoint!r} is no address of a collector: write one like http://HOST:4318/v1/metrics"
    )


def delivery_news(exporter: Any, endpoint: str) -> Callable[[], list[str]]:
    """Note when the collector of an OTLP exporter goes away and when it is back.

    Returns a function that returns the sentences about it since its last call. They replace what
    the exporter's library logs at each attempt.
    """
    reasons, news, export = deque[str](maxlen=1), deque[str](), exporter.export
    arrives = True

    class Listening(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            text = record.getMessage()
            match = _REASON.search(text)
            if match is not None:
                reasons.append(match[1] or match[2])
            elif not reasons:  # the last line of an attempt says only that it has failed
                reasons.append(text)

    def exported(*arguments: Any, **options: Any) -> Any:
        nonlocal arrives
        reasons.clear()
        result = export(*arguments, **options)
        if arrives is not (result.name == "SUCCESS"):
            arrives = not arrives
            reason = reasons[0].strip() if reasons else "it does not say why"
            if arrives:
                news.append(f"metrics arrive at {endpoint} again")
            else:
                retry = "it is tried every ten seconds"
                news.append(f"metrics do not arrive at {endpoint} ({reason}): {retry}")
        return result

    exporter.export = exported
    logger = logging.getLogger(_LIBRARY)
    logger.handlers, logger.propagate = [Listening()], False

    def take_news() -> list[str]:
        return [news.popleft() for _ in range(len(news))]

    return take_news
