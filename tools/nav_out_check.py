#!/usr/bin/env python3
"""Navigation out of the daemon, read by pynmea2: nav_out_check.py ECHOTANK

Starts the daemon on navigation that is sent to it here, with outputs over UDP and TCP, and looks at what comes: a pulse, then the ZDA that names
the second, at every second; GGA and HDT with the position and heading that were put in; and, when the input falls silent, without.
"""

import datetime
import os
import pathlib
import socket
import subprocess
import sys
import tempfile
import threading
import time

import pynmea2

CONFIG = """
[medium]
sound_speed_m_per_s = 1500.0
absorption = "none"
[nav]
origin = {{ latitude_deg = 54.0, longitude_deg = 10.0 }}
mode = "predict"
stale_s = 0.8
[[nav.source]]
name = "in"
kind = "udp"
listen = "127.0.0.1:0"
[[nav.output]]
name = "board"
kind = "udp"
to = "127.0.0.1:{port}"
rate_hz = 2.0
talker = "IN"
pulse = "byte"
[[nav.output]]
name = "bridge"
kind = "tcp"
listen = "127.0.0.1:0"
sentences = ["HDT"]
rate_hz = 10.0
[[sonar]]
name = "s"
[sonar.pulse]
kind = "cw"
center_frequency_khz = 100.0
duration_ms = 1.0
[[sonar.transmit]]
name = "tx"
pattern = "omnidirectional"
[[sonar.receive]]
name = "rx"
transmit = "tx"
elements = 1
spacing_m = 0.0075
[sonar.receiver]
sample_rate_khz = 20.0
rx_filter = "none"
full_scale_v = 1.0
[sonar.ping]
range_m = 20.0
rate_hz = 5.0
source_level_db = 200.0
gain_db = 0.0
[sonar.output.sevenk]
id = 103
arrays = ["rx"]
listen = "127.0.0.1:0"
"""


def sentence(body):
    total = 0
    for character in body.encode():
        total ^= character
    return f"${body}*{total:02X}\r\n".encode()


def feed(address, stop):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        while not stop.is_set():
            now = datetime.datetime.now(datetime.timezone.utc)
            clock = now.strftime("%H%M%S.") + f"{now.microsecond // 1000:03d}"
            text = sentence(f"GPZDA,{clock},{now:%d,%m,%Y},00,00")
            text += sentence(f"GPGGA,{clock},5406.000000,N,01003.000000,W,2,9,0.9,1.0,M,0.0,M,,")
            text += sentence("GPHDT,123.45,T")
            out.sendto(text, address)
            time.sleep(0.05)


def address_after(daemon, start):
    """The address in the first line that begins with `start`."""
    for line in daemon.stdout:
        if line.startswith(start):
            host, port = line.split()[-1].rsplit(":", 1)
            return host, int(port)
    raise SystemExit(f"the daemon ended before it said `{start}`")


def hear(device, seconds):
    """Datagrams that come within so many seconds."""
    heard, end = [], time.monotonic() + seconds
    device.settimeout(0.2)
    while time.monotonic() < end:
        try:
            heard.append(device.recv(2000))
        except TimeoutError:
            pass
    return heard


def main():
    echotank = os.path.abspath(sys.argv[1])
    device = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    device.bind(("127.0.0.1", 0))
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder, "rig.toml")
        path.write_text(CONFIG.format(port=device.getsockname()[1]))
        daemon = subprocess.Popen([echotank, "run", str(path)], stdout=subprocess.PIPE, text=True, cwd=folder)
        try:
            check(daemon, device)
        finally:
            daemon.terminate()
            daemon.communicate()
    device.close()


def check(daemon, device):
    source = address_after(daemon, "nav in ")
    bridge = address_after(daemon, "nav out bridge ")
    # What it prints from here on is not of interest.
    threading.Thread(target=daemon.stdout.read, daemon=True).start()
    stop = threading.Event()
    feeder = threading.Thread(target=feed, args=(source, stop))
    feeder.start()
    # The client of the TCP server, and the device on UDP.
    with socket.create_connection(bridge) as client:
        heard = hear(device, 4.2)
        client.settimeout(2.0)
        headings = [pynmea2.parse(line, check=True) for line in client.makefile().readlines(200)]
    stop.set()
    feeder.join()
    hear(device, 1.2)
    silent = hear(device, 2.0)

    pulses, seconds, fixes = 0, [], 0
    for before, datagram in zip([b""] + heard, heard):
        if datagram == b"\x07":
            pulses += 1
            continue
        for line in datagram.decode("ascii").splitlines():
            message = pynmea2.parse(line, check=True)
            assert message.talker == "IN", line
            if message.sentence_type == "ZDA":
                assert before == b"\x07", "the pulse comes before the ZDA that names it"
                seconds.append(message.datetime.timestamp())
            elif message.sentence_type == "GGA" and message.gps_qual:
                assert message.gps_qual == 2, line
                assert abs(message.latitude - 54.1) < 1e-8 and abs(message.longitude + 10.05) < 1e-8, line
                fixes += 1
            elif message.sentence_type == "HDT" and message.heading:
                assert float(message.heading) == 123.45, line
    assert pulses == len(seconds) >= 2, (pulses, seconds)
    assert all(later - sooner == 1.0 for sooner, later in zip(seconds, seconds[1:])), seconds
    assert abs(seconds[-1] - time.time()) < 60, "the pings' clock"
    assert fixes >= 4, heard
    assert all(float(m.heading) == 123.45 for m in headings if m.heading), headings
    assert silent, "it goes on in silence"
    for datagram in silent:
        for line in datagram.decode("ascii").replace("\x07", "").splitlines():
            message = pynmea2.parse(line, check=True)
            if message.sentence_type == "GGA":
                assert message.gps_qual == 0 and not message.lat, line
            elif message.sentence_type == "HDT":
                assert not message.heading, line
    print(f"{pulses} pulses and ZDA, {fixes} GGA, {len(headings)} HDT over TCP, all read by pynmea2; none with a position in silence")


if __name__ == "__main__":
    main()
