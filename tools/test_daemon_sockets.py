"""The daemon's sockets of families whose manufacturers' clients are not available as packages: JSF (EdgeTech), WBMS (NORBIT), Imagenex 872.
Commands and records are encoded and decoded here from the published layouts, without the emulator's code; pyjsf also reads the JSF data connection.

The program is target/release/echotank, or ECHOTANK.
"""

import os
import socket
import struct
import tempfile
import time
import unittest
import warnings
import zlib

import numpy as np

from test_daemon_readers import Daemon, PATIENCE_S, SOUND_M_PER_S, needs_310

THIN = "scene.seabed.density_per_m2=1.0"


class Connection:
    """Bytes of a TCP connection, with an end to waiting."""

    def __init__(self, case, address):
        self.socket = socket.create_connection(address, PATIENCE_S)
        self.socket.settimeout(PATIENCE_S)
        case.addCleanup(self.socket.close)
        self.pending = b""
        self.seen = b""

    def send(self, raw):
        self.socket.sendall(raw)

    def take(self, count):
        while len(self.pending) < count:
            more = self.socket.recv(65536)
            if not more:
                raise AssertionError("the daemon hung up")
            self.pending += more
        taken, self.pending = self.pending[:count], self.pending[count:]
        self.seen += taken
        return taken


# ---------------------------------------------------------------- JSF

SET, GET, REPLY, ERROR = 0, 1, 2, 3
PING, PING_RATE, PING_RANGE, ALIVE = 120, 124, 128, 41
SUBSYSTEM = 20


def jsf(kind, command, value=None, subsystem=SUBSYSTEM, channel=0, sequence=7):
    body = b"" if value is None else struct.pack("<i", value)
    return struct.pack("<HBBHBBBBHI", 0x1601, 0x0D, 1, kind, command, subsystem, channel, sequence, 0, len(body)) + body


class Message:
    def __init__(self, connection):
        head = connection.take(16)
        marker, _, _, self.kind, self.command, self.subsystem, self.channel, self.sequence, _, size = struct.unpack("<HBBHBBBBHI", head)
        if marker != 0x1601:
            raise AssertionError("marker %#x" % marker)
        self.body = connection.take(size)
        self.raw = head + self.body

    def value(self):
        return struct.unpack_from("<i", self.body)[0]


class Trace:
    """Of message 80 what is looked at here."""

    def __init__(self, body):
        msb = struct.unpack_from("<H", body, 16)[0]
        self.seconds, = struct.unpack_from("<i", body, 0)
        self.number, = struct.unpack_from("<I", body, 8)
        self.format, = struct.unpack_from("<h", body, 34)
        self.samples = struct.unpack_from("<H", body, 114)[0] + (((msb >> 8) & 15) << 16)
        self.interval_ns, = struct.unpack_from("<I", body, 116)
        self.sound_m_per_s, = struct.unpack_from("<f", body, 148)
        self.exponent, = struct.unpack_from("<h", body, 168)
        self.millis_of_day, = struct.unpack_from("<I", body, 200)
        self.volts = np.frombuffer(body, "<i2", self.samples, 240) * 2.0**-self.exponent

    def range_m(self):
        return 0.5 * self.sound_m_per_s * self.samples * self.interval_ns * 1e-9


class Jsf(unittest.TestCase):
    def start(self):
        daemon = Daemon("edgetech.toml", "sonar.output.jsf.listen=127.0.0.1:0", "sonar.output.jsf.listen_data=127.0.0.1:0", THIN)
        self.addCleanup(daemon.process.kill)
        return daemon

    def next_traces(self, data, wanted):
        """Port and starboard of the first ping that is as wanted."""
        until, port = time.monotonic() + PATIENCE_S, None
        while time.monotonic() < until:
            message = Message(data)
            if message.kind != 80:
                continue
            self.assertEqual((message.subsystem, message.command), (SUBSYSTEM, REPLY))
            trace = Trace(message.body)
            if message.channel == 0:
                port = trace
            elif port is not None and port.number == trace.number and wanted(port) and wanted(trace):
                return port, trace
        raise AssertionError("no such ping")

    def test_a_client_on_two_sockets_is_answered_and_obeyed(self):
        daemon = self.start()
        commands = Connection(self, daemon.address("jsf low"))
        data = Connection(self, daemon.address("jsf-data low"))
        commands.send(jsf(ALIVE, SET, 4711))
        self.assertEqual(Message(commands).value(), 4711)
        for range_m, per_s in ((60, 4), (30, 2)):
            commands.send(jsf(PING_RANGE, SET, range_m * 1000) + jsf(PING_RATE, SET, per_s * 1000))
            # All is well: a SET has no answer, the next thing heard is the reply to this.
            commands.send(jsf(PING_RANGE, GET, sequence=99))
            reply = Message(commands)
            self.assertEqual((reply.kind, reply.command, reply.sequence, reply.value()), (PING_RANGE, REPLY, 99, range_m * 1000))
            # The pulse is listened out, too.
            first = self.next_traces(data, lambda t: 0.0 <= t.range_m() - range_m < 3.5)
            second = self.next_traces(data, lambda t: True)
            self.assertEqual(second[0].number, first[0].number + 1)
            moment = lambda t: t.millis_of_day
            self.assertLess(abs((moment(second[0]) - moment(first[0])) % 86400000 - 1000 / per_s), 2.0)
            for trace in first + second:
                self.assertEqual(trace.format, 0)
                # 15 m of water less 0.8 m to the head and 3 m for heave and roll: silence, then sand.
                metres = np.arange(trace.samples) * trace.range_m() / trace.samples
                water, sand = trace.volts[(metres > 4.0) & (metres < 11.0)].mean(), trace.volts[(metres > 18.0) & (metres < 28.0)].mean()
                self.assertGreater(sand, 2.0 * water)
        commands.send(jsf(PING_RANGE, SET, 1000))
        refused = Message(commands)
        self.assertEqual((refused.kind, refused.command, refused.value()), (PING_RANGE, ERROR, 1))
        commands.send(jsf(999, GET))
        self.assertEqual((lambda m: (m.command, m.value()))(Message(commands)), (ERROR, 5))
        commands.send(jsf(PING, SET, 0))
        commands.send(jsf(PING, GET))
        self.assertEqual(Message(commands).value(), 0)
        data.socket.settimeout(2.0)
        with self.assertRaises((socket.timeout, TimeoutError), msg="told not to ping"):
            while True:
                Message(data)
        daemon.stop()

    @needs_310
    def test_pyjsf_reads_what_the_data_socket_says(self):
        from pyjsf.jsf_io import jsf_read
        daemon = self.start()
        data = Connection(self, daemon.address("jsf-data low"))
        data.seen = b""
        traces = []
        while len(traces) < 6:
            message = Message(data)
            if message.kind == 80:
                traces.append((message.channel, Trace(message.body)))
        daemon.stop()
        with tempfile.TemporaryDirectory() as folder:
            path = os.path.join(folder, "socket.jsf")
            with open(path, "wb") as file:
                file.write(data.seen)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                messages = jsf_read(path)
        read = [m for m in messages if m[0].message_type == 80]
        self.assertEqual(len(read), 6)
        for (channel, ours), (head, theirs, volts) in zip(traces, read):
            self.assertEqual((head.channel_number, head.subsystem_number), (channel, SUBSYSTEM))
            self.assertEqual((theirs.ping_number, theirs.sampling_interval), (ours.number, ours.interval_ns))
            np.testing.assert_array_equal(volts, ours.volts)


# ---------------------------------------------------------------- WBMS


class Wbms(unittest.TestCase):
    def line(self, connection):
        text = b""
        while not text.endswith(b"\r\n"):
            text += connection.take(1)
        return text.decode().strip()

    def packet(self, connection):
        head = connection.take(24)
        mark, kind, size, version, _, crc = struct.unpack("<6I", head)
        self.assertEqual((mark, version), (0xDEADBEEF, 4))
        payload = connection.take(size - 24)
        self.assertEqual(zlib.crc32(payload), crc)
        return kind, payload

    def test_text_commands_are_answered_and_the_bottom_is_where_it_is(self):
        daemon = Daemon("wbms.toml", "sonar.output.wbms.listen=127.0.0.1:0", "scene.seabed.density_per_m2=3.0")
        self.addCleanup(daemon.process.kill)
        control = Connection(self, daemon.address("wbms wbms control"))
        bathymetry = Connection(self, daemon.address("wbms wbms bathymetry"))
        self.assertIn("ready", self.line(control))
        control.send(b"set_range 0 30\r\n")
        self.assertEqual(self.line(control), "set_range 0 30")
        control.send(b"set_range 0 3000\r\n")
        self.assertRegex(self.line(control), r"^set_range 0 30\b.*#")
        control.send(b"set_rate 2\r\n")
        self.assertEqual(self.line(control), "set_rate 2")
        numbers, times = [], []
        until = time.monotonic() + PATIENCE_S
        while len(numbers) < 4:
            self.assertLess(time.monotonic(), until)
            kind, payload = self.packet(bathymetry)
            self.assertEqual(kind, 1)
            sound, rate, count, number = struct.unpack_from("<ffII", payload, 0)
            sent, = struct.unpack_from("<d", payload, 16)
            per_s, = struct.unpack_from("<f", payload, 32)
            if per_s > 2.5:
                continue
            self.assertAlmostEqual(sound, SOUND_M_PER_S, places=2)
            depths = []
            for k in range(count):
                sample, angle = struct.unpack_from("<If", payload, 88 + 20 * k)
                depths.append(0.5 * sound * sample / rate * np.cos(angle))
            self.assertGreater(count, 100)
            # 12 m less the head's 0.8 m, and heave.
            self.assertAlmostEqual(float(np.median(depths)), 11.2, delta=0.5)
            numbers.append(number)
            times.append(sent)
        self.assertEqual(numbers, list(range(numbers[0], numbers[0] + 4)))
        np.testing.assert_allclose(np.diff(times), 0.5, atol=1e-3)
        daemon.stop()


# ---------------------------------------------------------------- Imagenex 872


def switch(range_m, gain, side):
    command = bytearray(27)
    command[0], command[1], command[3], command[7], command[8], command[10], command[18], command[26] = 0xFE, 0x44, range_m, 1, gain, 30, side, 0xFD
    return bytes(command)


class Imagenex(unittest.TestCase):
    def test_every_switch_command_is_answered_by_a_line_of_its_range(self):
        daemon = Daemon("edgetech.toml", "sonar.output.jsf.listen=127.0.0.1:0", "sonar.output.jsf.listen_data=127.0.0.1:0", 'sonar.0.output.imagenex872={listen="127.0.0.1:0"}', THIN)
        self.addCleanup(daemon.process.kill)
        head = Connection(self, daemon.address("imagenex872 low"))
        firsts = []
        for range_m, side in ((40, 0), (40, 2), (80, 0)):
            for _ in range(2):
                # The second answer is of a ping that has obeyed the first.
                head.send(switch(range_m, 60, side))
                answer = head.take(1013)
                self.assertEqual((answer[:3], answer[1012]), (b"IMX", 0xFC))
            echo = np.frombuffer(answer, np.uint8, 1000, 12).astype(float)
            metres = (np.arange(1000) + 0.5) * range_m / 1000
            self.assertGreater(echo[(metres > 18.0) & (metres < 28.0)].mean(), echo[(metres > 4.0) & (metres < 11.0)].mean())
            firsts.append(metres[np.argmax(echo > 0.1 * echo.max())])
        # The bottom begins at 14 m, faintly (straight below lies beside the beam), whatever the range.
        for first in firsts:
            self.assertTrue(13.0 < first < 22.0, firsts)
        daemon.stop()


if __name__ == "__main__":
    warnings.simplefilter("error")
    unittest.main()
