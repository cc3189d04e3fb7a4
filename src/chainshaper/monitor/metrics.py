"""Where the metrics of a watch go: a port of this machine, and an OpenTelemetry collector.

Neither may disturb the watch. Whoever scrapes may be slow, talk nonsense, or come a thousand times;
a collector may not be there, hang or die: that is said in a line, once, and so is that it is back.
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
"""So long a collector that does not answer may keep the end of the watch waiting."""
SCRAPERS = 16
"""Of more connections at a time than these, the one that has been there longest is closed."""
PATIENCE_S = 5  # with a scraper that says nothing
EVERY_MS = 10_000  # metrics are sent
_REASON = re.compile(r"\[Errno -?\d+\] ([^'\")\]]+)|reason: (.+)")  # at its innermost in a message
_LIBRARY = "opentelemetry"


class _Server(ThreadingHTTPServer):
    """A thread for each connection, of which there are a few."""

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
        """Say nothing: that a scraper went away is none of the watch's business."""


@contextlib.contextmanager
def serving(port: int, handler: type[BaseHTTPRequestHandler]) -> Iterator[None]:
    """Answer on a port of this machine. Raises OperationError: it cannot be had."""
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
    """See that metrics can be sent to an address. Raises InputError: it is none of HTTP."""
    with contextlib.suppress(ValueError):  # no such port, or half an address of IPv6
        parts = urlsplit(endpoint)
        if parts.scheme in ("http", "https") and parts.hostname and parts.port != 0:
            return
    raise InputError(
        f"{endpoint!r} is no address of a collector: write one like http://HOST:4318/v1/metrics"
    )


def tell_delivery(exporter: Any, endpoint: str) -> Callable[[], list[str]]:
    """Have an OTLP exporter say when its collector is away and when it is back, instead of what its
    library logs at each attempt; what it gives has what is to be said since the last time.
    """
    reasons, news, export = deque[str](maxlen=1), deque[str](), exporter.export
    arrives = True

    class Listening(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            found = _REASON.search(text := record.getMessage())
            if found or not reasons:  # the last line of an attempt says only that it has failed
                reasons.append(next(filter(None, found.groups())) if found else text)

    def exported(*arguments: Any, **options: Any) -> Any:
        nonlocal arrives
        reasons.clear()
        result = export(*arguments, **options)
        if arrives is not (result.name == "SUCCESS"):
            arrives = not arrives
            why = reasons[0].strip() if reasons else "it does not say why"
            news.append(
                f"metrics arrive at {endpoint} again"
                if arrives
                else f"metrics do not arrive at {endpoint} ({why}): it is tried every ten seconds"
            )
        return result

    exporter.export = exported
    logger = logging.getLogger(_LIBRARY)
    logger.handlers, logger.propagate = [Listening()], False

    def told() -> list[str]:
        return [news.popleft() for _ in range(len(news))]

    return told
