#!/usr/bin/env python3
"""An independent reader and client of the 7k protocol, for checking a 7k server or a .s7k file.

Written from the byte tables of the public 7k data format definition, not from the encoder it checks; standard library only.

    sevenk_reader.py FILE.s7k ...                     verify files: frames, checksums, catalogue, order and timing of pings
    sevenk_reader.py --connect HOST:PORT --seconds 5  subscribe over TCP and verify every packet and record
    sevenk_reader.py --connect HOST:PORT --sequence   the whole remote-control contract in one run, as a table
    sevenk_reader.py --connect HOST:PORT --steps range,gain   some of its steps

Exit code 0: no findings. 1: findings (each prints the actual and the expected value). 2: wrong usage.

It decodes what the contract and the checks of pings need. protocols/tests/it compares every field of every record with its byte table, and
points_check.py checks the physics of the samples.
"""

import argparse
import datetime
import json
import math
import os
import socket
import statistics
import struct
import sys
import time
import xml.etree.ElementTree

# ---------------------------------------------------------------------------------------------------------------------
# Layouts: the fixed part of each record, its size and the fields that are looked at, as offset and type.

NETWORK_FRAME, RECORD_FRAME = struct.Struct("<HHIHHIIIIHHI"), struct.Struct("<HHIIIIHHfBBHIIHHIHHIII")
CATALOGUE_ROW = struct.Struct("<IQHHH10s20x")

SETTINGS = {
    "sonar_id": (0, "Q"), "ping_number": (8, "I"), "frequency": (14, "f"), "sample_rate": (18, "f"), "tx_pulse_width": (26, "f"),
    "max_ping_rate": (46, "f"), "ping_period": (50, "f"), "range_selection": (54, "f"), "power_selection": (58, "f"),
    "gain_selection": (62, "f"), "control_flags": (66, "I"), "sound_velocity": (146, "f")}
PING = {"sonar_id": (0, "Q"), "ping_number": (8, "I")}
HEADERS = {
    1003: (37, {"latitude": (8, "d"), "longitude": (16, "d"), "position_type": (32, "B")}),
    1012: (12, {"roll": (0, "f"), "pitch": (4, "f"), "heave": (8, "f")}),
    1013: (4, {"heading": (0, "f")}),
    7000: (156, SETTINGS),
    7001: (12, {"sonar_id": (0, "Q"), "n_devices": (8, "I")}),
    7004: (12, {"sonar_id": (0, "Q"), "n_beams": (8, "I")}),
    7007: (64, {**PING, "n_samples": (22, "I"), "bytes_per_sample": (62, "B")}),
    7018: (52, {**PING, "n_beams": (14, "H"), "n_samples": (16, "I")}),
    7038: (60, {**PING, "n_samples": (16, "I"), "elements": (20, "H"), "start_sample": (22, "I"), "stop_sample": (26, "I")}),
    7200: (316, {"n_devices": (40, "I")}),
    7300: (14, {"header_size": (0, "I"), "n_records": (6, "I")}),
    7500: (24, {"remote_control_id": (0, "I"), "ticket": (4, "I"), "tracking_number": (8, "16s")}),
    7501: (20, {"ticket": (0, "I"), "tracking_number": (4, "16s")}),
    7502: (24, {"ticket": (0, "I"), "tracking_number": (4, "16s"), "error_code": (20, "I")}),
    # The fields of 7000 without the sequence number, and from the beam width on without that too.
    7503: (260, {**{name: (at - (0 if at < 14 else 2 if at < 122 else 6), code) for name, (at, code) in SETTINGS.items()},
                 "ping_state": (174, "I")}),
    7610: (12, {"sound_velocity": (0, "f")}),
}
# Blocks of bytes that 7503 repeats from its ping's 7000, without reserved fields: where in 7000, where in 7503, length.
REPEATED = [(14, 12, 30), (46, 44, 76), (126, 120, 28)]

# Bytes that follow the header.
BODY_BYTES = {
    **dict.fromkeys((1003, 1012, 1013, 7000, 7501, 7502, 7503, 7610), lambda h: 0),
    7004: lambda h: 16 * h["n_beams"],
    7007: lambda h: 2 * h["bytes_per_sample"] * h["n_samples"],
    7018: lambda h: 4 * h["n_beams"] * h["n_samples"],
    7038: lambda h: h["elements"] * (2 + 4 * (h["stop_sample"] - h["start_sample"] + 1)),
    7200: lambda h: 6 * h["n_devices"],
    7300: lambda h: CATALOGUE_ROW.size * h["n_records"],
}
# Limits of values, SI units and radians.
ABOVE_0 = (5e-324, math.inf)
PLAUSIBLE = {
    1003: {"latitude": (-math.pi / 2, math.pi / 2), "longitude": (-math.pi - 1e-9, math.pi + 1e-9)},
    1012: {"roll": (-math.pi, math.pi), "pitch": (-math.pi / 2 - 1e-6, math.pi / 2 + 1e-6)},
    1013: {"heading": (-1e-6, 2 * math.pi + 1e-6)},
    7007: {"bytes_per_sample": (1, 4)},
    7610: {"sound_velocity": (1300.0, 1700.0)},
    **dict.fromkeys((7000, 7503), dict.fromkeys(("frequency", "sample_rate", "tx_pulse_width", "range_selection", "sound_velocity"), ABOVE_0)),
}

SYNC_PATTERN = 0x0000FFFF
CHECKSUM_VALID = 1
CENTER_DEVICE_ID = 7000
MAX_PACKET = 60000
LARGEST_RECORD = 1 << 30  # a size beyond this is a lost frame, not a record

ERROR_NAMES = {
    0x7000: "SYSTEM_NOT_READY", 0x7001: "PARAMETER_OUT_OF_RANGE", 0x7002: "RECORD_NOT_AVAILABLE", 0x7007: "REMOTE_COMMAND_NOT_FOUND",
    0x7008: "INVALID_PARAMETER", 0x7009: "INVALID_DEVICE_ID", 0x700B: "PARAMETER_VALUE_CLIPPED", 0x700C: "REMOTE_COMMAND_DENIED"}

RANGE, MAX_RATE, POWER, PULSE_LENGTH, GAIN = 1003, 1004, 1005, 1006, 1008
SINGLE_REQUEST, SUBSCRIBE, END_SUBSCRIPTIONS, UNSUBSCRIBE = 1050, 1051, 1052, 1056
START_PINGING, STOP_PINGING = 1100, 1101

# Order in which the records of one ping are sent.
PING_ORDER = [7000, 7503, 1750, 7002, 7004, 7017, 7006, 7027, 7007, 7008, 7010, 7011, 7012, 7013, 7018, 7019, 7028, 7029, 7037,
              7038, 7039, 7041, 7042, 7048, 7049, 7057, 7058, 7068, 7070]
SUBSCRIPTION = [7000, 7503, 7004, 7007, 7018, 7038, 7610, 1003, 1012, 1013, 7500]

# 7KTIME keeps the seconds as f32: just under 60 s one step is 3.8 us.
STAMP_STEP_NS = 4000
# Replies and pings stamped farther apart than this use different clocks (a log's and the host's).
SAME_CLOCK_S = 30.0
REPLY_TIMEOUT_S = 5.0


# ---------------------------------------------------------------------------------------------------------------------
# Findings

class Findings:
    """Findings as text; repeated kinds are counted instead of printed again."""

    SHOWN_PER_KIND = 5

    def __init__(self):
        self.counts = {}
        self.lines = []

    def add(self, kind, text):
        self.counts[kind] = self.counts.get(kind, 0) + 1
        if self.counts[kind] <= self.SHOWN_PER_KIND:
            self.lines.append("%s: %s" % (kind, text))

    def check(self, kind, where, what, got, expected):
        """True when got == expected, a finding otherwise."""
        if got != expected:
            self.add(kind, "%s: %s: got %s, expected %s" % (where, what, got, expected))
        return got == expected

    @property
    def total(self):
        return sum(self.counts.values())


class ProtocolError(Exception):
    """The byte stream cannot be followed any further."""


# ---------------------------------------------------------------------------------------------------------------------
# Records

class Record:
    """One 7k record: its frame, and its header as a dictionary where the type is known."""

    def __init__(self, raw, where):
        (_, _, _, _, self.optional_at, self.optional_id, year, day, seconds, hours, minutes, _, self.kind, self.device_id, reserved,
         self.enumerator, more, self.flags, *rest) = RECORD_FRAME.unpack_from(raw)
        self.zeros = [reserved, more, *rest]
        self.raw = raw
        self.time = raw[20:30]
        self.stamp_ns = stamp_ns(year, day, hours, minutes, seconds)
        self.where = "%s record %d" % (where, self.kind)
        self.header = None
        self.body = raw[RECORD_FRAME.size:self.optional_at or len(raw) - 4]


def stamp_ns(year, day, hours, minutes, seconds):
    """UTC nanoseconds since 1970 of a 7KTIME, None if it is invalid."""
    if not (1 <= year <= 9999 and 1 <= day <= 366 and hours < 24 and minutes < 60 and 0.0 <= seconds <= 60.0):
        return None
    days = datetime.date(year, 1, 1).toordinal() + day - 1 - datetime.date(1970, 1, 1).toordinal()
    return (days * 86400 + hours * 3600 + minutes * 60) * 1_000_000_000 + round(seconds * 1e9)


def parse_record(raw, where, findings):
    """Checks one whole record and decodes its header. None if it cannot be decoded."""
    if len(raw) < RECORD_FRAME.size + 4:
        findings.add("frame", "%s: a record of %d bytes is shorter than its frame and checksum (68)" % (where, len(raw)))
        return None
    record = Record(raw, where)
    kind, where = record.kind, record.where
    if not findings.check("frame", where, "protocol version, offset, sync pattern, size", RECORD_FRAME.unpack_from(raw)[:4],
                          (5, 60, SYNC_PATTERN, len(raw))):
        return None
    findings.check("frame", where, "reserved fields and fields of fragments", record.zeros, [0] * 6)
    if record.stamp_ns is None:
        findings.add("time", "%s: not a time: %s" % (where, record.time.hex()))
    findings.check("checksum", where, "flag and sum of all bytes before the checksum",
                   (record.flags & CHECKSUM_VALID, struct.unpack_from("<I", raw, len(raw) - 4)[0]), (CHECKSUM_VALID, sum(raw[:-4]) & 0xFFFFFFFF))
    if record.optional_at and not RECORD_FRAME.size <= record.optional_at <= len(raw) - 4:
        findings.add("frame", "%s: optional data at %d, outside of the record" % (where, record.optional_at))
        return None
    size, fields = HEADERS.get(kind, (0, None))
    if len(record.body) < size:
        findings.add("size", "%s: %d bytes after the frame, its header has %d" % (where, len(record.body), size))
        return None
    if fields is None:
        return record
    header = record.header = {name: struct.unpack_from("<" + code, record.body, at)[0] for name, (at, code) in fields.items()}
    record.body = record.body[size:]
    if kind in BODY_BYTES:
        findings.check("size", where, "bytes of record data", len(record.body), BODY_BYTES[kind](header))
    if kind in (7000, 7503):
        findings.check("simulator", where, "control_flags bit 31 (simulator)", header["control_flags"] >> 31, 1)
    for name, (least, most) in PLAUSIBLE.get(kind, {}).items():
        # Projected positions are metres.
        if not least <= header[name] <= most and not header.get("position_type"):
            findings.add("value", "%s: %s: got %r, expected %g to %g" % (where, name, header[name], least, most))
    if kind == 7004 and len(record.body) == 16 * header["n_beams"]:
        across = struct.unpack_from("<%df" % header["n_beams"], record.body, 4 * header["n_beams"])
        if list(across) not in (sorted(set(across)), sorted(set(across), reverse=True)):
            findings.add("value", "%s: the across-track angles are not monotonic" % where)
    return record


# ---------------------------------------------------------------------------------------------------------------------
# Pings: what the records of one ping must agree on

class Ping:
    def __init__(self, record):
        self.number = record.header["ping_number"]
        self.stamp_ns = record.stamp_ns
        self.record = record
        self.settings = record.header
        self.samples = {}       # record type -> samples in it
        self.kinds = [7000]
        self.beams = None

    @property
    def pulse_ns(self):
        """Start of the pulse. Records of a ping are stamped with the end of the transmission (Data Format Definition, 7KTIME of 7000)."""
        return None if self.stamp_ns is None else self.stamp_ns - round(1e9 * self.settings["tx_pulse_width"])


class PingLedger:
    """Follows pings through a stream of records in order of arrival."""

    def __init__(self, findings, gapless=True):
        self.findings = findings
        self.gapless = gapless
        self.pings = []

    def take(self, record):
        kind, header = record.kind, record.header
        if kind == 7000:
            self._begin(record)
            return
        if kind not in PING_ORDER or (kind == 7503 and header["ping_number"] == 0):
            return
        if not self.pings:
            if kind != 7004:  # a stream may be joined in the middle of a ping
                self.findings.add("order", "%s: comes before any 7000" % record.where)
            return
        ping, check = self.pings[-1], self.findings.check
        where = "ping %d: %s" % (ping.number, record.where)
        for name in ("ping_number", "sonar_id"):
            if header is not None and name in header and not check("ping", where, name, header[name], ping.settings[name]):
                return
        if PING_ORDER.index(kind) <= PING_ORDER.index(ping.kinds[-1]):
            self.findings.add("order", "%s: comes after %d" % (where, ping.kinds[-1]))
        ping.kinds.append(kind)
        check("time", where, "7KTIME against that of the ping's 7000", record.time.hex(), ping.record.time.hex())
        if kind == 7503:
            for here, there, count in REPEATED:
                first, second = (raw[64 + at:64 + at + count].hex() for raw, at in ((ping.record.raw, here), (record.raw, there)))
                check("settings", where, "bytes of the ping's 7000 from %d" % here, second, first)
        elif kind == 7004:
            ping.beams = header["n_beams"]
        elif kind in (7007, 7018, 7038):
            self._samples(ping, where, kind, header["n_samples"])
            if kind == 7018 and ping.beams is not None:
                check("ping", where, "beams against 7004", header["n_beams"], ping.beams)

    def _begin(self, record):
        ping = Ping(record)
        if self.pings:
            before = self.pings[-1]
            if self.gapless:
                self.findings.check("gap", record.where, "ping number", ping.number, before.number + 1)
            if None not in (ping.stamp_ns, before.stamp_ns) and ping.stamp_ns <= before.stamp_ns:
                self.findings.add("time", "%s: ping %d is stamped %d ns before or at ping %d" % (
                    record.where, ping.number, before.stamp_ns - ping.stamp_ns, before.number))
        elif ping.number < 1:
            self.findings.add("ping", "%s: ping number %d, they start at 1" % (record.where, ping.number))
        self.pings.append(ping)

    def _samples(self, ping, where, kind, count):
        """Sample i lies at the range i c / (2 fs): the record must reach its range, and not go far beyond the pulse's end."""
        ping.samples[kind] = count
        s = ping.settings
        if not (s["sound_velocity"] > 0 and s["sample_rate"] > 0):
            return
        wanted = 2.0 * s["range_selection"] * s["sample_rate"] / s["sound_velocity"]
        slack = max(16.0, 0.02 * wanted) + s["tx_pulse_width"] * s["sample_rate"]
        if abs(count - wanted) > slack:
            self.findings.add("range", "%s: %d samples; %.6g m at %.6g Hz and %.6g m/s are %.1f (+- %.1f)" % (
                where, count, s["range_selection"], s["sample_rate"], s["sound_velocity"], wanted, slack))


# ---------------------------------------------------------------------------------------------------------------------
# Files

def read_file(path, findings):
    """Verifies one .s7k file. Returns a summary."""
    with open(path, "rb") as stream:
        data = stream.read()
    name = os.path.basename(path)
    ledger, kinds, rows, at = PingLedger(findings), [], [], 0
    pointer = record = None
    while at < len(data):
        where = "%s @%d" % (name, at)
        sync, size = struct.unpack_from("<II", data, at + 4) if at + RECORD_FRAME.size <= len(data) else (0, 0)
        if sync != SYNC_PATTERN or not 68 <= size <= len(data) - at:
            findings.add("frame", "%s: sync 0x%08X size %d with %d bytes left; the file cannot be followed further" % (
                where, sync, size, len(data) - at))
            break
        record = parse_record(data[at:at + size], where, findings)
        if record is not None:
            ledger.take(record)
            kinds.append(record.kind)
            rows.append((size, at, record.kind, record.device_id & 0xFFFF, record.enumerator, record.time))
            if record.kind == 7200 and findings.check("file", where, "id and bytes of the optional data",
                                                      (record.optional_id, size - 4 - record.optional_at), (7300, 12)):
                pointer = struct.unpack_from("<IQ", record.raw, record.optional_at)
        at += size
    findings.check("file", name, "first and last record", kinds[:1] + kinds[-1:], [7200, 7300])
    findings.check("file", name, "number of 7200, 7001 and 7300", [kinds.count(kind) for kind in (7200, 7001, 7300)], [1, 1, 1])
    if record is not None and record.kind == 7300:
        findings.check("file", name, "size and offset of the catalogue in the 7200", pointer, rows.pop()[:2])
        listed = list(CATALOGUE_ROW.iter_unpack(record.body[:len(record.body) // CATALOGUE_ROW.size * CATALOGUE_ROW.size]))
        findings.check("catalogue", name, "size of header field, rows", (record.header["header_size"], len(listed)), (14, len(rows)))
        for index, (got, expected) in enumerate(zip(listed, rows)):
            findings.check("catalogue", "%s row %d" % (name, index), "size, offset, type, device, enumerator, time", got, expected)
    return {"file": name, "bytes": len(data), "pings": len(ledger.pings), "records": {str(kind): kinds.count(kind) for kind in sorted(set(kinds))}}


# ---------------------------------------------------------------------------------------------------------------------
# Packets

class Reassembler:
    """Network frames of a stream in, whole records out."""

    def __init__(self, findings):
        self.findings = findings
        self.buffer = bytearray()
        self.pending = None         # transmission id, number of packets, bytes of the record, and its parts
        self.last_transmission = None
        self.packets = 0
        self.fragmented = 0

    def feed(self, data):
        """Returns the records that are complete."""
        self.buffer += data
        records = []
        while len(self.buffer) >= NETWORK_FRAME.size:
            version, offset, count, n_records, transmission, size, total, number, *_ = NETWORK_FRAME.unpack_from(self.buffer)
            where = "packet %d" % self.packets
            if (version, offset) != (5, NETWORK_FRAME.size) or not NETWORK_FRAME.size <= size <= LARGEST_RECORD:
                raise ProtocolError("%s: not a network frame: version %d, offset %d, packet size %d" % (where, version, offset, size))
            if len(self.buffer) < size:
                break
            payload = bytes(self.buffer[NETWORK_FRAME.size:size])
            del self.buffer[:size]
            self.packets += 1
            self.findings.check("packet", where, "total_records", n_records, 1)
            if size > MAX_PACKET:
                self.findings.add("packet", "%s: %d bytes, more than the limit of %d" % (where, size, MAX_PACKET))
            records += self._packet(where, (transmission, count, total), number, payload)
        return records

    def _packet(self, where, key, number, payload):
        if self.pending is None:
            if key[0] == self.last_transmission:
                self.findings.add("packet", "%s: transmission id %d is that of the record before it" % (where, key[0]))
            self.last_transmission, self.pending = key[0], (key, [])
        first, parts = self.pending
        if (key, number) != (first, len(parts)):
            raise ProtocolError("%s: transmission, packets, record size and packet number %s, expected %s" % (
                where, (*key, number), (*first, len(parts))))
        parts.append(payload)
        if len(parts) < first[1]:
            self.findings.check("packet", where, "bytes of a packet that is not the last", len(payload), len(parts[0]))
            return []
        self.pending = None
        self.fragmented += len(parts) > 1
        if len(parts[-1]) > len(parts[0]):
            self.findings.add("packet", "%s: the last packet (%d) is longer than the first (%d)" % (where, len(parts[-1]), len(parts[0])))
        record = b"".join(parts)
        self.findings.check("packet", where, "total_size against the bytes of the record", first[2], len(record))
        return [record]


def build_command(command, arguments=b"", device_id=CENTER_DEVICE_ID, enumerator=0, ticket=0, tracking=bytes(16), frame_offset=60):
    """A 7500 in its network frame. A command without arguments carries one empty byte."""
    now = datetime.datetime.now(datetime.timezone.utc)
    body = struct.pack("<II16s", command, ticket, tracking) + (arguments or b"\0")
    size = RECORD_FRAME.size + len(body) + 4
    record = RECORD_FRAME.pack(5, frame_offset, SYNC_PATTERN, size, 0, 0, now.year, now.timetuple().tm_yday, now.second + now.microsecond * 1e-6,
                               now.hour, now.minute, 1, 7500, device_id, 0, enumerator, 0, CHECKSUM_VALID, 0, 0, 0, 0) + body
    record += struct.pack("<I", sum(record) & 0xFFFFFFFF)
    return NETWORK_FRAME.pack(5, NETWORK_FRAME.size, 1, 1, ticket & 0xFFFF, NETWORK_FRAME.size + size, size, 0, device_id, enumerator, 0,
                              7001) + record


# ---------------------------------------------------------------------------------------------------------------------
# Live sessions

class Refused(Exception):
    def __init__(self, code):
        super().__init__("NACK 0x%04X %s" % (code, ERROR_NAMES.get(code, "(unknown)")))
        self.code = code


class Session:
    """One connection: sends commands, receives, checks everything that arrives."""

    def __init__(self, address, findings, gapless=True):
        self.findings = findings
        self.packets = Reassembler(findings)
        self.ledger = PingLedger(findings, gapless)
        self.counts = {}
        self.replies = {}       # ticket -> (record, how many pings had begun when it came)
        self.answers = {}       # record type -> last record outside pings
        self.echoes = []        # 7500 records from the server
        self.device_id, self.enumerator = CENTER_DEVICE_ID, 0
        self.ticket = 0x45540000
        self.latency_s = 0.0    # from a ping's stamp to its arrival, see Contract.latency_s
        self.bytes = 0
        self.started = time.monotonic()
        self.socket = socket.create_connection(address, timeout=5.0)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def close(self):
        self.socket.close()

    @property
    def pings(self):
        return self.ledger.pings

    def pump(self, seconds, until=None):
        """Receives for a time or until the condition holds; returns whether it does."""
        deadline = time.monotonic() + seconds
        while True:
            if until is not None and until():
                return True
            left = deadline - time.monotonic()
            if left <= 0:
                return until is None
            self.socket.settimeout(min(left, 0.2))
            try:
                data = self.socket.recv(1 << 18)
            except (socket.timeout, BlockingIOError):
                continue
            if not data:
                raise ProtocolError("the server closed the connection")
            self.bytes += len(data)
            for raw in self.packets.feed(data):
                self._record(raw)

    def _record(self, raw):
        record = parse_record(raw, "record %d of the stream" % sum(self.counts.values()), self.findings)
        kind = record.kind if record else 0
        self.counts[kind] = self.counts.get(kind, 0) + 1
        if record is None:
            return
        self.ledger.take(record)
        if kind in (7501, 7502):
            if record.header["ticket"] in self.replies:
                self.findings.add("reply", "%s: ticket %d is answered twice" % (record.where, record.header["ticket"]))
            self.replies[record.header["ticket"]] = (record, len(self.pings))
        elif kind == 7500:
            self.echoes.append(record)
        elif kind == 7001 or (kind == 7503 and record.header["ping_number"] == 0):
            self.answers[kind] = record

    def command(self, command, arguments=b"", frame_offset=60):
        """Sends one command and waits for its answer. Returns (7501 record, pings begun by then); raises Refused on a NACK."""
        self.ticket += 1
        ticket, tracking = self.ticket, os.urandom(16)
        self.socket.settimeout(5.0)
        self.socket.sendall(build_command(command, arguments, self.device_id, self.enumerator, ticket, tracking, frame_offset))
        if not self.pump(REPLY_TIMEOUT_S, lambda: ticket in self.replies):
            raise ProtocolError("command %d: no 7501 or 7502 with ticket %d in %.1f s" % (command, ticket, REPLY_TIMEOUT_S))
        record, begun = self.replies[ticket]
        self.findings.check("reply", record.where, "tracking number echoed to command %d" % command,
                            record.header["tracking_number"], tracking)
        if begun and None not in (record.stamp_ns, self.pings[begun - 1].stamp_ns):
            behind_s = (record.stamp_ns - self.pings[begun - 1].stamp_ns) / 1e9
            if abs(behind_s) < SAME_CLOCK_S:
                self.latency_s = behind_s
        if record.kind == 7502:
            raise Refused(record.header["error_code"])
        return record, begun

    def request(self, kind):
        """The record that answers a single request."""
        self.answers.pop(kind, None)
        self.command(SINGLE_REQUEST, struct.pack("<I", kind))
        if not self.pump(REPLY_TIMEOUT_S, lambda: kind in self.answers):
            raise StepFailed("7501 came, the %d did not" % kind)
        return self.answers[kind]


class StepFailed(Exception):
    pass


class Contract:
    """The steps of the remote-control contract. Each returns a line for the table or raises StepFailed."""

    def __init__(self, session, seconds):
        self.session = session
        self.seconds = seconds
        self.rows = []

    def run(self, name, function, *arguments):
        before, began = self.session.findings.total, time.monotonic()
        closed = None
        try:
            detail, ok = function(*arguments), True
        except (StepFailed, Refused) as error:
            detail, ok = str(error), False
        except (ProtocolError, OSError) as error:
            detail, ok, closed = str(error), False, error
        wrong = self.session.findings.total - before
        if wrong:
            ok, detail = False, "%s; %d findings" % (detail, wrong)
        self.rows.append((name, ok, detail, time.monotonic() - began))
        if closed:
            raise closed
        return ok

    # -- shared by the steps

    def period_s(self):
        recent = [p for p in self.session.pings[-6:] if p.stamp_ns is not None]
        steps = [(b.stamp_ns - a.stamp_ns) / 1e9 for a, b in zip(recent, recent[1:])]
        return statistics.median(steps) if steps else 1.0

    def latency_s(self):
        """How long after its pulse a ping reaches us, as far as the server's answers tell: one that settles its navigation, or one that
        buffers, delivers seconds late and stamps truly. Zero where answers and pings are stamped from different clocks."""
        return max(0.0, self.session.latency_s)

    def patience_s(self):
        return max(5.0, 8.0 * self.period_s()) + self.latency_s()

    def wait_pings(self, count, why):
        pings = self.session.pings
        target = len(pings) + count
        # One more 7000 than asked for, so that the last ping asked for is complete.
        if not self.session.pump(self.patience_s() + count * self.period_s(), lambda: len(pings) > target):
            raise StepFailed("%s: %d pings came, expected %d more" % (why, len(pings) - target + count, count))

    def judge(self, reply, begun, obeyed, describe):
        """A setting is obeyed by the first ping whose pulse starts after its acknowledgement (7KTIME against 7KTIME); pings already
        in flight may still come with the old one. Where the server stamps pings from another clock than its answers, only
        the order of arrival can be judged, with two pings of grace."""
        pings = self.session.pings
        last = pings[-1].stamp_ns
        same_clock = reply.stamp_ns is not None and last is not None and abs(reply.stamp_ns - last) < SAME_CLOCK_S * 1e9
        if not same_clock:
            late = [p for p in pings[begun + 2:] if not obeyed(p)]
            rule = "by order of arrival"
        else:
            late = [p for p in pings if p.pulse_ns is not None and p.pulse_ns > reply.stamp_ns + STAMP_STEP_NS and not obeyed(p)]
            rule = "by time stamps"
        if late:
            raise StepFailed("ping %d was sent after the acknowledgement and has %s" % (late[0].number, describe(late[0])))
        following = [p for p in pings[begun:] if obeyed(p)]
        if not following:
            raise StepFailed("no ping obeyed: %s" % describe(pings[-1]))
        return following[0], following[0].number - (pings[begun - 1].number if begun else 0), rule

    # -- steps

    def identify(self):
        session, record = self.session, self.session.request(7001)
        if not record.header["n_devices"]:
            raise StepFailed("the 7001 holds no device")
        device, description, _, serial, length = struct.unpack_from("<I60sIQI", record.body)
        info = record.body[80:80 + length]
        if len(info) != length or info.find(b"\0") != length - 1 or b"\0" not in description:
            raise StepFailed("XML and description must end in a NUL, the XML's is counted (%d bytes)" % length)
        try:
            xml.etree.ElementTree.fromstring(info[:-1].decode())
        except (xml.etree.ElementTree.ParseError, ValueError) as error:
            raise StepFailed("the XML does not parse: %s" % error)
        session.device_id, session.enumerator = device, record.enumerator
        return "device %d %r serial %d, %d bytes of XML" % (device, description.split(b"\0")[0].decode(), serial, length)

    def settings(self):
        header = self.session.request(7503).header
        return "range %.4g m, rate %.4g /s, power %.4g dB, gain %.4g dB, pulse %.4g s, ping state %d" % tuple(header[n] for n in (
            "range_selection", "max_ping_rate", "power_selection", "gain_selection", "tx_pulse_width", "ping_state"))

    def subscribe(self):
        self.session.command(SUBSCRIBE, struct.pack("<I%dI" % len(SUBSCRIPTION), len(SUBSCRIPTION), *SUBSCRIPTION))
        return "%d record types" % len(SUBSCRIPTION)

    def listen(self):
        session, begun, before = self.session, len(self.session.pings), dict(self.session.counts)
        session.pump(self.seconds)
        if len(session.pings) - begun < 2:
            raise StepFailed("%d pings in %.1f s" % (len(session.pings) - begun, self.seconds))
        missing = [k for k in SUBSCRIPTION if k != 7500 and session.counts.get(k, 0) == before.get(k, 0)]
        if missing:
            raise StepFailed("subscribed and acknowledged, but never came: %s" % missing)
        wanted = [k for k in PING_ORDER if k in SUBSCRIPTION]
        for ping in session.pings[begun + 1:-1]:    # the first and the last may have been cut by the listening itself
            session.findings.check("missing", "ping %d" % ping.number, "records", [k for k in ping.kinds if k in wanted], wanted)
        return "%d pings without a gap, period %.6f s" % (len(session.pings) - begun, self.period_s())

    def set_value(self, command, field, change):
        """Tries the candidates that `change` makes of the present value until one is accepted, then holds the following pings to it."""
        session = self.session
        if not session.pings:
            self.wait_pings(1, "before the command")
        old = dict(session.pings[-2 if len(session.pings) > 1 else -1].samples)  # the last may still be on its way
        echoes = len(session.echoes)
        refusals = []
        for value in change(session.pings[-1].settings[field]):
            argument = struct.pack("<f", value)
            wanted = struct.unpack("<f", argument)[0]
            try:
                reply, begun = session.command(command, argument)
                break
            except Refused as error:
                refusals.append("%.6g: %s" % (value, error))
        else:
            raise StepFailed("refused " + "; ".join(refusals))
        before = session.pings[begun - 1].settings[field] if begun else None
        session.pump(self.latency_s())
        self.wait_pings(4, "after %s %.6g" % (field, wanted))
        first, after, rule = self.judge(reply, begun, lambda p: p.settings[field] == wanted, lambda p: "%s %.7g, expected %.7g" % (
            field, p.settings[field], wanted))
        changed = ""
        if command == RANGE:
            same = [k for k, n in first.samples.items() if old.get(k) == n]
            if same and before != wanted:
                raise StepFailed("%s changed, the samples of %s did not (%s)" % (field, same, first.samples))
            changed = ", samples " + ", ".join("%d: %s -> %d" % (k, old.get(k), n) for k, n in sorted(first.samples.items()))
        if not any(e.header["remote_control_id"] == command and e.body[:4] == argument for e in session.echoes[echoes:]):
            raise StepFailed("subscribed to 7500, but the accepted command %d was not echoed" % command)
        return "%s %.6g -> %.6g in ping %d, %d after the acknowledgement, %s%s" % (
            field, before if before is not None else float("nan"), wanted, first.number, after, rule, changed)

    def refuse_range(self):
        session = self.session
        was = session.pings[-1].settings["range_selection"]
        told = []
        for value in (1e6, -5.0, float("nan")):
            try:
                session.command(RANGE, struct.pack("<f", value))
            except Refused as error:
                allowed = (0x7001,) if math.isfinite(value) else (0x7001, 0x7008)
                if error.code not in allowed:
                    raise StepFailed("range %g: %s, expected 0x7001" % (value, error))
                told.append("%g: 0x%04X" % (value, error.code))
            else:
                raise StepFailed("a range of %g m was acknowledged" % value)
        self.wait_pings(3, "after a refused range")
        for ping in session.pings[-4:]:
            if ping.settings["range_selection"] != was:
                raise StepFailed("the range became %.7g, it was %.7g" % (ping.settings["range_selection"], was))
        return "refused (%s), range stays %.6g m" % (", ".join(told), was)

    def refuse(self, command, arguments, code):
        try:
            self.session.command(command, arguments)
        except Refused as error:
            if error.code != code:
                raise StepFailed("%s, expected 0x%04X %s" % (error, code, ERROR_NAMES[code]))
            return str(error)
        raise StepFailed("acknowledged, expected NACK 0x%04X %s" % (code, ERROR_NAMES[code]))

    def frame_offset_64(self):
        """A field client writes 64 where the definition says 60; servers in service take both."""
        self.session.command(SINGLE_REQUEST, struct.pack("<I", 7503), frame_offset=64)
        return "acknowledged"

    def rate(self):
        achieved = 1.0 / self.period_s()
        line = self.set_value(MAX_RATE, "max_ping_rate", lambda _: (0.5 * achieved, 0.8 * achieved))
        wanted = self.session.pings[-1].settings["max_ping_rate"]
        self.wait_pings(5, "at the new rate")
        period = self.period_s()
        if abs(period - 1.0 / wanted) > max(0.05 / wanted, 0.002):
            raise StepFailed("%s; period %.6f s, expected %.6f s" % (line, period, 1.0 / wanted))
        return "%s; period %.6f s" % (line, period)

    def stop_start(self):
        session = self.session
        period = self.period_s()
        reply, begun = session.command(STOP_PINGING)
        state = session.request(7503).header["ping_state"]
        if state != 0:
            raise StepFailed("7503 says ping state %d after stop, expected 0" % state)
        session.pump(max(0.5, 2.0 * period) + self.latency_s())
        count = len(session.pings)
        session.pump(max(1.0, 3.0 * period))
        if len(session.pings) != count:
            raise StepFailed("%d pings came while stopped" % (len(session.pings) - count))
        last = session.pings[-1].pulse_ns
        if None not in (last, reply.stamp_ns) and reply.stamp_ns + STAMP_STEP_NS < last < reply.stamp_ns + 30e9:
            raise StepFailed("ping %d was sent after the stop was acknowledged" % session.pings[-1].number)
        session.command(START_PINGING)
        if not session.pump(self.patience_s(), lambda: len(session.pings) >= count + 3):
            raise StepFailed("%d pings in %.1f s after start" % (len(session.pings) - count, self.patience_s()))
        state = session.request(7503).header["ping_state"]
        if state != 1:
            raise StepFailed("7503 says ping state %d after start, expected 1" % state)
        return "%d in flight after the stop, silent, then ping %d went on" % (count - begun, session.pings[count].number)

    def unsubscribe(self, kind=7018):
        session = self.session
        session.command(UNSUBSCRIBE, struct.pack("<II", 1, kind))
        self.wait_pings(3, "after the unsubscription")  # records already queued for us may still come
        before = dict(session.counts)
        self.wait_pings(3, "after the unsubscription")
        extra = session.counts.get(kind, 0) - before.get(kind, 0)
        if extra:
            raise StepFailed("%d records of %d still came" % (extra, kind))
        stopped = [k for k in SUBSCRIPTION if k in PING_ORDER and k != kind and session.counts.get(k, 0) == before.get(k, 0)]
        if stopped:
            raise StepFailed("other records stopped too: %s" % stopped)
        return "no %d, the others go on" % kind

    def end(self):
        session = self.session
        session.command(END_SUBSCRIPTIONS)
        session.pump(0.5)
        before = sum(session.counts.values())
        session.pump(max(1.0, 3.0 * self.period_s()))
        extra = sum(session.counts.values()) - before
        if extra:
            raise StepFailed("%d records still came" % extra)
        if session.packets.pending or session.packets.buffer:
            raise StepFailed("half a record was left on the connection")
        return "silent"


# After identification and subscription: name for --steps, name in the table, method and its arguments.
STEPS = [
    ("range", "range 1003", "set_value", RANGE, "range_selection", lambda r: (0.6 * r, 0.8 * r, 1.25 * r)),
    ("bad-range", "bad range 1003", "refuse_range"),
    ("power", "power 1005", "set_value", POWER, "power_selection", lambda p: (p - 6.0, p + 3.0)),
    ("gain", "gain 1008", "set_value", GAIN, "gain_selection", lambda g: (g + 3.0, g - 3.0)),
    ("pulse", "pulse length 1006", "set_value", PULSE_LENGTH, "tx_pulse_width", lambda t: (0.5 * t, 0.8 * t, 1.25 * t)),
    ("rate", "rate 1004", "rate"),
    ("unknown", "unknown command", "refuse", 65000, b"", 0x7007),
    ("not-offered", "record not offered", "refuse", SINGLE_REQUEST, struct.pack("<I", 65000), 0x7002),
    ("offset-64", "frame offset 64", "frame_offset_64"),
    ("stop", "stop 1101, start 1100", "stop_start"),
    ("unsubscribe", "unsubscribe 1056", "unsubscribe"),
    ("end", "end subscriptions 1052", "end"),
]


def run_session(options, findings):
    session = Session(options.connect, findings)
    contract = Contract(session, options.seconds)
    step = contract.run
    try:
        if (step("7001 by 1050", contract.identify) and step("7503 by 1050", contract.settings)
                and step("subscribe 1051", contract.subscribe) and step("gapless pings", contract.listen)):
            for key, name, method, *arguments in STEPS:
                if options.sequence or key in options.steps:
                    step(name, getattr(contract, method), *arguments)
    except (ProtocolError, OSError) as error:
        findings.add("session", str(error))
    finally:
        session.close()
    return contract.rows, {
        "address": "%s:%d" % options.connect, "bytes": session.bytes, "packets": session.packets.packets,
        "fragmented_records": session.packets.fragmented, "pings": len(session.pings),
        "records": {str(k): session.counts[k] for k in sorted(session.counts)},
        "steps": [{"step": n, "ok": ok, "detail": d, "seconds": round(s, 3)} for n, ok, d, s in contract.rows]}


# ---------------------------------------------------------------------------------------------------------------------
# Command line

def address_of(text):
    host, _, port = text.rpartition(":")
    return host or "127.0.0.1", int(port)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", metavar="FILE.s7k")
    parser.add_argument("--connect", type=address_of, metavar="HOST:PORT", help="listen to a 7k server over TCP")
    parser.add_argument("--seconds", type=float, default=3.0, help="time to listen, seconds (default 3)")
    parser.add_argument("--sequence", action="store_true", help="test the whole remote-control protocol and print a table")
    parser.add_argument("--steps", type=lambda s: s.split(","), default=[], metavar="STEP,STEP",
                        help="test these: " + ", ".join(row[0] for row in STEPS))
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")
    options = parser.parse_args(arguments)
    if bool(options.files) == bool(options.connect):
        parser.error("give files or --connect")
    findings = Findings()
    rows, summary = [], {}
    try:
        if options.files:
            summary = {"files": [read_file(path, findings) for path in options.files]}
        else:
            rows, summary = run_session(options, findings)
    except OSError as error:
        findings.add("open", str(error))
    failed = findings.total > 0 or any(not ok for _, ok, _, _ in rows)
    summary.update(ok=not failed, findings=findings.total, finding_counts=findings.counts, finding_lines=findings.lines)
    if options.json:
        print(json.dumps(summary, indent=1))
        return int(failed)
    for name, ok, detail, seconds in rows:
        print("%-4s  %-22s %6.2f s  %s" % ("ok" if ok else "FAIL", name, seconds, detail))
    for part in summary.get("files", [summary]):
        if "records" in part:
            print("%s: %d bytes, %d pings, records %s" % (part.get("file", part.get("address")), part["bytes"], part["pings"],
                                                          " ".join("%s:%d" % item for item in part["records"].items())))
    for line in findings.lines:
        print("  " + line)
    print("FAILED: %d findings" % findings.total if failed else "all well")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
