"""A web server with a bounded number of threads, under the service's page and the viewer."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socket import AF_INET, AF_INET6
from typing import Any

log = logging.getLogger(__name__)


class BoundedServer(ThreadingHTTPServer):
    """A thread for each connection, ``most`` at a time; more are turned away."""

    daemon_threads = True
    block_on_close = False

    def __init__(
        self, address: tuple[str, int], handler: Callable[..., BaseHTTPRequestHandler], most: int
    ) -> None:
        """Raises OSError where nobody can listen at ``address``."""
        self.address_family = AF_INET6 if ":" in address[0] else AF_INET
        self._room = threading.BoundedSemaphore(most)
        super().__init__(address, handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that disconnects during an answer is no error of ours."""
        log.debug("a request failed", exc_info=True)

    def process_request(self, request: Any, client_address: Any) -> None:
        """In the listening thread: start one for the request, if there is room."""
        if not self._room.acquire(blocking=False):
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except BaseException:  # no thread was started that would give the room back
            self._room.release()
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """In the request's own thread."""
        try:
            super().process_request_thread(request, client_address)
        except Exception as error:  # a thread's own traceback would go to the terminal
            log.warning("a request was not answered: %s", error)
        finally:
            self._room.release()
