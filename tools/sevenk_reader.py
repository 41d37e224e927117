#!/usr/bin/env python3
"""An independent reader of the 7k protocol, for checking a 7k server or a .s7k file.

Written from the byte tables of the public 7k data format definition, not from the encoder it checks; standard library only.

    sevenk_reader.py FILE.s7k ...                     verify files: frames, checksums, catalogue, every record
    sevenk_reader.py --connect HOST:PORT --seconds 5  listen over TCP and verify every packet and record
    sevenk_reader.py --connect HOST:PORT --sequence   the whole remote-control contract in one run, as a table
    sevenk_reader.py --udp HOST:PORT ...              the same over UDP

Exit code 0: no findings. 1: findings (each prints the actual and the expected value). 2: wrong usage.

Not checked: the physics of the samples (see points_check.py); 7042, 7028 and 7058 beyond their header sizes.
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
# Byte tables. "offset type name" per line; a type may be repeated (u32*7), cN is N bytes of text. The offsets are checked
# against the running sum of the sizes when this file is loaded, so that a slip in typing cannot survive.

NETWORK_FRAME = """
0 u16 protocol_version
2 u16 offset
4 u32 total_packets
8 u16 total_records
10 u16 transmission_id
12 u32 packet_size
16 u32 total_size
20 u32 sequence_number
24 u32 dest_device_id
28 u16 dest_enumerator
30 u16 source_enumerator
32 u32 source_device_id
"""

DATA_RECORD_FRAME = """
0 u16 protocol_version
2 u16 offset
4 u32 sync_pattern
8 u32 size
12 u32 optional_data_offset
16 u32 optional_data_id
20 u16 year
22 u16 day
24 f32 seconds
28 u8 hours
29 u8 minutes
30 u16 record_version
32 u32 record_type_id
36 u32 device_id
40 u16 reserved_40
42 u16 system_enumerator
44 u32 reserved_44
48 u16 flags
50 u16 reserved_50
52 u32 reserved_52
56 u32 total_records_in_fragmented_set
60 u32 fragment_number
"""

RECORD_TYPE_HEADERS = {
    1003: """
0 u32 datum_id
4 f32 latency
8 f64 latitude_or_northing
16 f64 longitude_or_easting
24 f64 height
32 u8 position_type
33 u8 utm_zone
34 u8 quality_flag
35 u8 positioning_method
36 u8 satellites
""",
    1012: """
0 f32 roll
4 f32 pitch
8 f32 heave
""",
    1013: """
0 f32 heading
""",
    1015: """
0 u8 vertical_reference
1 f64 latitude
9 f64 longitude
17 f32 horizontal_accuracy
21 f32 height
25 f32 height_accuracy
29 f32 speed_over_ground
33 f32 course_over_ground
37 f32 heading
""",
    1016: """
0 u8 n_data_sets
""",
    7000: """
0 u64 sonar_id
8 u32 ping_number
12 u16 multi_ping_sequence
14 f32 frequency
18 f32 sample_rate
22 f32 receiver_bandwidth
26 f32 tx_pulse_width
30 u32 tx_pulse_type
34 u32 tx_pulse_envelope
38 f32 tx_pulse_envelope_param
42 u16 tx_pulse_mode
44 u16 reserved_44
46 f32 max_ping_rate
50 f32 ping_period
54 f32 range_selection
58 f32 power_selection
62 f32 gain_selection
66 u32 control_flags
70 u32 projector_id
74 f32 projector_steer_vertical
78 f32 projector_steer_horizontal
82 f32 projector_bw_vertical
86 f32 projector_bw_horizontal
90 f32 projector_focal_point
94 u32 projector_weighting_type
98 f32 projector_weighting_param
102 u32 transmit_flags
106 u32 hydrophone_id
110 u32 receive_weighting_type
114 f32 receive_weighting_param
118 u32 receive_flags
122 f32 receive_beam_width
126 f32 bd_filter_min_range
130 f32 bd_filter_max_range
134 f32 bd_filter_min_depth
138 f32 bd_filter_max_depth
142 f32 absorption
146 f32 sound_velocity
150 f32 spreading
154 u16 reserved_154
""",
    7001: """
0 u64 sonar_id
8 u32 n_devices
""",
    7004: """
0 u64 sonar_id
8 u32 n_beams
""",
    7007: """
0 u64 sonar_id
8 u32 ping_number
12 u16 multi_ping_sequence
14 f32 beam_position
18 u32 control_flags
22 u32 samples_per_side
26 u32 nadir_depth
30 f32*7 reserved_30
58 u16 beams_per_side
60 u16 current_beam
62 u8 bytes_per_sample
63 u8 data_types
""",
    7018: """
0 u64 sonar_id
8 u32 ping_number
12 u16 multi_ping_sequence
14 u16 n_beams
16 u32 n_samples
20 u32*8 reserved_20
""",
    7027: """
0 u64 sonar_id
8 u32 ping_number
12 u16 multi_ping_sequence
14 u32 n_detections
18 u32 data_field_size
22 u8 detection_algorithm
23 u32 flags
27 f32 sampling_rate
31 f32 tx_angle
35 f32 applied_roll
39 u32*15 reserved_39
""",
    7028: """
0 u64 sonar_id
8 u32 ping_number
12 u16 multi_ping_sequence
14 u16 n_detections
16 u8 error_flag
17 u8 control_flags
18 u32 flags
22 u32*6 reserved_22
""",
    7038: """
0 u64 sonar_id
8 u32 ping_number
12 u16 multi_ping_sequence
14 u16 channel_count
16 u32 n_samples
20 u16 n_actual_channels
22 u32 start_sample
26 u32 stop_sample
30 u16 sample_type
32 u32*7 reserved_32
""",
    7042: """
0 u64 sonar_id
8 u32 ping_number
12 u16 multi_ping_sequence
14 u16 n_beams
16 u32 n_samples
20 u32 compressed_samples
24 u32 flags
28 u32 first_sample
32 f32 sample_rate
36 f32 compression_factor
40 u32 reserved_40
""",
    7058: """
0 u64 sonar_id
8 u32 ping_number
12 u16 multi_ping_sequence
14 u16 n_detections
16 u8 error_flag
17 u32 control_flags
21 f32 absorption
25 u32*6 reserved_25
""",
    7200: """
0 u64*2 file_id
16 u16 version
18 u16 reserved_18
20 u64*2 session_id
36 u32 record_data_size
40 u32 n_devices
44 c64 recording_name
108 c16 program_version
124 c64 user_defined_name
188 c128 notes
""",
    7300: """
0 u32 header_size
4 u16 version
6 u32 n_records
10 u32 reserved_10
""",
    7500: """
0 u32 remote_control_id
4 u32 ticket
8 u64*2 tracking_number
""",
    7501: """
0 u32 ticket
4 u64*2 tracking_number
""",
    7502: """
0 u32 ticket
4 u64*2 tracking_number
20 u32 error_code
""",
    7503: """
0 u64 sonar_id
8 u32 ping_number
12 f32 frequency
16 f32 sample_rate
20 f32 receiver_bandwidth
24 f32 tx_pulse_width
28 u32 tx_pulse_type
32 u32 tx_pulse_envelope
36 f32 tx_pulse_envelope_param
40 u16 tx_pulse_mode
42 u16 reserved_42
44 f32 max_ping_rate
48 f32 ping_period
52 f32 range_selection
56 f32 power_selection
60 f32 gain_selection
64 u32 control_flags
68 u32 projector_id
72 f32 projector_steer_vertical
76 f32 projector_steer_horizontal
80 f32 projector_bw_vertical
84 f32 projector_bw_horizontal
88 f32 projector_focal_point
92 u32 projector_weighting_type
96 f32 projector_weighting_param
100 u32 transmit_flags
104 u32 hydrophone_id
108 u32 receive_weighting_type
112 f32 receive_weighting_param
116 u32 receive_flags
120 f32 bd_filter_min_range
124 f32 bd_filter_max_range
128 f32 bd_filter_min_depth
132 f32 bd_filter_max_depth
136 f32 absorption
140 f32 sound_velocity
144 f32 spreading
148 u8 vernier_operation_mode
149 u8 automatic_filter_window
150 f32 tx_array_offset_x
154 f32 tx_array_offset_y
158 f32 tx_array_offset_z
162 f32 head_tilt_x
166 f32 head_tilt_y
170 f32 head_tilt_z
174 u32 ping_state
178 u16 beam_spacing_mode
180 u16 mode_7k
182 f32 adaptive_gate_min_depth
186 f32 adaptive_gate_max_depth
190 f64 trigger_out_width
198 f64 trigger_out_offset
206 u16 projector_selection_81xx
208 u32*2 reserved_208
216 f32 alternate_gain_81xx
220 u8 vernier_filter
221 u8 reserved_221
222 u16 custom_beams
224 f32 coverage_angle
228 u8 coverage_mode
229 u8 quality_filter_flags
230 f32 rx_horizontal_steering
234 f32 flexmode_sector_coverage
238 f32 flexmode_sector_steering
242 f32 constant_spacing
246 u16 beam_mode_selection
248 f32 depth_gate_tilt
252 f32 applied_frequency
256 u32 element_number
""",
    7610: """
0 f32 sound_velocity
4 f32 temperature
8 f32 pressure
""",
}

CONFIGURATION_DEVICE = """
0 u32 identifier
4 c60 description
64 u32 alphadata_card
68 u64 serial
76 u32 info_length
"""

DETECTION = """
0 u16 beam_descriptor
2 f32 detection_point
6 f32 rx_angle
10 u32 flags
14 u32 quality
18 f32 uncertainty
22 f32 intensity
26 f32 min_limit
30 f32 max_limit
"""

ATTITUDE_SAMPLE = """
0 u16 dt_ms
2 f32 roll
6 f32 pitch
10 f32 heave
14 f32 heading
"""

CATALOGUE_ROW = """
0 u32 record_size
4 u64 file_offset
12 u16 record_type
14 u16 device_id
16 u16 system_enumerator
18 c10 time
28 u32 record_count
32 u16*8 reserved_32
"""

# Sizes as published; the tables above must add up to them.
PUBLISHED_SIZES = {
    1003: 37, 1012: 12, 1013: 4, 1015: 41, 1016: 1, 7000: 156, 7001: 12, 7004: 12, 7007: 64, 7018: 52, 7027: 99, 7028: 46,
    7038: 60, 7042: 44, 7058: 49, 7200: 316, 7300: 14, 7500: 24, 7501: 20, 7502: 24, 7503: 260, 7610: 12,
}

SCALARS = {"u8": "B", "i8": "b", "u16": "H", "i16": "h", "u32": "I", "i32": "i", "u64": "Q", "f32": "f", "f64": "d"}


class Layout:
    """One byte table: names, offsets and a decoder."""

    def __init__(self, table, size=None):
        self.fields = []
        running = 0
        for line in table.strip().splitlines():
            offset, kind, name = line.split()
            if int(offset) != running:
                raise AssertionError("%s: the table says offset %s, the sizes before it add up to %d" % (name, offset, running))
            kind, _, count = kind.partition("*")
            code = "%ds" % int(kind[1:]) if kind[0] == "c" else (count or "") + SCALARS[kind]
            self.fields.append((name, running, struct.Struct("<" + code), bool(count)))
            running += struct.calcsize("<" + code)
        if size is not None and running != size:
            raise AssertionError("a table adds up to %d bytes, published are %d" % (running, size))
        self.size = running

    def decode(self, data, at=0):
        out = {}
        for name, offset, packer, is_array in self.fields:
            values = packer.unpack_from(data, at + offset)
            out[name] = values if is_array else values[0]
        return out


NF = Layout(NETWORK_FRAME, 36)
DRF = Layout(DATA_RECORD_FRAME, 64)
RTH = {kind: Layout(table, PUBLISHED_SIZES[kind]) for kind, table in RECORD_TYPE_HEADERS.items()}
DEVICE = Layout(CONFIGURATION_DEVICE, 80)
DETECTION_ROW = Layout(DETECTION, 34)
ATTITUDE_ROW = Layout(ATTITUDE_SAMPLE, 18)
CATALOGUE = Layout(CATALOGUE_ROW, 48)

SYNC_PATTERN = 0x0000FFFF
SIMULATOR_BIT = 1 << 31
CHECKSUM_VALID = 1
CENTER_DEVICE_ID = 7000
SPEC_MAX_PACKET = 60000
LARGEST_RECORD = 1 << 30  # a size beyond this is a lost frame, not a record

ERROR_NAMES = {
    0x7000: "SYSTEM_NOT_READY", 0x7001: "PARAMETER_OUT_OF_RANGE", 0x7002: "RECORD_NOT_AVAILABLE",
    0x7005: "EXTERNAL_RECORD_NOT_AVAILABLE", 0x7006: "FEATURE_NOT_AVAILABLE", 0x7007: "REMOTE_COMMAND_NOT_FOUND",
    0x7008: "INVALID_PARAMETER", 0x7009: "INVALID_DEVICE_ID", 0x700A: "RECORD_IS_SUBSCRIPTION_ONLY",
    0x700B: "PARAMETER_VALUE_CLIPPED", 0x700C: "REMOTE_COMMAND_DENIED", 0x7050: "NETWORK_PROTOCOL_VERSION",
    0x7051: "NETWORK_OFFSET", 0x7052: "DATA_PROTOCOL_VERSION", 0x7053: "DATA_SYNC_PATTERN", 0x7054: "DATA_CHECKSUM",
}

RANGE, MAX_RATE, POWER, PULSE_LENGTH, GAIN = 1003, 1004, 1005, 1006, 1008
SINGLE_REQUEST, SUBSCRIBE, END_SUBSCRIPTIONS, UNSUBSCRIBE = 1050, 1051, 1052, 1056
START_PINGING, STOP_PINGING = 1100, 1101

# Order in which the records of one ping are sent.
PING_ORDER = [7000, 7503, 1750, 7002, 7004, 7017, 7006, 7027, 7007, 7008, 7010, 7011, 7012, 7013, 7018, 7019, 7028, 7029, 7037,
              7038, 7039, 7041, 7042, 7048, 7049, 7057, 7058, 7068, 7070]
DEFAULT_SUBSCRIPTION = [7000, 7503, 7004, 7007, 7018, 7038, 7610, 1003, 1012, 1013, 7500]

# 7KTIME keeps the seconds as f32: just under 60 s one step is 3.8 us.
STAMP_STEP_NS = 4000
# Replies and pings stamped farther apart than this use different clocks (a log's and the host's).
SAME_CLOCK_S = 30.0


# ---------------------------------------------------------------------------------------------------------------------
# Findings

class Findings:
    """Findings as text; repeated kinds are counted instead of printed again."""

    def __init__(self, shown_per_kind=5, ignore=()):
        self.counts = {}
        self.lines = []
        self.shown_per_kind = shown_per_kind
        self.ignore = set(ignore)

    def add(self, kind, text):
        if kind in self.ignore:
            return
        self.counts[kind] = self.counts.get(kind, 0) + 1
        if self.counts[kind] <= self.shown_per_kind:
            self.lines.append("%s: %s" % (kind, text))

    def check(self, kind, where, what, got, expected):
        """True when got == expected, a finding otherwise."""
        if got == expected:
            return True
        self.add(kind, "%s: %s: got %s, expected %s" % (where, what, got, expected))
        return False

    @property
    def total(self):
        return sum(self.counts.values())


class ProtocolError(Exception):
    """The byte stream cannot be followed any further."""


# ---------------------------------------------------------------------------------------------------------------------
# Records

class Record:
    """One 7k record: frame, record type header, decoded and checked."""

    def __init__(self, raw, frame, header, body, where):
        self.raw = raw
        self.frame = frame
        self.kind = frame["record_type_id"]
        self.header = header
        self.body = body
        self.where = where
        self.details = {}
        self.stamp_ns = stamp_ns(frame)

    def __str__(self):
        day = "%04d-%03d %02d:%02d:%09.6f" % (self.frame["year"], self.frame["day"], self.frame["hours"], self.frame["minutes"],
                                              self.frame["seconds"])
        shown = {}
        for source in (self.header or {}, self.details):
            shown.update((k, v) for k, v in source.items() if not k.startswith("reserved"))
        words = " ".join("%s=%s" % (k, "%.7g" % v if isinstance(v, float) else v) for k, v in shown.items())
        return "%d %s device %d.%d %d bytes %s" % (self.kind, day, self.frame["device_id"], self.frame["system_enumerator"],
                                                   len(self.raw), words)


def stamp_ns(frame):
    """UTC nanoseconds since 1970 of a 7KTIME, None if it is invalid."""
    try:
        day = datetime.date(frame["year"], 1, 1).toordinal() + frame["day"] - 1
    except ValueError:
        return None
    if not (1 <= frame["day"] <= 366 and frame["hours"] < 24 and frame["minutes"] < 60 and 0.0 <= frame["seconds"] <= 60.0):
        return None
    seconds = (day - datetime.date(1970, 1, 1).toordinal()) * 86400 + frame["hours"] * 3600 + frame["minutes"] * 60
    return seconds * 1_000_000_000 + round(frame["seconds"] * 1e9)


def parse_record(raw, where, findings):
    """Checks the frame of one whole record and decodes it. None if the record cannot be decoded."""
    if len(raw) < DRF.size + 4:
        findings.add("frame", "%s: a record of %d bytes is shorter than its frame and checksum (68)" % (where, len(raw)))
        return None
    frame = DRF.decode(raw)
    kind = frame["record_type_id"]
    where = "%s record %d" % (where, kind)
    ok = findings.check("frame", where, "protocol version", frame["protocol_version"], 5)
    ok &= findings.check("frame", where, "sync pattern", "0x%08X" % frame["sync_pattern"], "0x%08X" % SYNC_PATTERN)
    ok &= findings.check("frame", where, "offset (sync pattern to record type header)", frame["offset"], 60)
    ok &= findings.check("frame", where, "size field against the bytes at hand", frame["size"], len(raw))
    if not ok:
        return None
    findings.check("frame", where, "fragment fields", (frame["total_records_in_fragmented_set"], frame["fragment_number"]), (0, 0))
    findings.check("frame", where, "reserved fields", [v for k, v in frame.items() if k.startswith("reserved")], [0, 0, 0, 0])
    if stamp_ns(frame) is None:
        findings.add("time", "%s: not a time: year %d day %d %02d:%02d:%s" % (
            where, frame["year"], frame["day"], frame["hours"], frame["minutes"], frame["seconds"]))
    if findings.check("checksum", where, "flags bit 0 (checksum valid)", frame["flags"] & CHECKSUM_VALID, CHECKSUM_VALID):
        stored = struct.unpack_from("<I", raw, len(raw) - 4)[0]
        findings.check("checksum", where, "sum of all bytes before the checksum", "0x%08X" % (sum(raw[:-4]) & 0xFFFFFFFF),
                       "0x%08X as stored" % stored if (sum(raw[:-4]) & 0xFFFFFFFF) != stored else "0x%08X" % stored)
    end = len(raw) - 4
    if frame["optional_data_offset"]:
        if not DRF.size <= frame["optional_data_offset"] <= end:
            findings.add("frame", "%s: optional data offset %d lies outside the record's %d..%d" % (
                where, frame["optional_data_offset"], DRF.size, end))
            return None
        end = frame["optional_data_offset"]
    layout = RTH.get(kind)
    if layout is None:
        return Record(raw, frame, None, raw[DRF.size:end], where)
    if end - DRF.size < layout.size:
        findings.add("size", "%s: %d bytes after the frame, its header alone has %d" % (where, end - DRF.size, layout.size))
        return None
    record = Record(raw, frame, layout.decode(raw, DRF.size), raw[DRF.size + layout.size:end], where)
    for name, value in record.header.items():
        if isinstance(value, float) and not math.isfinite(value):
            findings.add("value", "%s: %s is %s" % (where, name, value))
    checker = BODY_CHECKS.get(kind)
    if checker:
        checker(record, findings)
    return record


def body_size(record, findings, expected, formula):
    return findings.check("size", record.where, "bytes of record data (%s)" % formula, len(record.body), expected)


def check_fixed(record, findings):
    body_size(record, findings, 0, "none")


def check_settings(record, findings):
    check_fixed(record, findings)
    header = record.header
    findings.check("simulator", record.where, "control_flags bit 31 (simulator)", header["control_flags"] >> 31, 1)
    for name in ("frequency", "sample_rate", "tx_pulse_width", "range_selection", "sound_velocity"):
        if not header[name] > 0.0:
            findings.add("value", "%s: %s: got %s, expected more than 0" % (record.where, name, header[name]))


def check_geometry(record, findings):
    n = record.header["n_beams"]
    if body_size(record, findings, 16 * n, "4 x f32 x %d beams" % n):
        values = struct.unpack("<%df" % (4 * n), record.body)
        across = values[n:2 * n]
        steps = [b - a for a, b in zip(across, across[1:])]
        if not (all(s > 0 for s in steps) or all(s < 0 for s in steps)):
            findings.add("value", "%s: the across-track angles are not monotonic" % record.where)
        if not all(math.isfinite(v) for v in values):
            findings.add("value", "%s: an angle or a width is not finite" % record.where)
        if n:
            record.details = {"first_across_rad": across[0], "last_across_rad": across[-1]}


def check_side_scan(record, findings):
    header = record.header
    width, samples = header["bytes_per_sample"], header["samples_per_side"]
    if width not in (1, 2, 4):
        findings.add("value", "%s: bytes per sample: got %d, expected 1, 2 or 4" % (record.where, width))
    body_size(record, findings, 2 * width * samples, "2 sides x %d bytes x %d samples" % (width, samples))
    record.details = {"any_signal": any(record.body)}


def check_beamformed(record, findings):
    n, samples = record.header["n_beams"], record.header["n_samples"]
    body_size(record, findings, 4 * n * samples, "4 bytes x %d beams x %d samples" % (n, samples))
    record.details = {"any_signal": any(record.body)}


def check_elements(record, findings):
    header = record.header
    n, first, last = header["n_actual_channels"], header["start_sample"], header["stop_sample"]
    findings.check("value", record.where, "sample type", header["sample_type"], 16)
    if not first <= last < header["n_samples"]:
        findings.add("value", "%s: samples %d..%d do not lie in 0..%d" % (record.where, first, last, header["n_samples"] - 1))
    if n > header["channel_count"]:
        findings.add("value", "%s: %d elements in the record, %d in the system" % (record.where, n, header["channel_count"]))
    present = last - first + 1
    expected = 2 * n + 4 * n * present
    if body_size(record, findings, expected, "2 x %d + 4 x %d elements x %d samples" % (n, n, present)):
        numbers = struct.unpack_from("<%dH" % n, record.body)
        if len(set(numbers)) != n:
            findings.add("value", "%s: an element number comes twice: %s" % (record.where, numbers))
        if numbers and max(numbers) >= n:
            findings.add("value", "%s: element number %d, expected less than %d" % (record.where, max(numbers), n))
        record.details = {"any_signal": any(record.body[2 * n:])}


def check_detections(record, findings):
    n, width = record.header["n_detections"], record.header["data_field_size"]
    if width < DETECTION_ROW.size:
        findings.add("value", "%s: data_field_size: got %d, expected 34 or more" % (record.where, width))
    elif body_size(record, findings, n * width, "%d detections x %d" % (n, width)):
        rows = [DETECTION_ROW.decode(record.body, i * width) for i in range(n)]
        bad = [r["detection_point"] for r in rows if not (math.isfinite(r["detection_point"]) and r["detection_point"] >= 0)]
        if bad:
            findings.add("value", "%s: detection points that are no samples: %s" % (record.where, bad[:5]))


def check_attitude(record, findings):
    n = record.header["n_data_sets"]
    body_size(record, findings, ATTITUDE_ROW.size * n, "18 x %d data sets" % n)


def check_configuration(record, findings):
    at, devices = 0, []
    for index in range(record.header["n_devices"]):
        if at + DEVICE.size > len(record.body):
            findings.add("size", "%s: device %d of %d starts past the end" % (record.where, index, record.header["n_devices"]))
            return
        device = DEVICE.decode(record.body, at)
        at += DEVICE.size
        if b"\0" not in device["description"]:
            findings.add("value", "%s: the description of device %d has no NUL" % (record.where, index))
        info = record.body[at:at + device["info_length"]]
        at += device["info_length"]
        if len(info) != device["info_length"]:
            findings.add("size", "%s: device %d: %d bytes of XML, expected %d" % (record.where, index, len(info), device["info_length"]))
            return
        if not info.endswith(b"\0") or info.count(b"\0") != 1:
            findings.add("value", "%s: device %d: the XML must end in one NUL that its length counts" % (record.where, index))
        try:
            xml.etree.ElementTree.fromstring(info.rstrip(b"\0").decode("utf-8"))
        except (xml.etree.ElementTree.ParseError, UnicodeDecodeError, ValueError) as error:
            findings.add("value", "%s: device %d: the XML does not parse: %s" % (record.where, index, error))
        devices.append({"identifier": device["identifier"], "serial": device["serial"],
                        "description": text_of(device["description"]), "xml_bytes": device["info_length"]})
    findings.check("size", record.where, "bytes used by the devices", at, len(record.body))
    record.details = {"devices": devices}


def check_position(record, findings):
    check_fixed(record, findings)
    header = record.header
    if header["position_type"] == 0 and not (abs(header["latitude_or_northing"]) <= math.pi / 2
                                             and abs(header["longitude_or_easting"]) <= math.pi + 1e-9):
        findings.add("value", "%s: latitude %r, longitude %r are not radians on Earth" % (
            record.where, header["latitude_or_northing"], header["longitude_or_easting"]))


def check_roll_pitch_heave(record, findings):
    check_fixed(record, findings)
    if abs(record.header["roll"]) > math.pi or abs(record.header["pitch"]) > math.pi / 2 + 1e-6:
        findings.add("value", "%s: roll %r, pitch %r are not radians" % (record.where, record.header["roll"], record.header["pitch"]))


def check_heading(record, findings):
    check_fixed(record, findings)
    if not -1e-6 <= record.header["heading"] <= 2 * math.pi + 1e-6:
        findings.add("value", "%s: heading %r is not in 0..2 pi" % (record.where, record.header["heading"]))


def check_sound_velocity(record, findings):
    check_fixed(record, findings)
    if not 1300.0 <= record.header["sound_velocity"] <= 1700.0:
        findings.add("value", "%s: %r m/s is not a speed of sound in water" % (record.where, record.header["sound_velocity"]))


def check_file_header(record, findings):
    body_size(record, findings, 6 * record.header["n_devices"], "6 x %d devices" % record.header["n_devices"])
    for name in ("recording_name", "program_version", "user_defined_name", "notes"):
        if b"\0" not in record.header[name]:
            findings.add("value", "%s: %s has no NUL" % (record.where, name))
    record.details = {"devices": [struct.unpack_from("<IH", record.body, i) for i in range(0, len(record.body) - 5, 6)]}
    for name in ("recording_name", "program_version", "user_defined_name", "notes"):
        record.header[name] = text_of(record.header[name])


def check_catalogue(record, findings):
    n = record.header["n_records"]
    findings.check("value", record.where, "size of header field", record.header["header_size"], 14)
    body_size(record, findings, CATALOGUE.size * n, "48 x %d rows" % n)


def text_of(padded):
    return padded.split(b"\0")[0].decode("utf-8", "replace")


BODY_CHECKS = {
    1003: check_position, 1012: check_roll_pitch_heave, 1013: check_heading, 1015: check_fixed, 1016: check_attitude,
    7000: check_settings, 7001: check_configuration, 7004: check_geometry, 7007: check_side_scan, 7018: check_beamformed,
    7027: check_detections, 7038: check_elements, 7200: check_file_header, 7300: check_catalogue, 7501: check_fixed,
    7502: check_fixed, 7503: check_settings, 7610: check_sound_velocity,
}


# ---------------------------------------------------------------------------------------------------------------------
# Pings: what the records of one ping must agree on

class Ping:
    def __init__(self, settings):
        self.number = settings.header["ping_number"]
        self.stamp_ns = settings.stamp_ns
        self.time_bytes = settings.raw[20:30]
        self.settings = settings.header
        self.samples = {}       # record type -> samples in it
        self.kinds = [7000]
        self.beams = None


class PingLedger:
    """Follows pings through a stream of records in order of arrival."""

    def __init__(self, findings, gapless=True):
        self.findings = findings
        self.gapless = gapless
        self.pings = []
        self.current = None

    def take(self, record):
        kind, header = record.kind, record.header
        if kind == 7000:
            self._begin(record)
            return
        if kind not in PING_ORDER or (kind == 7503 and header["ping_number"] == 0):
            return
        ping = self.current
        if ping is None:
            if self.pings or kind != 7004:  # a stream may be joined in the middle of a ping
                self.findings.add("order", "%s: comes before any 7000" % record.where)
            return
        where = "ping %d: %s" % (ping.number, record.where)
        if header is not None and "ping_number" in header:
            if not self.findings.check("ping", where, "ping number", header["ping_number"], ping.number):
                return
        if PING_ORDER.index(kind) <= PING_ORDER.index(ping.kinds[-1]):
            self.findings.add("order", "%s: comes after %d; expected order %s" % (
                where, ping.kinds[-1], [k for k in PING_ORDER if k in ping.kinds + [kind]]))
        ping.kinds.append(kind)
        self.findings.check("time", where, "7KTIME against that of the ping's 7000", record.raw[20:30].hex(), ping.time_bytes.hex())
        if header is None:
            return
        if "sonar_id" in header:
            self.findings.check("ping", where, "sonar id", header["sonar_id"], ping.settings["sonar_id"])
        if kind == 7503:
            for name in header:
                if name in ping.settings and not name.startswith("reserved"):
                    self.findings.check("settings", where, "%s against the ping's 7000" % name, header[name], ping.settings[name])
        elif kind == 7004:
            ping.beams = header["n_beams"]
        elif kind == 7018:
            self._samples(ping, where, kind, header["n_samples"])
            if ping.beams is not None:
                self.findings.check("ping", where, "beams against 7004", header["n_beams"], ping.beams)
        elif kind == 7007:
            self._samples(ping, where, kind, header["samples_per_side"])
        elif kind == 7038:
            self._samples(ping, where, kind, header["n_samples"])

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
        self.current = ping

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

def read_file(path, findings, verbose=False):
    """Verifies one .s7k file. Returns a summary."""
    with open(path, "rb") as stream:
        data = stream.read()
    name = os.path.basename(path)
    ledger = PingLedger(findings)
    counts, rows, at, last = {}, [], 0, None
    header_pointer = None
    while at < len(data):
        where = "%s @%d" % (name, at)
        if at + DRF.size > len(data):
            findings.add("frame", "%s: %d bytes left, a record frame has 64" % (where, len(data) - at))
            break
        frame = DRF.decode(data, at)
        if frame["sync_pattern"] != SYNC_PATTERN or not 68 <= frame["size"] <= len(data) - at:
            findings.add("frame", "%s: sync 0x%08X size %d with %d bytes left; the file cannot be followed further" % (
                where, frame["sync_pattern"], frame["size"], len(data) - at))
            break
        raw = data[at:at + frame["size"]]
        record = parse_record(raw, where, findings)
        kind = frame["record_type_id"]
        counts[kind] = counts.get(kind, 0) + 1
        if not rows:
            findings.check("file", where, "type of the first record", kind, 7200)
        if record is not None:
            if verbose:
                print("%9d  %s" % (at, record))
            ledger.take(record)
            if kind == 7200:
                header_pointer = file_header_pointer(record, findings)
            last = (at, record)
        rows.append((frame["size"], at, kind, frame["device_id"] & 0xFFFF, frame["system_enumerator"], raw[20:30]))
        at += frame["size"]
    findings.check("file", name, "number of 7200 records", counts.get(7200, 0), 1)
    findings.check("file", name, "number of 7300 records", counts.get(7300, 0), 1)
    if counts.get(7001, 0) > 1:
        findings.add("file", "%s: %d configuration records (7001), expected one" % (name, counts[7001]))
    if last and findings.check("file", name, "type of the last record", last[1].kind, 7300):
        if header_pointer is not None:
            findings.check("file", name, "size and offset of the catalogue in the 7200's optional data", header_pointer,
                           (len(last[1].raw), last[0]))
        compare_catalogue(name, last[1], rows[:-1], findings)
    return {"file": name, "bytes": len(data), "records": {str(k): counts[k] for k in sorted(counts)},
            "pings": len(ledger.pings), "ping_summary": summarise(ledger.pings)}


def file_header_pointer(record, findings):
    frame = record.frame
    if not findings.check("file", record.where, "optional data id", frame["optional_data_id"], 7300):
        return None
    at = frame["optional_data_offset"]
    if not findings.check("file", record.where, "optional data offset", at, DRF.size + RTH[7200].size + len(record.body)):
        return None
    if not findings.check("file", record.where, "bytes of optional data", len(record.raw) - 4 - at, 12):
        return None
    return struct.unpack_from("<IQ", record.raw, at)


def compare_catalogue(name, record, rows, findings):
    findings.check("catalogue", name, "rows", record.header["n_records"], len(rows))
    for index in range(min(len(rows), len(record.body) // CATALOGUE.size)):
        row = CATALOGUE.decode(record.body, index * CATALOGUE.size)
        got = (row["record_size"], row["file_offset"], row["record_type"], row["device_id"], row["system_enumerator"], row["time"])
        labels = ("size", "offset", "type", "device", "enumerator", "time")
        for label, g, w in zip(labels, got, rows[index]):
            if g != w:
                findings.add("catalogue", "%s row %d: %s: got %s, the record has %s" % (
                    name, index, label, g.hex() if isinstance(g, bytes) else g, w.hex() if isinstance(w, bytes) else w))


def summarise(pings):
    """Statistics for the user, which do not affect the result."""
    if not pings:
        return {}
    periods = [(b.stamp_ns - a.stamp_ns) / 1e9 for a, b in zip(pings, pings[1:]) if None not in (a.stamp_ns, b.stamp_ns)]
    out = {"first": pings[0].number, "last": pings[-1].number, "ranges_m": sorted({round(p.settings["range_selection"], 3) for p in pings}),
           "samples": {str(k): sorted({p.samples[k] for p in pings if k in p.samples}) for k in (7007, 7018, 7038)}}
    if periods:
        out["period_s"] = {"min": min(periods), "median": statistics.median(periods), "max": max(periods)}
    return out


# ---------------------------------------------------------------------------------------------------------------------
# Packets

class Reassembler:
    """Network frames in, whole records out."""

    def __init__(self, findings, max_packet=SPEC_MAX_PACKET, datagrams=False):
        self.findings = findings
        self.max_packet = max_packet
        self.datagrams = datagrams
        self.buffer = bytearray()
        self.pending = {}           # transmission id -> (network frame of its first packet, parts)
        self.last_transmission = None
        self.packets = 0
        self.fragmented = 0
        self.lost = 0

    def feed(self, data):
        """Bytes of a stream, or one whole datagram. Returns the records that are complete."""
        if self.datagrams:
            self.buffer = bytearray(data)
        else:
            self.buffer += data
        records = []
        while len(self.buffer) >= NF.size:
            frame = NF.decode(self.buffer)
            where = "packet %d" % self.packets
            size = frame["packet_size"]
            sane = frame["protocol_version"] == 5 and NF.size <= size <= LARGEST_RECORD and frame["offset"] == NF.size
            if not sane:
                raise ProtocolError("%s: not a network frame: version %d, offset %d, packet size %d (bytes %s)" % (
                    where, frame["protocol_version"], frame["offset"], size, bytes(self.buffer[:NF.size]).hex()))
            if len(self.buffer) < size:
                if self.datagrams:
                    self.findings.add("packet", "%s: a datagram of %d bytes says it has %d" % (where, len(self.buffer), size))
                break
            payload = bytes(self.buffer[NF.size:size])
            del self.buffer[:size]
            self.packets += 1
            record = self._packet(frame, payload, where)
            if record is not None:
                records.append(record)
            if self.datagrams:
                self.findings.check("packet", where, "bytes after the packet in its datagram", len(self.buffer), 0)
                break
        return records

    def _packet(self, frame, payload, where):
        check = self.findings.check
        check("packet", where, "total_records", frame["total_records"], 1)
        if self.max_packet and frame["packet_size"] > self.max_packet:
            self.findings.add("packet", "%s: %d bytes, more than the limit of %d" % (where, frame["packet_size"], self.max_packet))
        key = frame["transmission_id"]
        if key not in self.pending:
            if frame["sequence_number"] != 0:
                if self.datagrams:
                    self.lost += 1
                    return None
                raise ProtocolError("%s: a record begins with packet %d of %d" % (
                    where, frame["sequence_number"], frame["total_packets"]))
            if self.pending and not self.datagrams:
                raise ProtocolError("%s: transmission %d begins inside transmission %s" % (where, key, list(self.pending)))
            if key == self.last_transmission:
                self.findings.add("packet", "%s: transmission id %d is that of the record before it" % (where, key))
            self.last_transmission = key
            self.pending[key] = (frame, [])
        first, parts = self.pending[key]
        if frame["sequence_number"] != len(parts):
            if not self.datagrams:
                raise ProtocolError("%s: packet %d of transmission %d, expected %d" % (where, frame["sequence_number"], key, len(parts)))
            self.lost += 1
            del self.pending[key]
            return None
        for name in ("total_packets", "total_size"):
            check("packet", where, "%s against that of the first packet" % name, frame[name], first[name])
        parts.append(payload)
        if len(parts) < first["total_packets"]:
            check("packet", where, "bytes of a packet that is not the last", len(payload), len(parts[0]))
            return None
        del self.pending[key]
        if len(parts) > 1:
            self.fragmented += 1
            if len(parts[-1]) > len(parts[0]):
                self.findings.add("packet", "%s: the last packet (%d) is longer than the first (%d)" % (where, len(parts[-1]), len(parts[0])))
        record = b"".join(parts)
        check("packet", where, "total_size against the bytes of the record", first["total_size"], len(record))
        return record


def build_command(command, arguments=b"", device_id=CENTER_DEVICE_ID, enumerator=0, ticket=0, tracking=(0, 0), drf_offset=60,
                  transmission_id=0, when=None):
    """A 7500 in its network frame. A command without arguments carries one empty byte."""
    when = when if when is not None else time.time()
    now = datetime.datetime.fromtimestamp(when, datetime.timezone.utc)
    body = struct.pack("<IIQQ", command, ticket, *tracking) + (arguments or b"\0")
    size = DRF.size + len(body) + 4
    drf = struct.pack("<HHIIII", 5, drf_offset, SYNC_PATTERN, size, 0, 0)
    drf += struct.pack("<HHfBB", now.year, now.timetuple().tm_yday, now.second + now.microsecond * 1e-6, now.hour, now.minute)
    drf += struct.pack("<HIIHHIHHIII", 1, 7500, device_id, 0, enumerator, 0, CHECKSUM_VALID, 0, 0, 0, 0)
    record = drf + body
    record += struct.pack("<I", sum(record) & 0xFFFFFFFF)
    frame = struct.pack("<HHIHHIIIIHHI", 5, NF.size, 1, 1, transmission_id & 0xFFFF, NF.size + size, size, 0, device_id, enumerator, 0,
                        7001)
    return frame + record


# ---------------------------------------------------------------------------------------------------------------------
# Live sessions

class Refused(Exception):
    def __init__(self, code):
        super().__init__("NACK 0x%04X %s" % (code, ERROR_NAMES.get(code, "(unknown)")))
        self.code = code


class Session:
    """One connection: sends commands, receives, checks everything that arrives."""

    def __init__(self, address, findings, udp=False, max_packet=SPEC_MAX_PACKET, verbose=False, gapless=True, reply_timeout_s=5.0):
        self.findings = findings
        self.verbose = verbose
        self.reply_timeout_s = reply_timeout_s
        self.packets = Reassembler(findings, max_packet, datagrams=udp)
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
        if udp:
            self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
            self.socket.connect(address)
        else:
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
        if record is None:
            self.counts[0] = self.counts.get(0, 0) + 1
            return
        kind = record.kind
        self.counts[kind] = self.counts.get(kind, 0) + 1
        if self.verbose:
            print(record)
        self.ledger.take(record)
        if kind in (7501, 7502):
            if record.header["ticket"] in self.replies:
                self.findings.add("reply", "%s: ticket %d is answered twice" % (record.where, record.header["ticket"]))
            self.replies[record.header["ticket"]] = (record, len(self.pings))
        elif kind == 7500:
            self.echoes.append(record)
        elif kind == 7001 or (kind == 7503 and record.header["ping_number"] == 0):
            self.answers[kind] = record

    def command(self, command, arguments=b"", drf_offset=60):
        """Sends one command and waits for its answer. Returns (7501 record, pings begun by then); raises Refused on a NACK."""
        self.ticket += 1
        tracking = (int.from_bytes(os.urandom(8), "little"), int.from_bytes(os.urandom(8), "little"))
        self.socket.settimeout(5.0)
        self.socket.sendall(build_command(command, arguments, self.device_id, self.enumerator, self.ticket, tracking, drf_offset,
                                          self.ticket))
        ticket = self.ticket
        if not self.pump(self.reply_timeout_s, lambda: ticket in self.replies):
            raise ProtocolError("command %d: no 7501 or 7502 with ticket %d in %.1f s" % (command, ticket, self.reply_timeout_s))
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


class StepFailed(Exception):
    pass


class Contract:
    """The steps of the remote-control contract. Each returns a line for the table or raises StepFailed."""

    def __init__(self, session, subscription, seconds):
        self.session = session
        self.subscription = subscription
        self.seconds = seconds
        self.rows = []

    def run(self, name, function, *arguments):
        before, began = self.session.findings.total, time.monotonic()
        try:
            detail = function(*arguments)
            ok = True
        except (StepFailed, Refused) as error:
            detail, ok = str(error), False
        except (ProtocolError, OSError) as error:
            detail, ok = str(error), False
            self.rows.append((name, ok, detail, time.monotonic() - began))
            raise
        wrong = self.session.findings.total - before
        if wrong:
            ok, detail = False, "%s; %d findings" % (detail, wrong)
        self.rows.append((name, ok, detail, time.monotonic() - began))
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
        """A setting is obeyed by the first ping that is sent after its acknowledgement (7KTIME against 7KTIME); pings already
        in flight may still come with the old one. Where the server stamps pings from another clock than its answers, only
        the order of arrival can be judged, with two pings of grace."""
        pings = self.session.pings
        last = pings[-1].stamp_ns
        same_clock = reply.stamp_ns is not None and last is not None and abs(reply.stamp_ns - last) < SAME_CLOCK_S * 1e9
        if not same_clock:
            late = [p for p in pings[begun + 2:] if not obeyed(p)]
            rule = "by order of arrival"
        else:
            late = [p for p in pings if p.stamp_ns is not None and p.stamp_ns > reply.stamp_ns + STAMP_STEP_NS and not obeyed(p)]
            rule = "by time stamps"
        if late:
            raise StepFailed("ping %d was sent after the acknowledgement and has %s" % (late[0].number, describe(late[0])))
        following = [p for p in pings[begun:] if obeyed(p)]
        if not following:
            raise StepFailed("no ping obeyed: %s" % describe(pings[-1]))
        return following[0], following[0].number - (pings[begun - 1].number if begun else 0), rule

    # -- steps

    def identify(self):
        session = self.session
        session.command(SINGLE_REQUEST, struct.pack("<I", 7001))
        if not session.pump(session.reply_timeout_s, lambda: 7001 in session.answers):
            raise StepFailed("7501 came, the 7001 did not")
        record = session.answers[7001]
        devices = record.details.get("devices", [])
        if not devices:
            raise StepFailed("the 7001 holds no device")
        session.device_id, session.enumerator = devices[0]["identifier"], record.frame["system_enumerator"]
        return "device %d %r serial %d, %d bytes of XML" % (
            devices[0]["identifier"], devices[0]["description"], devices[0]["serial"], devices[0]["xml_bytes"])

    def request_settings(self):
        session = self.session
        session.answers.pop(7503, None)
        session.command(SINGLE_REQUEST, struct.pack("<I", 7503))
        if not session.pump(session.reply_timeout_s, lambda: 7503 in session.answers):
            raise StepFailed("7501 came, no 7503 with ping number 0 did")
        return session.answers[7503].header

    def settings(self):
        header = self.request_settings()
        return "range %.4g m, rate %.4g /s, power %.4g dB, gain %.4g dB, pulse %.4g s, ping state %d" % tuple(header[n] for n in (
            "range_selection", "max_ping_rate", "power_selection", "gain_selection", "tx_pulse_width", "ping_state"))

    def subscribe(self):
        self.session.command(SUBSCRIBE, struct.pack("<I%dI" % len(self.subscription), len(self.subscription), *self.subscription))
        return "%d record types" % len(self.subscription)

    def listen(self):
        session, begun, before = self.session, len(self.session.pings), dict(self.session.counts)
        session.pump(self.seconds)
        if len(session.pings) - begun < 2:
            raise StepFailed("%d pings in %.1f s" % (len(session.pings) - begun, self.seconds))
        missing = [k for k in self.subscription if k != 7500 and session.counts.get(k, 0) == before.get(k, 0)]
        if missing:
            raise StepFailed("subscribed and acknowledged, but never came: %s" % missing)
        wanted = [k for k in PING_ORDER if k in self.subscription]
        for ping in session.pings[begun + 1:-1]:    # the first and the last may have been cut by the listening itself
            session.findings.check("missing", "ping %d" % ping.number, "records", [k for k in ping.kinds if k in wanted], wanted)
        return "%d pings without a gap, period %.6f s" % (len(session.pings) - begun, self.period_s())

    def set_value(self, command, field, candidates, samples_follow=False):
        """Tries the candidates until one is accepted, then holds the following pings to it."""
        session = self.session
        if not session.pings:
            self.wait_pings(1, "before the command")
        old = dict(session.pings[-2 if len(session.pings) > 1 else -1].samples)  # the last may still be on its way
        echoes = len(session.echoes)
        refusals = []
        for value in candidates:
            value = struct.unpack("<f", struct.pack("<f", value))[0]
            try:
                reply, begun = session.command(command, struct.pack("<f", value))
                break
            except Refused as error:
                refusals.append("%.6g: %s" % (value, error))
        else:
            raise StepFailed("refused " + "; ".join(refusals))
        before = session.pings[begun - 1].settings[field] if begun else None
        wanted = value
        self.session.pump(self.latency_s())
        self.wait_pings(4, "after %s %.6g" % (field, value))
        first, after, rule = self.judge(reply, begun, lambda p: p.settings[field] == wanted, lambda p: "%s %.7g, expected %.7g" % (
            field, p.settings[field], wanted))
        changed = ""
        if samples_follow:
            same = [k for k, n in first.samples.items() if old.get(k) == n]
            if same and before != wanted:
                raise StepFailed("%s changed, the samples of %s did not (%s)" % (field, same, first.samples))
            changed = ", samples " + ", ".join("%d: %s -> %d" % (k, old.get(k), n) for k, n in sorted(first.samples.items()))
        if 7500 in self.subscription:
            matching = [e for e in session.echoes[echoes:] if e.header["remote_control_id"] == command and e.body[:4] == struct.pack("<f", value)]
            if not matching:
                raise StepFailed("subscribed to 7500, but the accepted command %d was not echoed" % command)
        return "%s %.6g -> %.6g in ping %d, %d after the acknowledgement, %s%s" % (
            field, before if before is not None else float("nan"), wanted, first.number, after, rule, changed)

    def refuse_range(self, values):
        session = self.session
        was = session.pings[-1].settings["range_selection"]
        told = []
        for value in values:
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
        self.session.command(SINGLE_REQUEST, struct.pack("<I", 7503), drf_offset=64)
        return "acknowledged"

    def rate(self, candidates):
        line = self.set_value(MAX_RATE, "max_ping_rate", candidates)
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
        stopped = self.request_settings()
        if stopped["ping_state"] != 0:
            raise StepFailed("7503 says ping state %d after stop, expected 0" % stopped["ping_state"])
        session.pump(max(0.5, 2.0 * period) + self.latency_s())
        count = len(session.pings)
        session.pump(max(1.0, 3.0 * period))
        if len(session.pings) != count:
            raise StepFailed("%d pings came while stopped" % (len(session.pings) - count))
        last = session.pings[-1].stamp_ns
        if None not in (last, reply.stamp_ns) and reply.stamp_ns + STAMP_STEP_NS < last < reply.stamp_ns + 30e9:
            raise StepFailed("ping %d was sent after the stop was acknowledged" % session.pings[-1].number)
        session.command(START_PINGING)
        if not session.pump(self.patience_s(), lambda: len(session.pings) >= count + 3):
            raise StepFailed("%d pings in %.1f s after start" % (len(session.pings) - count, self.patience_s()))
        running = self.request_settings()
        if running["ping_state"] != 1:
            raise StepFailed("7503 says ping state %d after start, expected 1" % running["ping_state"])
        return "%d in flight after the stop, silent, then ping %d went on" % (count - begun, session.pings[count].number)

    def unsubscribe(self, kind):
        session = self.session
        session.command(UNSUBSCRIBE, struct.pack("<II", 1, kind))
        self.wait_pings(3, "after the unsubscription")  # records already queued for us may still come
        before = dict(session.counts)
        self.wait_pings(3, "after the unsubscription")
        extra = session.counts.get(kind, 0) - before.get(kind, 0)
        if extra:
            raise StepFailed("%d records of %d still came" % (extra, kind))
        stopped = [k for k in self.subscription if k in PING_ORDER and k != kind and session.counts.get(k, 0) == before.get(k, 0)]
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
        if session.packets.pending or (session.packets.buffer and not session.packets.datagrams):
            raise StepFailed("half a record was left on the connection")
        return "silent"


def run_session(options, findings):
    udp = options.udp is not None
    address = parse_address(options.udp or options.connect)
    kinds = options.subscribe or DEFAULT_SUBSCRIPTION
    session = Session(address, findings, udp, options.max_packet, options.verbose, gapless=True,
                      reply_timeout_s=options.reply_timeout)
    contract = Contract(session, kinds, options.seconds)
    step, everything = contract.run, options.sequence
    try:
        if step("7001 by 1050", contract.identify):
            step("7503 by 1050", contract.settings)
            if step("subscribe 1051", contract.subscribe) and step("gapless pings", contract.listen):
                remote_control(contract, options, everything)
        if everything or options.end_subscriptions or udp:
            step("end subscriptions 1052", contract.end)
    except (ProtocolError, OSError) as error:
        findings.add("session", str(error))
    finally:
        session.close()
    if udp:
        session.packets.lost += len(session.packets.pending)    # begun and never ended
    if session.packets.lost:
        findings.add("packet", "%d packets of fragmented records were lost" % session.packets.lost)
    elapsed = time.monotonic() - session.started
    return contract.rows, {
        "address": "%s:%d" % address, "transport": "udp" if udp else "tcp", "elapsed_s": round(elapsed, 3), "bytes": session.bytes,
        "packets": session.packets.packets, "fragmented_records": session.packets.fragmented,
        "records": {str(k): session.counts[k] for k in sorted(session.counts)}, "pings": len(session.pings),
        "ping_summary": summarise(session.pings),
        "steps": [{"step": n, "ok": ok, "detail": d, "seconds": round(s, 3)} for n, ok, d, s in contract.rows]}


def remote_control(contract, options, everything):
    step = contract.run

    def now(field):
        return contract.session.pings[-1].settings[field]

    def wish(value, *candidates):
        return [value] if value is not None else list(candidates)

    if everything or options.set_range is not None:
        r = now("range_selection")
        step("range 1003", contract.set_value, RANGE, "range_selection", wish(options.set_range, 0.6 * r, 0.8 * r, 1.25 * r), True)
    if everything or options.bad_range is not None:
        values = [options.bad_range] if options.bad_range is not None else [1e6, -5.0, float("nan")]
        step("bad range 1003", contract.refuse_range, values)
    if everything or options.power is not None:
        p = now("power_selection")
        step("power 1005", contract.set_value, POWER, "power_selection", wish(options.power, p - 6.0, p + 3.0))
    if everything or options.gain is not None:
        g = now("gain_selection")
        step("gain 1008", contract.set_value, GAIN, "gain_selection", wish(options.gain, g + 3.0, g - 3.0))
    if everything or options.pulse_length is not None:
        t = now("tx_pulse_width")
        step("pulse length 1006", contract.set_value, PULSE_LENGTH, "tx_pulse_width", wish(options.pulse_length, 0.5 * t, 0.8 * t, 1.25 * t))
    if everything or options.rate is not None:
        achieved = 1.0 / contract.period_s()
        step("rate 1004", contract.rate, wish(options.rate, 0.5 * achieved, 0.8 * achieved))
    if everything:
        step("unknown command", contract.refuse, 65000, b"", 0x7007)
        step("record not offered", contract.refuse, SINGLE_REQUEST, struct.pack("<I", 65000), 0x7002)
        step("frame offset 64", contract.frame_offset_64)
    if everything or options.stop_start:
        step("stop 1101, start 1100", contract.stop_start)
    if everything or options.unsubscribe is not None:
        step("unsubscribe 1056", contract.unsubscribe, options.unsubscribe or 7018)


# ---------------------------------------------------------------------------------------------------------------------
# Command line

def parse_address(text):
    host, _, port = text.rpartition(":")
    return host or "127.0.0.1", int(port)


def parse_arguments(arguments):
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0], epilog="Exit codes: 0 no findings, 1 findings, 2 usage.")
    parser.add_argument("files", nargs="*", metavar="FILE.s7k")
    parser.add_argument("--connect", metavar="HOST:PORT", help="listen to a 7k server over TCP")
    parser.add_argument("--udp", metavar="HOST:PORT", help="the same over UDP")
    parser.add_argument("--seconds", type=float, default=3.0, help="time to listen, seconds (default 3)")
    parser.add_argument("--sequence", action="store_true", help="test the whole remote-control protocol and print a table")
    parser.add_argument("--subscribe", type=lambda s: [int(x) for x in s.split(",")], metavar="ID,ID", help="record types to subscribe to")
    parser.add_argument("--expect-ping-gapless", action="store_true", help="no effect, kept for scripts: gaps are always findings")
    parser.add_argument("--set-range", type=float, metavar="M")
    parser.add_argument("--bad-range", type=float, metavar="M", help="a range that must be refused with 0x7001 without effect")
    parser.add_argument("--power", type=float, metavar="DB")
    parser.add_argument("--gain", type=float, metavar="DB")
    parser.add_argument("--pulse-length", type=float, metavar="S")
    parser.add_argument("--rate", type=float, metavar="HZ")
    parser.add_argument("--stop-start", action="store_true")
    parser.add_argument("--unsubscribe", type=int, metavar="ID")
    parser.add_argument("--end-subscriptions", action="store_true")
    parser.add_argument("--max-packet", type=int, default=SPEC_MAX_PACKET, help="largest packet allowed, 0 for any size (default 60000)")
    parser.add_argument("--reply-timeout", type=float, default=5.0, metavar="S")
    parser.add_argument("--ignore", type=lambda s: s.split(","), default=[], metavar="KIND,KIND",
                        help="kinds of findings to ignore, by their printed names (range, order, gap, ...)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")
    parser.add_argument("--verbose", action="store_true", help="print every record")
    options = parser.parse_args(arguments)
    if bool(options.files) + (options.connect is not None) + (options.udp is not None) != 1:
        parser.error("give files, or --connect, or --udp")
    try:
        parse_address(options.connect or options.udp or "x:0")
    except ValueError:
        parser.error("not HOST:PORT: %s" % (options.connect or options.udp))
    return options


def main(arguments=None):
    options = parse_arguments(arguments)
    findings = Findings(ignore=options.ignore)
    rows, summary = [], {}
    try:
        if options.files:
            summary = {"files": [read_file(path, findings, options.verbose) for path in options.files]}
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
            if part["ping_summary"]:
                print("  " + json.dumps(part["ping_summary"]))
        if "packets" in part:
            print("  %d packets, %d records in more than one" % (part["packets"], part["fragmented_records"]))
    for line in findings.lines:
        print("  " + line)
    hidden = findings.total - len(findings.lines)
    if hidden:
        print("  ... and %d more of the same kinds" % hidden)
    print("FAILED: %d findings" % findings.total if failed else "all well")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
