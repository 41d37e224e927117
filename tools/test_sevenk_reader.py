"""Tests of the 7k reader: hand-made bytes, and a small server with faults planted one at a time that it has to find."""

import contextlib
import io
import json
import os
import socket
import struct
import sys
import tempfile
import threading
import time
import types
import unittest
import unittest.mock

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import sevenk_reader as reader  # noqa: E402

SONAR, SERIAL = 7125, 77001
XML = b"<?xml version='1.0'?><SonarInformation/>\0"
C, FS = 1500.0, 20000.0


def record(kind, body, stamp, device=SONAR, optional=b"", optional_id=0):
    """A whole record. `stamp` is (year, day, seconds, hours, minutes)."""
    size = 64 + len(body) + len(optional) + 4
    year, day, seconds, hours, minutes = stamp
    raw = struct.pack("<HHIIIIHHfBBHIIHHIHHIII", 5, 60, 0xFFFF, size, 64 + len(body) if optional else 0, optional_id,
                      year, day, seconds, hours, minutes, 1, kind, device, 0, 0, 0, 1, 0, 0, 0, 0)
    assert len(raw) == 64
    raw += body + optional
    return raw + struct.pack("<I", sum(raw) & 0xFFFFFFFF)


def stamp_of(seconds_since_epoch):
    t = time.gmtime(seconds_since_epoch)
    return (t.tm_year, t.tm_yday, t.tm_sec + seconds_since_epoch % 1.0, t.tm_hour, t.tm_min)


NOON = (2025, 165, 30.25, 12, 0)


def settings(ping, values, flags=1 << 31, remote=False, ping_state=1):
    """7000 (156 bytes), or with `remote` 7503 (260 bytes): the same fields, two bytes earlier."""
    out = bytearray(260 if remote else 156)
    shift = -2 if remote else 0
    struct.pack_into("<QI", out, 0, SERIAL, ping)
    struct.pack_into("<ffff", out, 14 + shift, 400e3, FS, 20e3, values["pulse"])
    struct.pack_into("<II", out, 30 + shift, 1, 4)
    struct.pack_into("<H", out, 42 + shift, 1)
    struct.pack_into("<fffffI", out, 46 + shift, values["rate"], 1.0 / values["rate"], values["range"], values["power"], values["gain"], flags)
    tail = 136 if remote else 142
    struct.pack_into("<fff", out, tail, 100.0, C, 30.0)
    if remote:
        struct.pack_into("<I", out, 174, ping_state)
    return bytes(out)


def count_samples(values):
    return int(2.0 * values["range"] * FS / C)


def beam_geometry(n):
    return struct.pack("<QI", SERIAL, n) + struct.pack("<%df" % (4 * n), *([0.0] * n + [0.1 * i - 0.2 for i in range(n)] + [0.02] * 2 * n))


def side_scan(ping, samples):
    return struct.pack("<QIHfIII7fHHBB", SERIAL, ping, 0, 0.0, 0, samples, 0, *([0.0] * 7), 1, 0, 2, 0) + bytes(4 * samples)


def beamformed(ping, beams, samples):
    return struct.pack("<QIHHI8I", SERIAL, ping, 0, beams, samples, *([0] * 8)) + bytes(4 * beams * samples)


def elements(ping, n, samples):
    head = struct.pack("<QIHHIHIIH7I", SERIAL, ping, 0, n, samples, n, 0, samples - 1, 16, *([0] * 7))
    return head + struct.pack("<%dH" % n, *range(n)) + bytes(4 * n * samples)


def configuration():
    return struct.pack("<QI", SERIAL, 1) + struct.pack("<I60sIQI", SONAR, b"Test sonar", 0x400, SERIAL, len(XML)) + XML


def file_bytes():
    """A whole .s7k file: 7200, 7001, two pings, 7300."""
    values = {"range": 30.0, "power": 200.0, "gain": 10.0, "pulse": 1e-3, "rate": 5.0}
    n = count_samples(values)
    body = struct.pack("<QQHHQQII64s16s64s128s", 1, 2, 1, 0, 3, 4, 0, 1, b"test", b"0", b"", b"") + struct.pack("<IH", SONAR, 0)
    records = [None, (7001, configuration(), NOON)]
    for ping, stamp in ((1, NOON), (2, (2025, 165, 30.5, 12, 0))):
        records += [(7000, settings(ping, values), stamp), (7004, beam_geometry(5), stamp), (7007, side_scan(ping, n), stamp),
                    (7018, beamformed(ping, 5, n), stamp), (7038, elements(ping, 4, n), stamp)]
    whole = [record(7200, body, NOON, 7004, bytes(12), 7300)] + [record(*r) for r in records[1:]]
    rows, at = b"", 0
    for raw in whole:
        rows += struct.pack("<IQHHH10sI16x", len(raw), at, struct.unpack_from("<I", raw, 32)[0], struct.unpack_from("<I", raw, 36)[0], 0,
                            raw[20:30], 0)
        at += len(raw)
    last = record(7300, struct.pack("<IHII", 14, 1, len(whole), 0) + rows, NOON, 7004)
    whole[0] = record(7200, body, NOON, 7004, struct.pack("<IQ", len(last), at), 7300)
    return b"".join(whole + [last])


class Bytes(unittest.TestCase):
    def verify(self, data):
        findings = reader.Findings()
        with tempfile.TemporaryDirectory() as folder:
            path = os.path.join(folder, "x.s7k")
            with open(path, "wb") as stream:
                stream.write(data)
            summary = reader.read_file(path, findings)
        return findings, summary

    def test_a_sound_file_has_no_findings(self):
        findings, summary = self.verify(file_bytes())
        self.assertEqual(findings.lines, [])
        self.assertEqual(summary["pings"], 2)
        self.assertEqual(summary["records"], {"7000": 2, "7001": 1, "7004": 2, "7007": 2, "7018": 2, "7038": 2, "7200": 1, "7300": 1})

    def test_every_single_flipped_byte_of_a_file_is_found(self):
        sound = file_bytes()
        for at in range(0, len(sound), 97):
            broken = bytearray(sound)
            broken[at] ^= 0x20
            findings, _ = self.verify(bytes(broken))
            self.assertGreater(findings.total, 0, "byte %d" % at)

    def test_a_file_cut_anywhere_is_found_and_never_raises(self):
        sound = file_bytes()
        for end in range(1, len(sound), 211):
            findings, _ = self.verify(sound[:end])
            self.assertGreater(findings.total, 0, "cut at %d" % end)

    def test_a_wrong_catalogue_row_is_found_though_its_checksum_is_right(self):
        data = bytearray(file_bytes())
        body = data.rindex(struct.pack("<IHII", 14, 1, 12, 0))
        data[body + 14 + 48 + 4] ^= 1       # the offset in the second row
        start = body - 64
        struct.pack_into("<I", data, len(data) - 4, sum(data[start:-4]) & 0xFFFFFFFF)
        findings, _ = self.verify(bytes(data))
        self.assertEqual(findings.counts, {"catalogue": 1})

    def test_settings_decode_to_the_values_put_in(self):
        values = {"range": 75.0, "power": 210.0, "gain": 12.5, "pulse": 0.005, "rate": 4.0}
        for kind in (7000, 7503):
            findings = reader.Findings()
            got = reader.parse_record(record(kind, settings(9, values, remote=kind == 7503), NOON), "test", findings)
            self.assertEqual(findings.lines, [])
            self.assertEqual((got.header["ping_number"], got.header["range_selection"], got.header["gain_selection"]), (9, 75.0, 12.5))
            self.assertEqual((got.header["sound_velocity"], got.stamp_ns), (1500.0, 1749902430250000000))    # 14 June 2025 12:00:30.25
        self.assertEqual(got.header["ping_state"], 1)

    def test_a_record_in_three_packets_comes_back_whole(self):
        raw = record(7018, beamformed(1, 5, 700), NOON)
        findings = reader.Findings()
        packets = reader.Reassembler(findings)
        stream = b"".join(frames(raw, 6000, 5))
        got = [r for i in range(0, len(stream), 1000) for r in packets.feed(stream[i:i + 1000])]
        self.assertEqual((got, findings.lines), ([raw], []))
        self.assertEqual((packets.packets, packets.fragmented), (3, 1))

    def test_unequal_or_misnumbered_packets_are_found(self):
        raw = record(7018, beamformed(1, 5, 700), NOON)
        one, two, three = frames(raw, 6000, 5)
        findings = reader.Findings()
        packets = reader.Reassembler(findings)
        with self.assertRaises(reader.ProtocolError):
            packets.feed(one + three)
        short = struct.pack("<HHIHHIIIIHHI", 5, 36, 3, 1, 6, 36 + 5000, len(raw), 1, 0, 0, 0, 0) + raw[6000:11000]
        last = struct.pack("<HHIHHIIIIHHI", 5, 36, 3, 1, 6, 36 + len(raw) - 11000, len(raw), 2, 0, 0, 0, 0) + raw[11000:]
        packets = reader.Reassembler(findings)
        packets.feed(frames(raw, 6000, 6)[0] + short + last)
        self.assertEqual(findings.counts, {"packet": 1})

    def test_a_command_without_arguments_carries_one_empty_byte(self):
        packet = reader.build_command(1100, ticket=5, tracking=bytes(range(16)))
        self.assertEqual(len(packet), 36 + 64 + 24 + 1 + 4)
        findings = reader.Findings()
        got = reader.parse_record(packet[36:], "test", findings)
        self.assertEqual(findings.lines, [])
        self.assertEqual(got.header, {"remote_control_id": 1100, "ticket": 5, "tracking_number": bytes(range(16))})


def frames(raw, limit, transmission):
    parts = [raw[i:i + limit] for i in range(0, len(raw), limit)]
    return [struct.pack("<HHIHHIIIIHHI", 5, 36, len(parts), 1, transmission & 0xFFFF, 36 + len(p), len(raw), i, 0, 0, 0, 0) + p
            for i, p in enumerate(parts)]


class Server(threading.Thread):
    """A 7k server of one client: real-time pings of empty samples, and one planted fault."""

    def __init__(self, fault="", port=0, lifetime_s=30.0, limit=1000):
        super().__init__(daemon=True)
        self.fault = fault
        self.limit = limit
        self.lifetime_s = lifetime_s
        self.listener = socket.create_server(("127.0.0.1", port))
        self.port = self.listener.getsockname()[1]
        self.values = {"range": 3.0, "power": 200.0, "gain": 10.0, "pulse": 1e-3, "rate": 50.0}
        self.kinds, self.pinging, self.ping, self.transmission = [], True, 0, 0

    def run(self):
        with self.listener, contextlib.suppress(OSError):
            self.client, _ = self.listener.accept()
            with self.client:
                self.serve()

    def send(self, kind, body, stamp=None, device=SONAR):
        raw = record(kind, body, stamp or stamp_of(time.time()), device)
        if self.fault == "checksum" and kind == 7018:
            raw = raw[:-4] + b"\0\0\0\0"
        self.transmission += 1
        self.client.sendall(b"".join(frames(raw, self.limit, self.transmission)))

    def serve(self):
        end, due, buffer = time.monotonic() + self.lifetime_s, time.time(), b""
        while time.monotonic() < end:
            self.client.settimeout(max(0.0005, min(0.05, due - time.time())))
            try:
                data = self.client.recv(65536)
                if not data:
                    return
                buffer += data
            except (socket.timeout, BlockingIOError):
                pass
            while len(buffer) >= 36 and len(buffer) >= struct.unpack_from("<I", buffer, 12)[0]:
                size = struct.unpack_from("<I", buffer, 12)[0]
                self.command(buffer[36 + 64:size - 4])
                buffer = buffer[size:]
            if time.time() >= due:
                if self.pinging and self.kinds:
                    self.send_ping(due)
                due = max(due + 1.0 / self.values["rate"], time.time())

    def send_ping(self, when):
        self.ping += 2 if self.fault == "gap" and self.ping == 5 else 1
        values, n = self.values, count_samples(self.values)
        if self.fault == "samples-stay":
            n = 80
        flags = 0 if self.fault == "no-simulator-bit" else 1 << 31
        other = dict(values, gain=99.0) if self.fault == "settings-differ" else values
        made = [(7000, settings(self.ping, values, flags)), (7503, settings(self.ping, other, flags, True)), (7004, beam_geometry(5)),
                (7007, side_scan(self.ping, n)), (7018, beamformed(self.ping, 5, n)), (7038, elements(self.ping, 4, n))]
        if self.fault == "7000-last":
            made = made[1:] + made[:1]
        for kind, body in made:
            if kind in self.kinds and not (self.fault == "drops-one" and kind == 7007 and self.ping == 5):
                sent = when + values["pulse"]    # 7KTIME is the end of the transmission
                self.send(kind, body, stamp_of(sent + (0.001 if self.fault == "stamps" and kind == 7038 else 0.0)))
        for kind, body in ((7610, struct.pack("<fff", C, 283.0, 0.0)), (1003, struct.pack("<IfdddBBBBB", 0, 0, 0.9, 0.2, 0, 0, 0, 0, 0, 9)),
                           (1012, struct.pack("<fff", 0.01, 0.02, 0.3)), (1013, struct.pack("<f", 1.0))):
            if kind in self.kinds:
                self.send(kind, body)

    def command(self, body):
        command, ticket = struct.unpack_from("<II", body)
        tracking, arguments = body[8:24], body[24:]
        if self.fault == "tracking":
            tracking = bytes(16)

        def ack():
            self.send(7501, struct.pack("<I", ticket) + tracking)

        def nack(code):
            self.send(7502, struct.pack("<I", ticket) + tracking + struct.pack("<I", code))

        fields = {1003: "range", 1004: "rate", 1005: "power", 1006: "pulse", 1008: "gain"}
        if command in fields:
            value = struct.unpack_from("<f", arguments)[0]
            if command == 1003 and not 1.0 <= value <= 500.0 and self.fault != "takes-any-range":
                return nack(0x7008 if self.fault == "nack-code" else 0x7001)
            if self.fault == "ignores-" + fields[command]:
                return ack()
            if 1003 == command and not 1.0 <= value <= 500.0:
                return ack()
            ack()
            if self.fault == "late":
                threading.Timer(0.3, self.values.__setitem__, (fields[command], value)).start()
            else:
                self.values[fields[command]] = value
            if 7500 in self.kinds and self.fault != "no-echo":
                self.send(7500, body)
        elif command == 1050:
            kind = struct.unpack_from("<I", arguments)[0]
            if kind == 7001:
                ack()
                self.send(7001, configuration())
            elif kind == 7503:
                ack()
                self.send(7503, settings(0, self.values, 1 << 31, True, int(self.pinging)))
            else:
                nack(0x7002)
        elif command in (1051, 1056):
            ids = list(struct.unpack_from("<%dI" % struct.unpack_from("<I", arguments)[0], arguments, 4))
            ack()
            if command == 1051:
                self.kinds = [k for k in self.kinds if k not in ids] + ids
            elif self.fault != "unsubscribe":
                self.kinds = [k for k in self.kinds if k not in ids]
        elif command == 1052:
            ack()
            if self.fault != "never-ends":
                self.kinds = []
        elif command in (1100, 1101):
            ack()
            self.pinging = command == 1100 or self.fault == "never-stops"
        else:
            nack(0x7007)


def run_reader(server, *arguments):
    server.start()
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        code = reader.main(["--connect", "127.0.0.1:%d" % server.port, "--seconds", "0.3", "--json", *arguments])
    return code, json.loads(out.getvalue())


class Live(unittest.TestCase):
    def test_a_sound_server_passes_the_whole_sequence(self):
        code, summary = run_reader(Server(), "--sequence")
        self.assertEqual(summary["finding_lines"], [])
        self.assertEqual([s for s in summary["steps"] if not s["ok"]], [])
        self.assertEqual(code, 0)
        self.assertGreater(summary["fragmented_records"], 0)
        self.assertEqual(len(summary["steps"]), 16)

    def test_every_planted_fault_fails_at_its_own_step(self):
        for fault, step, where in (
                ("gap", "", "gap"), ("checksum", "", "checksum"), ("no-simulator-bit", "", "simulator"), ("stamps", "", "time"),
                ("7000-last", "", "order"), ("drops-one", "", "missing"), ("settings-differ", "", "settings"), ("tracking", "", "reply"),
                ("samples-stay", "range", "range 1003"), ("ignores-range", "range", "range 1003"), ("late", "range", "range 1003"),
                ("no-echo", "range", "range 1003"), ("takes-any-range", "bad-range", "bad range 1003"),
                ("nack-code", "bad-range", "bad range 1003"), ("ignores-power", "power", "power 1005"), ("ignores-gain", "gain", "gain 1008"),
                ("ignores-pulse", "pulse", "pulse length 1006"), ("ignores-rate", "rate", "rate 1004"),
                ("never-stops", "stop", "stop 1101, start 1100"), ("unsubscribe", "unsubscribe", "unsubscribe 1056"),
                ("never-ends", "end", "end subscriptions 1052")):
            with self.subTest(fault=fault):
                code, summary = run_reader(Server(fault), "--steps", step)
                self.assertEqual(code, 1)
                failed = [s["step"] for s in summary["steps"] if not s["ok"]]
                self.assertIn(where, failed + list(summary["finding_counts"]), summary)

    def test_packets_over_the_limit_are_found(self):
        with unittest.mock.patch.object(reader, "MAX_PACKET", 1000):
            code, summary = run_reader(Server(limit=70000))
        self.assertEqual((code, list(summary["finding_counts"])), (1, ["packet"]))

    def test_a_ping_obeys_what_was_acknowledged_before_its_pulse(self):
        def ping(stamp_s, pulse_s, range_m):
            header = {"ping_number": 1, "tx_pulse_width": pulse_s, "range_selection": range_m}
            return reader.Ping(types.SimpleNamespace(header=header, stamp_ns=round(1e9 * stamp_s)))

        def judge(stamp_s, range_m):
            pings = [ping(99.0, 3e-3, 150.0), ping(stamp_s, 3e-3, range_m), ping(101.0, 3e-3, 90.0)]
            contract = reader.Contract(types.SimpleNamespace(pings=pings), 1.0)
            reply = types.SimpleNamespace(stamp_ns=round(100e9))
            return contract.judge(reply, 1, lambda p: p.settings["range_selection"] == 90.0, lambda p: "the range")

        self.assertEqual(judge(100.002, 150.0)[0].settings["range_selection"], 90.0)    # the command came during its pulse
        judge(100.004, 90.0)
        with self.assertRaises(reader.StepFailed):
            judge(100.004, 150.0)

    def test_no_server_is_a_finding_and_not_a_crash(self):
        with socket.create_server(("127.0.0.1", 0)) as taken:
            port = taken.getsockname()[1]
        with contextlib.redirect_stdout(io.StringIO()):
            self.assertEqual(reader.main(["--connect", "127.0.0.1:%d" % port]), 1)


if __name__ == "__main__":
    unittest.main()
