"""Messages between parent and child: two lengths, a header in JSON, raw arrays."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Mapping
from typing import Any

LENGTHS = struct.Struct("<II")
"""Bytes of the header, bytes of what follows it."""

Header = dict[str, Any]


def message(header: Mapping[str, Any], payload_size: int = 0) -> bytes:
    """Return what goes before ``payload_size`` bytes of arrays."""
    text = json.dumps(header).encode()
    return LENGTHS.pack(len(text), payload_size) + text


def receive(source: int) -> tuple[Header, bytearray]:
    """Read one message from a blocking pipe.

    Raises:
        EOFError: the other end is closed.
    """
    header_size, payload_size = LENGTHS.unpack(_exactly(source, LENGTHS.size))
    return json.loads(_exactly(source, header_size)), _exactly(source, payload_size)


def send(target: int, header: Mapping[str, Any], payload: bytes = b"") -> None:
    """Write one message to a blocking pipe."""
    left = memoryview(message(header, len(payload)) + payload)
    while left:
        left = left[os.write(target, left) :]


def _exactly(source: int, size: int) -> bytearray:
    """A new buffer: what was read into it stays as it is."""
    buffer = bytearray(size)
    left = memoryview(buffer)
    while left:
        count = os.readv(source, [left])
        if count == 0:
            raise EOFError("the other end is closed")
        left = left[count:]
    return buffer
