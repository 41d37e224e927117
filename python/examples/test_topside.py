"""A unit test of a topside: a fixture starts the daemon on free ports, and the test reads it as it would read the sonar.

The topside here is a short reader of Echotank's element stream. Replace it by yours.

    pytest test_topside.py        ECHOTANK names the program; without it, `echotank` on the path
"""

import os
import re
import shutil
import socket
import struct
import subprocess
import threading
from pathlib import Path
from typing import Dict, Iterator, Tuple

import numpy as np
import pytest

RIG = Path(__file__).resolve().parent / "rigs" / "flat.toml"
HEADER = struct.Struct("<4sHHIIIIIIHHfqddd")


class Topside:
    """Reads pings of the element stream."""

    def __init__(self, address: Tuple[str, int]) -> None:
        self.link = socket.create_connection(address, timeout=60)
        self.stream = self.link.makefile("rb")

    def close(self) -> None:
        self.stream.close()
        self.link.close()

    def ping(self) -> Tuple[int, np.ndarray, float]:
        """Number of the ping, samples (elements, samples) in volts, sample rate in hertz."""
        parts = []
        while True:
            (magic, _, header, size, _, number, first, samples, of_ping, elements, kind, volts, _, _, rate_hz, _) = HEADER.unpack(
                self.stream.read(HEADER.size)
            )
            assert magic == b"ETEL"
            data = np.frombuffer(self.stream.read(size - header), "<i2" if kind == 1 else "<f4")
            if first == 0:
                parts = []
            pairs = data.reshape(samples, elements, 2) * volts
            parts.append(pairs[..., 0] + 1j * pairs[..., 1])
            if first + samples == of_ping and sum(len(part) for part in parts) == of_ping:
                return number, np.concatenate(parts).T, rate_hz


@pytest.fixture
def daemon() -> Iterator[Dict[str, Tuple[str, int]]]:
    """A running daemon: the addresses of its outputs by name. Port 0 takes any free port, so tests can run side by side."""
    program = os.environ.get("ECHOTANK") or shutil.which("echotank")
    assert program, "ECHOTANK does not name the program"
    outputs = {"elements": "sonar.output.elements"}
    command = [program, "run", str(RIG), "--set", "nav.loop=true", "--set", "nav.stamp=host"]
    for table in outputs.values():
        command += ["--set", f'{table}.listen="127.0.0.1:0"']
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    # A daemon that does not start must not hold the test for ever.
    watch = threading.Timer(120, process.kill)
    watch.start()
    addresses: Dict[str, Tuple[str, int]] = {}
    said = ""
    for line in process.stdout:
        said += line
        found = re.match(r"(\S+) .* tcp ([\d.]+):(\d+)", line)
        if found and found[1] in outputs:
            addresses[found[1]] = (found[2], int(found[3]))
        if len(addresses) == len(outputs):
            break
    assert len(addresses) == len(outputs), f"the daemon did not start:\n{said}"
    # The daemon must not wait for a reader of its reports.
    drain = threading.Thread(target=process.stdout.read, daemon=True)
    drain.start()
    yield addresses
    watch.cancel()
    process.terminate()
    assert process.wait(60) == 0
    drain.join()
    process.stdout.close()


def test_the_topside_finds_the_bottom_at_its_depth(daemon: Dict[str, Tuple[str, int]]) -> None:
    topside = Topside(daemon["elements"])
    numbers = []
    for _ in range(3):
        number, samples, rate_hz = topside.ping()
        numbers.append(number)
        # The elements of the fan, below the ship: the first strong echo is the bottom, 15 m below.
        level = np.abs(samples[2:].sum(axis=0))
        first = np.argmax(level > 0.3 * level.max())
        assert first / rate_hz * 1500 / 2 == pytest.approx(15.0, abs=0.5)
    assert numbers == list(range(numbers[0], numbers[0] + 3))
    topside.close()
