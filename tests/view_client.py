"""A client of Foxglove's WebSocket protocol, made of a socket, for the tests of the view."""

import base64
import json
import os
import socket
import struct
import time
from urllib.parse import urlsplit

from live_net import PATIENCE_S

_TEXT, _BINARY = 1, 2


class Client:
    """Connects, subscribes to what it is told to, keeps what it is given."""

    def __init__(self, address, receive_buffer=None, host=None, origin=None):
        """`address` is the one that is printed: `ws://127.0.0.1:PORT/?token=TOKEN`."""
        at = urlsplit(address)
        port = at.port
        self._socket = socket.socket()
        if receive_buffer:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        self._socket.settimeout(PATIENCE_S)
        self._socket.connect(("127.0.0.1", port))
        key = base64.b64encode(os.urandom(16)).decode()
        lines = (
            f"GET {at.path}?{at.query} HTTP/1.1",
            f"Host: {host or at.netloc}",
            *([f"Origin: {origin}"] if origin else []),
            "Upgrade: websocket",
            "Connection: Upgrade",
            f"Sec-WebSocket-Key: {key}",
            "Sec-WebSocket-Version: 13",
            "Sec-WebSocket-Protocol: foxglove.sdk.v1",
        )
        self._socket.sendall("\r\n".join((*lines, "", "")).encode())
        self._data = b""
        while b"\r\n\r\n" not in self._data:
            self._data += self._socket.recv(4096)
        head, _, self._data = self._data.partition(b"\r\n\r\n")
        if b" 101 " not in head:
            self._socket.close()
            raise AssertionError(head.decode())
        self.channels = {}
        self._subscriptions = {}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._socket.close()

    def subscribe(self, *endings):
        """Wait until channels with these endings are there, and subscribe to them."""
        self.until(lambda: all(self._ending(ending) for ending in endings))
        for ending in endings:
            channel = self._ending(ending)
            number = len(self._subscriptions) + 1
            self._subscriptions[number] = channel
            self._ask(number, channel["id"])

    def _ask(self, number, channel_id):
        self._send({"op": "subscribe", "subscriptions": [{"id": number, "channelId": channel_id}]})

    def message(self):
        """The next message: (topic, log time in ns, payload)."""
        found = []
        self.until(lambda: found, found)
        return found[0]

    def until(self, condition, messages=None):
        """Read until a condition holds; messages go into the list, if there is one."""
        limit = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < limit, "it did not come about"
            opcode, payload = self._frame()
            if opcode == _TEXT:
                self._told(json.loads(payload))
            elif opcode == _BINARY and payload[0] == 1 and messages is not None:
                number, log_time = struct.unpack_from("<IQ", payload, 1)
                messages.append((self._subscriptions[number]["topic"], log_time, payload[13:]))

    def _ending(self, ending):
        return next((c for c in self.channels.values() if c["topic"].endswith(ending)), None)

    def _told(self, message):
        if message["op"] == "advertise":
            self.channels |= {channel["id"]: channel for channel in message["channels"]}
        elif message["op"] == "unadvertise":
            for number in message["channelIds"]:
                self.channels.pop(number)
        elif message["op"] == "status" and message["message"].startswith("Unknown channel ID: "):
            # The server tells of a channel a moment before it knows it itself; the page asks again, too.
            refused = int(message["message"].rpartition(" ")[2])
            for number, channel in self._subscriptions.items():
                if channel["id"] == refused and refused in self.channels:
                    time.sleep(0.05)
                    self._ask(number, refused)

    def _frame(self):
        first, length = self._take(2)
        if length == 126:
            (length,) = struct.unpack(">H", self._take(2))
        elif length == 127:
            (length,) = struct.unpack(">Q", self._take(8))
        return first & 15, self._take(length)

    def _take(self, n):
        while len(self._data) < n:
            more = self._socket.recv(1 << 16)
            assert more, "the server hung up"
            self._data += more
        taken, self._data = self._data[:n], self._data[n:]
        return taken

    def _send(self, message):
        data = json.dumps(message).encode()
        mask = os.urandom(4)
        length = bytes([0x80 | len(data)]) if len(data) < 126 else b"\xfe" + struct.pack(">H", len(data))
        masked = bytes(byte ^ mask[i % 4] for i, byte in enumerate(data))
        self._socket.sendall(bytes([0x80 | _TEXT]) + length + mask + masked)
