"""Third-party readers (tools/requirements.txt) on the daemon's sockets and files: the manufacturers' client on both devices of the Ping
protocol over TCP and UDP, tshark on every VITA 49 packet, sigmf, libsndfile, pingverter on .svlog, pynmea2 on navigation output.

The rigs are those of hil-configs with other ports. The program is target/release/echotank, or ECHOTANK.
"""

import contextlib
import datetime
import functools
import glob
import io
import os
import pathlib
import re
import select
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import unittest
import warnings

import numpy as np
import pynmea2

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
PATIENCE_S = 60.0
SOUND_M_PER_S = 1480.0

needs_310 = unittest.skipIf(sys.version_info < (3, 10), "the reader needs Python 3.10")


def program():
    named = os.environ.get("ECHOTANK")
    if named:
        return named
    path = os.path.join(os.environ.get("CARGO_TARGET_DIR", os.path.join(ROOT, "target")), "release", "echotank")
    if not os.path.exists(path):
        subprocess.run(["cargo", "build", "--quiet", "--release"], cwd=ROOT, check=True)
    return path


class Daemon:
    """A running daemon of a light rig, and what it announced."""

    def __init__(self, rig, *settings):
        command = [program(), "run", os.path.join(ROOT, "tests/data/rigs", rig)]
        for setting in settings:
            command += ["--set", setting]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=ROOT)
        self.lines = []

    def address(self, pattern):
        """Host and port at the end of the first line that matches."""
        while True:
            for line in self.lines:
                if re.match(pattern, line):
                    host, port = line.split()[-1].rsplit(":", 1)
                    return host, int(port)
            line = self.process.stdout.readline()
            if not line:
                raise AssertionError("the daemon ended:\n" + "".join(self.lines))
            self.lines.append(line)

    def stop(self):
        self.process.terminate()
        text, _ = self.process.communicate(timeout=PATIENCE_S)
        if self.process.returncode != 0:
            raise AssertionError("the daemon ended with %s:\n%s%s" % (self.process.returncode, "".join(self.lines), text))
        return "".join(self.lines) + text


def wait_for(device, message_ids, wanted):
    """The first message that is as wanted."""
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        message = device.wait_message(message_ids)
        if message is not None and wanted(message):
            return message
    raise AssertionError("no such message in %g s" % PATIENCE_S)


class PingProtocol(unittest.TestCase):
    """brping: Blue Robotics' and Cerulean's own Python client, generated from their definitions."""

    def connect(self, kind, transport, address):
        device = kind()
        (device.connect_tcp if transport == "tcp" else device.connect_udp)(*address)
        self.addCleanup(device.iodev.close)
        until = time.monotonic() + PATIENCE_S
        while not device.initialize():
            self.assertLess(time.monotonic(), until, "no device_information")
        return device

    def test_omniscan_pings_and_obeys_range_rate_and_gain_over_tcp_and_udp(self):
        from brping import Omniscan450, definitions
        profile = [definitions.OMNISCAN450_OS_MONO_PROFILE]
        daemon = Daemon("omniscan450.toml", "sonar.0.output.ping.listen=127.0.0.1:0", "sonar.1.output.ping.listen=127.0.0.1:0")
        try:
            for transport in ("tcp", "udp"):
                device = self.connect(Omniscan450, transport, daemon.address("ping port %s" % transport))
                for length_m, msec, gain, results in ((30, 250, 7, 1200), (60, 500, 0, 600), (20, 200, 3, 200)):
                    device.control_os_ping_params(start_mm=0, length_mm=length_m * 1000, msec_per_ping=msec, gain_index=gain, num_results=results, pulse_len_percent=0.02)
                    obeyed = wait_for(device, profile, lambda m: (m.length_mm, m.gain_index, m.num_results) == (length_m * 1000, gain, results))
                    self.assertEqual(len(obeyed.pwr_results), results)
                    self.assertEqual((obeyed.ping_hz, obeyed.sos_dmps, obeyed.channel_number), (450000, 14800, 0))
                    following = [wait_for(device, profile, lambda m: True) for _ in range(4)]
                    times = [m.timestamp_ms for m in [obeyed] + following]
                    numbers = [m.ping_number for m in [obeyed] + following]
                    self.assertEqual(numbers, list(range(numbers[0], numbers[0] + 5)), transport)
                    self.assertLess(abs((times[-1] - times[0]) / 4.0 - msec), 2.0, "asked for a ping every %d ms" % msec)
                # The bottom lies 12 m under the waterline and the head 0.6 m: nothing comes from nearer, and sand beyond.
                db = np.array(Omniscan450.scale_power(wait_for(device, profile, lambda m: True)))
                metres = (np.arange(200) + 0.5) * 0.1
                water, sand = db[(metres > 3.0) & (metres < 9.5)].mean(), db[(metres > 14.0)].mean()
                self.assertGreater(sand - water, 6.0, "%.1f dB in the water, %.1f on the sand" % (water, sand))
                device.control_os_ping_params(start_mm=0, length_mm=81000, num_results=200)
                refused = wait_for(device, [definitions.COMMON_NACK], lambda m: True)
                self.assertEqual(refused.nacked_id, definitions.OMNISCAN450_OS_PING_PARAMS)
                self.assertIn(b"range_m = 81", bytes(refused.nack_message))
        finally:
            daemon.stop()

    def test_surveyor_finds_the_bottom_and_obeys_over_tcp_and_udp(self):
        from brping import Surveyor240, definitions
        atof = [definitions.SURVEYOR240_ATOF_POINT_DATA]
        daemon = Daemon("surveyor240.toml", "sonar.output.ping.listen=127.0.0.1:0")
        try:
            for transport in ("tcp", "udp"):
                device = self.connect(Surveyor240, transport, daemon.address("ping surveyor %s" % transport))
                for end_m, msec in ((25, 250), (40, 500)):
                    device.control_set_ping_parameters(start_mm=0, end_mm=end_m * 1000, sos_mps=SOUND_M_PER_S, msec_per_ping=msec, ping_enable=True, enable_atof_data=True, pulse_len_steps=5.0, gain_index=20)
                    pulse_s = max(5.0 * 2.0 * end_m / SOUND_M_PER_S / 400, 2e-4)
                    listens_s = 2.0 * end_m / SOUND_M_PER_S + pulse_s
                    obeyed = wait_for(device, atof, lambda m: abs(m.listening_sec - listens_s) < 1e-3 and abs(m.pulse_sec - pulse_s) < 1e-6)
                    following = [wait_for(device, atof, lambda m: True) for _ in range(4)]
                    times = [m.pwr_up_msec for m in [obeyed] + following]
                    self.assertLess(abs((times[-1] - times[0]) / 4.0 - msec), 2.0, "asked for a ping every %d ms" % msec)
                    for message in [obeyed] + following:
                        points = Surveyor240.create_atof_list(message)
                        self.assertGreater(len(points), 20)
                        depths = [0.5 * SOUND_M_PER_S * p.tof * np.cos(p.angle) for p in points]
                        # 12 m less the head's 0.8 m; heave and roll of the launch move single points.
                        self.assertAlmostEqual(float(np.median(depths)), 11.2, delta=0.5)
                device.control_set_ping_parameters(end_mm=61000, enable_atof_data=True, ping_enable=True)
                refused = wait_for(device, [definitions.COMMON_NACK], lambda m: True)
                self.assertEqual(refused.nacked_id, definitions.SURVEYOR240_SET_PING_PARAMETERS)
                device.control_set_ping_parameters(end_mm=25000, ping_enable=False, enable_atof_data=True)
                time.sleep(1.5)
                # The client waits for ever on a silent socket, whatever timeout it is given: look at the socket itself.
                device.iodev.setblocking(False)
                try:
                    while device.iodev.recv(65536):
                        pass
                except BlockingIOError:
                    pass
                self.assertEqual(select.select([device.iodev], [], [], 1.5)[0], [], "told not to ping")
                device.control_set_ping_parameters(end_mm=25000, ping_enable=True, enable_atof_data=True)
                wait_for(device, atof, lambda m: True)
        finally:
            daemon.stop()


@unittest.skipUnless(shutil.which("tshark"), "tshark is not installed")
class Vita49(unittest.TestCase):
    """tshark, on every packet that the daemon sends; its own arithmetic of times."""

    def test_every_packet_is_decoded_and_none_is_missing(self):
        inbox = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        inbox.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        inbox.bind(("127.0.0.1", 0))
        inbox.settimeout(PATIENCE_S)
        daemon = Daemon("board.toml", "sonar.output.vita49.send_to=127.0.0.1:%d" % inbox.getsockname()[1], "sonar.output.vita49.pace_mbit_per_s=100")
        packets = []
        try:
            until = time.monotonic() + PATIENCE_S
            contexts = 0
            # Three pings of eight streams, whole: the fourth has begun.
            while contexts <= 24 and time.monotonic() < until:
                packet = inbox.recv(65536)
                packets.append(packet)
                contexts += packet[0] >> 4 == 4
        finally:
            daemon.stop()
            inbox.close()
        with tempfile.TemporaryDirectory() as folder:
            capture = os.path.join(folder, "vita.pcap")
            with open(capture, "wb") as file:
                # Raw IPv4.
                file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 101))
                for packet in packets:
                    length = 28 + len(packet)
                    head = struct.pack(">BBHHHBBHII", 0x45, 0, length, 0, 0, 64, 17, 0, 0x7F000001, 0x7F000001) + struct.pack(">HHHH", 50000, 4991, 8 + len(packet), 0)
                    file.write(struct.pack("<IIII", 0, 0, length, length) + head + packet)
            fields = ["type", "sid", "seq", "ts_int", "ts_frac_picosecond", "len"]
            command = ["tshark", "-r", capture, "-Y", "vrt", "-T", "fields", "-E", "separator=,"]
            for field in fields:
                command += ["-e", "vrt." + field]
            done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, check=True, text=True)
        decoded = [dict(zip(fields, line.split(","))) for line in done.stdout.splitlines()]
        self.assertEqual(len(decoded), len(packets), "tshark decodes every packet")
        for stream in range(1, 9):
            mine = [p for p in decoded if int(p["sid"], 0) == stream]
            data = [int(p["seq"]) for p in mine if int(p["type"]) == 1]
            self.assertEqual(data, [n % 16 for n in range(len(data))], "stream %d" % stream)
            self.assertGreater(len(data), 50)
            times = [int(p["ts_int"]) * 10**12 + int(p["ts_frac_picosecond"]) for p in mine]
            self.assertEqual(times, sorted(times))
            # 724 real samples of 2 us in a packet of 1472 bytes.
            steps = {b - a for a, b in zip(times, times[1:]) if 0 < b - a < 10**10}
            self.assertEqual(steps, {1448 * 10**6}, "picoseconds between packets")


@needs_310
class Recordings(unittest.TestCase):
    """sigmf's schema and reading, and libsndfile, on what the daemon records while it pings."""

    def test_sigmf_validates_and_libsndfile_reads_the_same_echo(self):
        import sigmf
        import soundfile
        with tempfile.TemporaryDirectory() as folder:
            daemon = Daemon("board.toml", "record.directory=%s" % folder, "sonar.output.sigmf={}", "sonar.output.wav={}", "sonar.output.vita49.send_to=127.0.0.1:9")
            daemon.address("vita49 board udp")
            time.sleep(5.0)
            daemon.stop()
            meta, = glob.glob(os.path.join(folder, "*.sigmf-meta"))
            recording = sigmf.sigmffile.fromfile(meta, autoscale=False)
            recording.validate()
            pings = recording.get_annotations()
            self.assertGreater(len(pings), 4)
            self.assertEqual(recording.get_global_field("core:num_channels"), 8)
            # A busy machine may skip a ping.
            numbers = [int(p["core:label"].removeprefix("ping ")) for p in pings]
            self.assertEqual(numbers, sorted(set(numbers)))
            wav, = glob.glob(os.path.join(folder, "*.wav"))
            about = soundfile.info(wav)
            self.assertEqual((about.samplerate, about.channels, about.subtype), (384000, 8, "PCM_16"))
            sound, _ = soundfile.read(wav, dtype="int16")
            # The second ping's envelope, from the passband samples and from I and Q: the same energy, and at the same moments.
            first = recording.get_captures()[0]
            second = recording.get_captures()[1]
            moment = lambda c: np.datetime64(c["core:datetime"].rstrip("Z"), "ns")
            begins = (moment(second) - moment(first)) / np.timedelta64(1, "s")
            iq = recording.read_samples(start_index=second["core:sample_start"], count=pings[1]["core:sample_count"])
            start = int(np.ceil(begins * 384000))
            played = sound[start : start + int(len(iq) / 20e3 * 384000), 3].astype(float)
            # Mean power in milliseconds; a carrier's is half its envelope's.
            heard = (np.abs(iq[:, 3]) ** 2)[: len(iq) // 20 * 20].reshape(-1, 20).mean(axis=1)
            power = 2.0 * (played**2)[: len(heard) * 384].reshape(-1, 384).mean(axis=1)
            loud = heard[: len(power)] > 100.0
            self.assertGreater(loud.sum(), 5)
            power, heard = power[loud], heard[: len(power)][loud]
            self.assertLess(abs(10 * np.log10(power.sum() / heard.sum())), 0.05, "dB between the two")
            # Milliseconds begin up to a sample of I and Q apart, which matters where an echo begins.
            alike = np.corrcoef(power, heard)[0, 1]
            self.assertGreater(alike, 0.99)

NAV_RIG = """
[nav]
mode = "predict"
origin = {{ latitude_deg = -54.0, longitude_deg = -10.0 }}
stamp = "log"
[[nav.source]]
name = "gnss"
kind = "udp"
listen = "127.0.0.1:0"
provides = ["position", "heading"]
{outputs}
"""
NAV_OUTPUT = """
[[nav.output]]
name = "{name}"
kind = "{kind}"
{where}
rate_hz = 2.0
pulse = "byte"
"""
PULSE = b"\x07"


def sentence(body):
    return "$%s*%02X\r\n" % (body, functools.reduce(lambda a, c: a ^ ord(c), body, 0))


class Receiver(threading.Thread):
    """A GNSS receiver on UDP: ten times a second, its clock `off_s` from the computer's; northward at 1 m/s, on a heading of 359.9 degrees."""

    def __init__(self, to, off_s):
        super().__init__(daemon=True)
        self.to, self.off_s, self.ended = to, off_s, threading.Event()
        self.start()

    def now(self):
        return datetime.datetime.fromtimestamp(time.time() + self.off_s, datetime.timezone.utc)

    def run(self):
        out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.began = self.now()
        while not self.ended.wait(0.1):
            now = self.now()
            clock = now.strftime("%H%M%S.") + "%03d" % (now.microsecond // 1000)
            minutes = (now - self.began).total_seconds() / 1852.0
            text = sentence("GPZDA,%s,%s,00,00" % (clock, now.strftime("%d,%m,%Y")))
            text += sentence("GPGGA,%s,54%09.6f,S,01030.000000,W,4,9,0.9,1.0,M,0.0,M,," % (clock, 30.0 - minutes))
            text += sentence("GPHDT,359.90,T")
            out.sendto(text.encode(), self.to)
        out.close()

    def stop(self):
        self.ended.set()
        self.join(PATIENCE_S)


class NavigationOut(unittest.TestCase):
    """pynmea2 on what a device under test hears over UDP, TCP and a serial line: the clock of the pings."""

    def lines(self, read, seconds):
        """What comes until so many ZDA have: pulses and sentences in their order, with the moment of each."""
        heard, pending, until = [], b"", time.monotonic() + PATIENCE_S
        while sum(kind == "ZDA" for kind, _, _ in heard) < seconds:
            self.assertLess(time.monotonic(), until, "%d in time: %r" % (len(heard), heard))
            pending += read()
            while pending:
                if pending.startswith(PULSE):
                    heard.append(("pulse", None, time.time()))
                    pending = pending[1:]
                    continue
                line, end, rest = pending.partition(b"\r\n")
                if not end:
                    break
                pending = rest
                spoken = pynmea2.parse(line.decode(), check=True)
                heard.append((spoken.sentence_type, spoken, time.time()))
        return heard

    def check(self, heard, receiver):
        for k, (kind, spoken, at) in enumerate(heard):
            if kind == "ZDA":
                named = datetime.datetime.combine(datetime.date(spoken.year, spoken.month, spoken.day), spoken.timestamp)
                self.assertEqual(named.microsecond, 0)
                named = named.replace(tzinfo=datetime.timezone.utc).timestamp()
                self.assertLess(abs(at + receiver.off_s - named), 0.9, "the clock of the receiver, when it is said")
                self.assertTrue(k == 0 or heard[k - 1][0] == "pulse", "the pulse comes before what names it")
            elif kind == "GGA":
                self.assertEqual(spoken.gps_qual, 4)
                of_day = datetime.datetime.combine(receiver.began.date(), spoken.timestamp, datetime.timezone.utc)
                metres = (of_day - receiver.began).total_seconds() % 86400.0
                if 1.0 < metres < 3600.0:
                    north = (spoken.latitude + 54.5) * 60.0 * 1852.0
                    self.assertAlmostEqual(north, metres, delta=0.3)
                self.assertAlmostEqual(spoken.longitude, -10.5, delta=1e-7)
            elif kind == "HDT":
                self.assertAlmostEqual(float(spoken.heading), 359.9, places=3)
        kinds = [kind for kind, _, _ in heard]
        self.assertGreaterEqual(kinds.count("GGA"), 2)
        self.assertGreaterEqual(kinds.count("HDT"), 2)

    def rig(self, folder, device, inbox):
        port = "127.0.0.1:%d" % inbox.getsockname()[1]
        outputs = "".join(NAV_OUTPUT.format(name=name, kind=kind, where=where) for name, kind, where in (
            ("board", "tcp", 'listen = "127.0.0.1:0"'),
            ("lan", "udp", 'to = "%s"' % port),
            ("line", "serial", 'port = "%s"\nbaud = 9600' % os.ttyname(device)),
        ))
        path = os.path.join(folder, "nav.toml")
        with open(path, "w", encoding="utf-8") as file:
            file.write(NAV_RIG.format(outputs=outputs))
            with open(os.path.join(ROOT, "tests", "data", "live_sonar.toml"), encoding="utf-8") as sonar:
                file.write(sonar.read())
        return path

    def test_every_way_out_names_the_seconds_of_the_pings_own_clock(self):
        # Of now, and of a log that is played again: the pings' clock is the receiver's either way.
        for off_s in (0.0, -86400.0 * 4000.0):
            with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as closing:
                ours, device = os.openpty()
                closing.callback(os.close, ours)
                closing.callback(os.close, device)
                inbox = closing.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
                inbox.bind(("127.0.0.1", 0))
                inbox.settimeout(0.5)
                daemon = Daemon(self.rig(folder, device, inbox))
                receiver = Receiver(daemon.address("nav gnss udp"), off_s)
                board = daemon.address("nav out board tcp")
                closing.callback(receiver.stop)
                try:
                    client = closing.enter_context(socket.create_connection(board, PATIENCE_S))
                    client.settimeout(0.5)

                    def of(receive):
                        def read():
                            try:
                                return receive(4096)
                            except (socket.timeout, TimeoutError):
                                return b""
                        return read

                    def line():
                        return os.read(ours, 4096) if select.select([ours], [], [], 0.5)[0] else b""

                    for way in (of(client.recv), of(inbox.recv), line):
                        # What had gathered before is old by now.
                        self.drain(way)
                        self.check(self.lines(way, 2), receiver)
                finally:
                    printed = daemon.stop()
                self.assertNotIn("pings 0 made", printed.splitlines()[-1])

    def drain(self, way):
        until = time.monotonic() + 0.3
        while time.monotonic() < until:
            way()


@needs_310
class Svlog(unittest.TestCase):
    """pingverter, on what a daemon records of an Omniscan pair."""

    @staticmethod
    def profiles(wanted):
        """The first four fields of each complete profile in the files that match, which may still be written."""
        raw = b"".join(pathlib.Path(path).read_bytes() for path in glob.glob(wanted))
        found, at = [], 0
        while at + 24 <= len(raw):
            length, kind = struct.unpack_from("<HH", raw, at + 2)
            if kind == 2198 and at + 10 + length <= len(raw):
                found.append(struct.unpack_from("<IIII", raw, at + 8))
            at += 10 + length
        return found

    def test_every_profile_of_the_log_is_read_with_its_range_and_number(self):
        from pingverter.cerulean_class import cerul
        with tempfile.TemporaryDirectory() as folder:
            daemon = Daemon("omniscan450.toml", "record.directory=%s" % folder, "sonar.0.output.ping.listen=127.0.0.1:0", "sonar.1.output.ping.listen=127.0.0.1:0")
            daemon.address("ping port tcp")
            paths = [os.path.join(folder, side + "-*.svlog") for side in ("port", "starboard")]
            patience = time.monotonic() + 60.0
            while time.monotonic() < patience and any(len(self.profiles(path)) < 10 for path in paths):
                time.sleep(0.5)
            daemon.stop()
            for wanted in paths:
                path, = glob.glob(wanted)
                profiles = self.profiles(path)
                self.assertGreaterEqual(len(profiles), 10)
                log = cerul(path)
                # Its own caller sets these two.
                log.metaDir, log.tempC = folder, 1.2
                with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    log._getFileLen()
                    log._parseFileHeader()
                    log._locatePackets()
                table = log.header_dat
                self.assertEqual(len(table), len(profiles))
                first = table.iloc[0]
                self.assertEqual((first["max_range"], first["ping_cnt"]), (50.0, 600))
                self.assertAlmostEqual(first["pixM"], 50.0 / 600, places=9)
                times = table["time_s"].to_numpy(dtype=float)
                np.testing.assert_allclose(times, [ms / 1e3 for _, _, _, ms in profiles], atol=1e-6)
                # A busy machine skips pings, but those that are sent keep to the schedule of 5 a second.
                steps = np.diff(times) / 0.2
                self.assertGreaterEqual(steps.min(), 0.99)
                np.testing.assert_allclose(steps, np.round(steps), atol=0.02)


if __name__ == "__main__":
    warnings.simplefilter("error")
    unittest.main()
