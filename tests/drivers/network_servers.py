"""What stands on a vehicle's network, on sockets of this computer: servers that answer as told."""

from __future__ import annotations

import itertools
import json
import socket
import struct
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

HOST = "127.0.0.1"
Answer = Callable[[bytes], bytes]
"""What a server says when it has heard these bytes; nothing: it goes on listening."""


@contextmanager
def tcp_server(answer: Answer, greeting: bytes = b"") -> Iterator[int]:
    """Its port; it says the greeting to every client, answers once, and closes."""
    with socket.create_server((HOST, 0)) as server:
        server.settimeout(0.05)
        ending = threading.Event()

        def serve() -> None:
            while not ending.is_set():
                try:
                    client, _ = server.accept()
                except TimeoutError:
                    continue
                with client:
                    _converse(client, answer, greeting, ending)

        with _running(serve, ending):
            yield int(server.getsockname()[1])


def _converse(
    client: socket.socket, answer: Answer, greeting: bytes, ending: threading.Event
) -> None:
    client.settimeout(0.05)
    heard, said = b"", b""
    try:
        client.sendall(greeting)
        while not said and not ending.is_set():
            try:
                data = client.recv(4096)
            except TimeoutError:
                continue
            if not data:
                return
            heard += data
            said = answer(heard)
        client.sendall(said)
    except OSError:
        return  # the other end has heard enough


@contextmanager
def udp_answerer(answer: Answer) -> Iterator[int]:
    """The port of something that answers datagrams, where a multicast group would be."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind((HOST, 0))
        listener.settimeout(0.05)
        ending = threading.Event()

        def serve() -> None:
            while not ending.is_set():
                try:
                    data, sender = listener.recvfrom(65_536)
                except TimeoutError:
                    continue
                if said := answer(data):
                    listener.sendto(said, sender)

        with _running(serve, ending):
            yield int(listener.getsockname()[1])


@contextmanager
def udp_sender(port: int, packets: Sequence[bytes], every_s: float = 0.01) -> Iterator[None]:
    """Sends packets to a port of this computer again and again, whether or not anyone listens."""
    ending = threading.Event()

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for packet in itertools.cycle(packets):
                if ending.wait(every_s):
                    return
                sender.sendto(packet, (HOST, port))

    with _running(send, ending):
        yield


@contextmanager
def _running(work: Callable[[], None], ending: threading.Event) -> Iterator[None]:
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ending.set()
        thread.join()


def http(routes: dict[str, object]) -> Answer:
    """Answers GET with JSON; a path that is not there with 404."""

    def answer(heard: bytes) -> bytes:
        if b"\r\n\r\n" not in heard:
            return b""
        path = heard.split()[1].decode()
        body = json.dumps(routes.get(path)).encode()
        status = "200 OK" if path in routes else "404 Not Found"
        head = f"HTTP/1.1 {status}\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n"
        return head.encode() + body

    return answer


def rtp(payloads: Sequence[bytes], payload_type: int = 96, extended: bool = False) -> list[bytes]:
    """RTP packets (RFC 3550), with a header extension of 4 bytes if asked for."""
    first = 0x90 if extended else 0x80
    extension = struct.pack(">HHI", 0xBEDE, 1, 0) if extended else b""
    return [
        struct.pack(">BBHII", first, payload_type, number, number * 3000, 1) + extension + payload
        for number, payload in enumerate(payloads)
    ]
