"""A small WebSocket client of the operator's page, for tools/soak and tools/test_page.py. Standard library only."""

import base64
import json
import os
import socket
import struct


class Closed(Exception):
    """The daemon closed or refused the connection."""


class PageClient:
    """One open page. `status` is the HTTP status of the handshake: 101 if accepted."""

    def __init__(self, address, origin=None, protocols=("echotank",), timeout_s=10.0, receive_bytes=None):
        host, port = address.rsplit(":", 1)
        self.socket = socket.socket()
        if receive_bytes:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_bytes)
        self.socket.settimeout(timeout_s)
        self.socket.connect((host, int(port)))
        key = base64.b64encode(os.urandom(16)).decode()
        head = ["GET /page/socket HTTP/1.1", f"Host: {address}", "Upgrade: websocket", "Connection: Upgrade",
                f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Version: 13", f"Sec-WebSocket-Protocol: {', '.join(protocols)}"]
        if origin is not None:
            head.append(f"Origin: {origin}")
        self.socket.sendall(("\r\n".join(head) + "\r\n\r\n").encode())
        self.pending = b""
        while b"\r\n\r\n" not in self.pending:
            self._more()
        head, self.pending = self.pending.split(b"\r\n\r\n", 1)
        self.status = int(head.split()[1])

    def _more(self):
        data = self.socket.recv(1 << 16)
        if not data:
            raise Closed()
        self.pending += data

    def _take(self, count):
        while len(self.pending) < count:
            self._more()
        taken, self.pending = self.pending[:count], self.pending[count:]
        return taken

    def send_frame(self, kind, body, masked=True):
        length = len(body)
        flag = 0x80 if masked else 0
        if length < 126:
            head = struct.pack(">BB", 0x80 | kind, flag | length)
        elif length < 1 << 16:
            head = struct.pack(">BBH", 0x80 | kind, flag | 126, length)
        else:
            head = struct.pack(">BBQ", 0x80 | kind, flag | 127, length)
        mask = os.urandom(4) if masked else b""
        if masked:
            body = bytes(b ^ mask[k % 4] for k, b in enumerate(body))
        self.socket.sendall(head + mask + body)

    def send(self, message):
        self.send_frame(1, (message if isinstance(message, str) else json.dumps(message)).encode())

    def receive(self):
        """The next message: a dictionary for text, bytes for a frame of a ping. WebSocket pings are answered."""
        try:
            while True:
                kind, length = struct.unpack(">BB", self._take(2))
                if length == 126:
                    (length,) = struct.unpack(">H", self._take(2))
                elif length == 127:
                    (length,) = struct.unpack(">Q", self._take(8))
                body = self._take(length)
                if kind & 15 == 1:
                    return json.loads(body)
                if kind & 15 == 2:
                    return body
                if kind & 15 == 8:
                    raise Closed()
                if kind & 15 == 9:
                    self.send_frame(10, body)
        except OSError as error:
            if isinstance(error, socket.timeout):
                raise
            raise Closed() from error

    def close(self):
        self.socket.close()


def head_of(frame):
    """Kind, sonar, ping number and text of a binary frame."""
    kind, version, sonar, ping, text_bytes, array_bytes = struct.unpack_from("<BBHIII", frame)
    if version != 1 or 16 + text_bytes + array_bytes != len(frame):
        raise ValueError("not a frame of the page: version %d, %d bytes" % (version, len(frame)))
    return kind, sonar, ping, json.loads(frame[16:16 + text_bytes])
