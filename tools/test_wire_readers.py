"""Third-party readers (tools/requirements.txt) on the output of the protocols crate.

The sample files come from `protocols/examples/wire_samples`; their expected content is stated here independently. WIRE_SAMPLES names a folder
written before.
"""

import json
import os
import re
import struct
import shutil
import subprocess
import sys
import tempfile
import unittest
import warnings

import numpy as np

from test_daemon_readers import program

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
UTC_S, UTC_MS = 1_750_000_000, 123
LATITUDE, LONGITUDE = -36.8, -121.8
HEADING, PITCH, ROLL = 359.9, 3.0, 5.0

needs_310 = unittest.skipIf(sys.version_info < (3, 10), "the reader needs Python 3.10")

_samples = None


def count(ping, channel, samples):
    """The integers of a channel of a ping."""
    k = np.arange(samples, dtype=np.int64)
    return ((k * 7919 + channel * 104729 + ping * 15485863) % 40001 - 20000).astype(np.int64)


def setUpModule():
    global _samples
    folder = os.environ.get("WIRE_SAMPLES")
    if folder:
        _samples = folder
        return
    keep = tempfile.TemporaryDirectory()
    unittest.addModuleCleanup(keep.cleanup)
    subprocess.run(["cargo", "run", "--quiet", "--package", "echotank-protocols", "--example", "wire_samples", "--", keep.name], cwd=ROOT, check=True)
    _samples = keep.name


def sample(name):
    return os.path.join(_samples, name)


def daemon_files(name, formats, *changes):
    """What the daemon's own pipeline records of three pings of a configuration, in a folder."""
    keep = tempfile.TemporaryDirectory()
    unittest.addModuleCleanup(keep.cleanup)
    command = [program(), "replay", os.path.join("hil-configs", name), "--quiet", "--out", keep.name, "--pings", "1..3", "--formats", formats]
    for change in changes:
        command += ["--set", change]
    subprocess.run(command, cwd=ROOT, check=True)
    return keep.name


@needs_310
class Daemon(unittest.TestCase):
    """Files of the pipeline itself: JSF by pyjsf and XTF by pyxtf, against the same pings as NumPy arrays."""

    @classmethod
    def setUpClass(cls):
        # A thin seabed: what is read matters here, not what lies in it.
        cls.folder = daemon_files("quickstart.toml", "jsf,xtf,s7k,npz", "scene.seabed.density_per_m2=0.2")
        with np.load(os.path.join(cls.folder, "pings.npz"), allow_pickle=False) as arrays:
            cls.lines = arrays["lines"]
            cls.utc_ns = arrays["ping_utc_ns"]
            cls.rate_hz = float(arrays["sample_rate_hz"])
        with open(os.path.join(ROOT, "hil-configs", "quickstart.toml"), encoding="utf-8") as text:
            found = re.search(r"full_scale_v = ([0-9.]+)", text.read())
            cls.full_scale_v = float(found.group(1))

    def test_jsf_holds_every_line_to_half_a_step_of_its_exponent(self):
        from pyjsf.jsf_io import jsf_read
        messages = jsf_read(os.path.join(self.folder, "hull.jsf"))
        sonar = [m for m in messages if m[0].message_type == 80]
        self.assertEqual(len(sonar), 6)
        for head, trace, data in sonar:
            ping, side = trace.ping_number - 1, head.channel_number
            line = self.lines[ping, side].astype(np.float64)
            step = 2.0 ** -trace.weighting_factor
            # The exact number that block floating point makes of a volt.
            np.testing.assert_array_equal(data, np.floor(line / step + 0.5) * step)
            self.assertGreater(np.max(np.abs(data)) / step, 16383, "the exponent is as fine as can be")
            self.assertEqual(trace.ping_time, self.utc_ns[ping] // 10**9)
            self.assertEqual(trace.sampling_interval, round(1e9 / self.rate_hz))
        counts = {kind: sum(m[0].message_type == kind for m in messages) for kind in (2002, 2020, 2060)}
        # Navigation strings come once a second; the three pings last less.
        self.assertEqual(counts, {2002: 1, 2020: 3, 2060: 3})
        # pyjsf passes over what it has no layout for: these are counted by their headers.
        with open(os.path.join(self.folder, "hull.jsf"), "rb") as file:
            rest, kinds = file.read(), []
        while rest:
            kinds.append(struct.unpack_from("<H", rest, 4)[0])
            rest = rest[16 + struct.unpack_from("<I", rest, 12)[0] :]
        self.assertEqual((kinds.count(182), kinds.count(426)), (1, 2))

    def test_pingverter_reads_every_line_of_the_jsf_file_with_the_state_of_its_ping(self):
        from pingverter.jsf_class import jsf
        with tempfile.TemporaryDirectory() as folder:
            log = jsf(os.path.join(self.folder, "hull.jsf"))
            # Its own caller sets these three.
            log.metaDir, log.trans, log.tempC = folder, None, 1.2
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                log._getFileLen()
                log._parseFileHeader()
                log._parsePingHeader()
        table = log.header_dat.sort_values(["ping_number", "channel"])
        self.assertEqual(table["ping_number"].tolist(), [1, 1, 2, 2, 3, 3])
        self.assertEqual(table["channel"].tolist(), [0, 1] * 3)
        self.assertEqual(set(table["ping_cnt"]), {self.lines.shape[2]})
        self.assertEqual(set(table["f"]), {100.0})
        with open(os.path.join(self.folder, "truth.jsonl"), encoding="utf-8") as text:
            truth = [json.loads(line) for line in text]
        metres = table["pixM"].to_numpy()
        # The interval is written in whole nanoseconds.
        np.testing.assert_allclose(metres, 0.5 * 1525.0 / self.rate_hz, rtol=1e-4)
        for k, ping in enumerate(truth):
            for _, row in table[table["ping_number"] == k + 1].iterrows():
                self.assertAlmostEqual(row["time_s"], self.utc_ns[k] / 1e9, delta=1.1e-3)
                self.state(row, ping)

    def state(self, row, ping):
        """Position to 1e-4 minutes, angles to their steps; its own course is ten times too small where ours is in whole degrees."""
        nav = ping["pose"]
        self.assertAlmostEqual(row["lat"], nav["latitude_deg"], delta=1e-6)
        self.assertAlmostEqual(row["lon"], nav["longitude_deg"], delta=1e-6)
        self.assertAlmostEqual(row["instr_heading"], nav["heading_deg"], delta=0.0051)
        self.assertAlmostEqual(row["pitch"], nav["pitch_deg"], delta=0.0028)
        self.assertAlmostEqual(row["roll"], nav["roll_deg"], delta=0.0028)

    def test_xtf_holds_every_line_in_counts_of_the_full_scale(self):
        import pyxtf
        header, packets = pyxtf.xtf_read(os.path.join(self.folder, "hull.xtf"))
        self.assertEqual([c.TypeOfChannel for c in header.sonar_info[:2]], [1, 2])
        pings = packets[pyxtf.XTFHeaderType.sonar]
        self.assertEqual((len(pings), len(packets[pyxtf.XTFHeaderType.attitude])), (3, 3))
        for number, ping in enumerate(pings):
            for side in (0, 1):
                line = self.lines[number, side].astype(np.float64)
                expected = np.clip(np.floor(line / self.full_scale_v * 65535.0 + 0.5), 0, 65535)
                np.testing.assert_array_equal(ping.data[side], expected)

    def test_7k_side_scan_is_the_same_lines_by_the_independent_reader(self):
        import sevenk_reader
        with open(os.path.join(self.folder, "hull.s7k"), "rb") as file:
            raw = file.read()
        number, at = 0, 0
        findings = sevenk_reader.Findings()
        while at < len(raw):
            size = int.from_bytes(raw[at + 8:at + 12], "little")
            record = sevenk_reader.parse_record(raw[at:at + size], "at %d" % at, findings)
            at += size
            if record.kind != 7007:
                continue
            counts = np.frombuffer(record.body, dtype="<u2").reshape(2, -1)
            for side in (0, 1):
                line = self.lines[number, side].astype(np.float64)
                expected = np.clip(np.floor(line / self.full_scale_v * 65535.0 + 0.5), 0, 65535)
                np.testing.assert_array_equal(counts[side], expected)
            number += 1
        self.assertEqual(number, 3)


@needs_310
class Jsf(unittest.TestCase):
    """pyjsf: its own ctypes tables, and weighting put to the samples."""

    @classmethod
    def setUpClass(cls):
        from pyjsf.jsf_io import jsf_read
        cls.messages = jsf_read(sample("sample.jsf"))

    def of_type(self, kind):
        return [m for m in self.messages if m[0].message_type == kind]

    def test_samples_are_exact_in_formats_0_1_and_9(self):
        sonar = self.of_type(80)
        self.assertEqual(len(sonar), 3 * 3 * 2)
        formats = {20: 0, 21: 1, 40: 9}
        for head, trace, data in sonar:
            ping, channel = trace.ping_number - 1, head.channel_number
            self.assertEqual(trace.data_format, formats[head.subsystem_number])
            shorts = 500 * (1 if trace.data_format == 0 else 2)
            np.testing.assert_array_equal(data, count(ping, channel, shorts) / 512.0)

    def test_time_place_and_attitude_are_those_of_the_ping(self):
        for head, trace, _ in self.of_type(80):
            ping = trace.ping_number - 1
            self.assertEqual((trace.ping_time, trace.milliseconds % 1000), (UTC_S, UTC_MS + 100 * ping))
            self.assertEqual((trace.year, trace.day, trace.hour, trace.minute, trace.second), (2025, 166, 15, 6, 40))
            self.assertEqual(trace.coordinate_units, 2)
            self.assertAlmostEqual(trace.latitude / 600000.0, LATITUDE, delta=1e-6)
            self.assertAlmostEqual(trace.longitude / 600000.0, LONGITUDE, delta=1e-6)
            self.assertEqual(trace.compass_heading, 35990)
            self.assertAlmostEqual(trace.pitch * 180.0 / 32768.0, PITCH, delta=0.0028)
            self.assertAlmostEqual(trace.roll * 180.0 / 32768.0, ROLL, delta=0.0028)
            self.assertEqual((trace.number_samples, trace.sampling_interval, trace.sample_frequency), (500, 20000, 50000))
            self.assertEqual((trace.pulse_start_freq, trace.pulse_end_freq, trace.sweep_length), (42000, 44000, 2))
            self.assertEqual((trace.altitude, trace.sound_speed), (20000, 1500.0))

    def test_sensors_are_read(self):
        for _, attitude in self.of_type(2020):
            self.assertEqual((attitude.estimated_heave, attitude.heading, attitude.validity_flag), (-250, 35990, 0x3C0))
            self.assertAlmostEqual(attitude.pitch * 180.0 / 32768.0, PITCH, delta=0.0028)
        for _, pressure in self.of_type(2060):
            self.assertEqual((pressure.pressure, pressure.sound_velocity), (14696, 1500000))
        self.assertEqual([len(self.of_type(kind)) for kind in (2020, 2060, 2002)], [3, 3, 3])


class Xtf(unittest.TestCase):
    """pyxtf: its own ctypes tables."""

    @classmethod
    def setUpClass(cls):
        import pyxtf
        cls.header, cls.packets = pyxtf.xtf_read(sample("sample.xtf"))
        cls.pings = cls.packets[pyxtf.XTFHeaderType.sonar]
        cls.attitudes = cls.packets[pyxtf.XTFHeaderType.attitude]

    def test_channels_are_as_stated(self):
        self.assertEqual((self.header.NumberOfSonarChannels, self.header.NavUnits), (3, 3))
        kinds = [(c.TypeOfChannel, c.BytesPerSample, c.SampleFormat) for c in self.header.sonar_info]
        self.assertEqual(kinds, [(1, 2, 3), (2, 4, 5), (1, 1, 8)])

    def test_samples_are_exact(self):
        self.assertEqual(len(self.pings), 3)
        for number, ping in enumerate(self.pings):
            self.assertEqual([len(d) for d in ping.data], [500] * 3)
            np.testing.assert_array_equal(ping.data[0], count(number, 0, 500) + 20000)
            np.testing.assert_array_equal(ping.data[1], (count(number, 1, 500) + 20000) / 512.0)
            np.testing.assert_array_equal(ping.data[2], (count(number, 2, 500) + 20000) % 256)

    def test_time_place_and_attitude_are_those_of_the_ping(self):
        for number, ping in enumerate(self.pings):
            # To 0.01 s, rounded.
            self.assertEqual(ping.get_time(), np.datetime64("2025-06-15T15:06:40.120") + np.timedelta64(100 * number, "ms"))
            self.assertEqual((ping.SensorYcoordinate, ping.SensorXcoordinate), (LATITUDE, LONGITUDE))
            got = (ping.SensorPitch, ping.SensorRoll, ping.SensorHeading, ping.Heave, ping.SoundVelocity)
            for value, expected in zip(got, (PITCH, ROLL, HEADING, 0.25, 750.0)):
                self.assertAlmostEqual(value, expected, delta=1e-4)
        for number, attitude in enumerate(self.attitudes):
            self.assertEqual(attitude.get_time(), np.datetime64("2025-06-15T15:06:40.123456") + np.timedelta64(100 * number, "ms"))
            for value, expected in zip((attitude.Pitch, attitude.Roll, attitude.Heading), (PITCH, ROLL, HEADING)):
                self.assertAlmostEqual(value, expected, delta=1e-4)
        self.assertEqual(len(self.attitudes), 3)


@unittest.skipUnless(shutil.which("tshark"), "tshark is not installed")
class Vita49(unittest.TestCase):
    """Wireshark's dissector of VITA 49, on a capture."""

    @classmethod
    def setUpClass(cls):
        fields = ["type", "sid", "seq", "ts_int", "ts_frac_picosecond", "valid", "overrng", "data"]
        command = ["tshark", "-r", sample("sample_vita49.pcap"), "-Y", "vrt", "-T", "fields", "-E", "separator=,"]
        for field in fields:
            command += ["-e", "vrt." + field]
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, check=True, text=True)
        cls.packets = [dict(zip(fields, line.split(","))) for line in done.stdout.splitlines()]

    def of(self, kind, stream):
        return [p for p in self.packets if int(p["type"]) == kind and int(p["sid"], 0) == stream]

    def test_samples_of_the_vector_stream_are_exact_and_flagged(self):
        data = self.of(1, 0x100)
        self.assertTrue(all((p["valid"], p["overrng"]) == ("1", "0") for p in data), data[0])
        got = np.frombuffer(bytes.fromhex("".join(p["data"] for p in data)), dtype=">i2").reshape(3, 500, 4, 2)
        for ping in range(3):
            for element in range(4):
                np.testing.assert_array_equal(got[ping, :, element, :].ravel(), count(ping, element, 1000))

    def test_samples_of_the_real_stream_are_exact(self):
        got = np.frombuffer(bytes.fromhex("".join(p["data"] for p in self.of(1, 0x200))), dtype=">i2").reshape(3, 500)
        for ping in range(3):
            np.testing.assert_array_equal(got[ping], count(ping, 9, 500))

    def test_packets_are_counted_and_their_times_are_their_first_samples(self):
        for stream, rate, sample_bytes in ((0x100, 50e3, 16), (0x200, 2e6, 2)):
            data = self.of(1, stream)
            self.assertEqual([int(p["seq"]) for p in data], [n % 16 for n in range(len(data))])
            self.assertEqual([int(p["seq"]) for p in self.of(4, stream)], [0, 1, 2])
            before = 0
            for packet in data:
                ping, sample_in_ping = divmod(before, 500)
                expected = 123456789000 + ping * 100000000000 + round(sample_in_ping / rate * 1e12)
                self.assertEqual((int(packet["ts_int"]), int(packet["ts_frac_picosecond"])), (UTC_S, expected))
                before += len(packet["data"]) // 2 // sample_bytes
            self.assertEqual(before, 3 * 500)


@needs_310
class SigMf(unittest.TestCase):
    """The reference implementation: its schema, and its reading of the samples."""

    def test_words_are_valid_and_samples_exact(self):
        import sigmf
        recording = sigmf.sigmffile.fromfile(sample("sample.sigmf-meta"), autoscale=False)
        recording.validate()
        self.assertEqual(recording.get_global_field("core:num_channels"), 4)
        for ping in range(3):
            capture = recording.get_captures()[ping]
            self.assertEqual((capture["core:sample_start"], capture["core:frequency"]), (500 * ping, 430e3))
            self.assertEqual(capture["core:datetime"], "2025-06-15T15:06:40.%d23456789Z" % (1 + ping))
            got = recording.read_samples(start_index=500 * ping, count=500)
            self.assertEqual(got.shape, (500, 4))
            for element in range(4):
                numbers = count(ping, element, 1000)
                np.testing.assert_array_equal(got[:, element], numbers[::2] + 1j * numbers[1::2])


class Wav(unittest.TestCase):
    """libsndfile, by soundfile."""

    def test_eight_channels_are_exact_in_riff_and_rf64(self):
        import soundfile
        for name, kind, container, dtype, scale in (
            ("sample_i16.wav", "PCM_16", "WAVEX", "int16", 1),
            ("sample_i32_rf64.wav", "PCM_32", "RF64", "int32", 65536),
            ("sample_f32.wav", "FLOAT", "WAVEX", "float32", 1 / 32768.0),
        ):
            about = soundfile.info(sample(name))
            self.assertEqual((about.subtype, about.format, about.samplerate, about.channels, about.frames), (kind, container, 192000, 8, 500))
            data, _ = soundfile.read(sample(name), dtype=dtype)
            for channel in range(8):
                np.testing.assert_array_equal(data[:, channel], count(0, channel, 500) * scale)


class PingProtocol(unittest.TestCase):
    """brping, the makers' own client: its parser, its definitions, its checksum."""

    @classmethod
    def setUpClass(cls):
        from brping import PingParser, definitions
        # Numbers mean different things to different devices: 504 is longer in the list of all.
        known = {**definitions.payload_dict_omniscan450, **definitions.payload_dict_surveyor240, **definitions.payload_dict_common}
        parser = PingParser(payload_dict=known)
        cls.messages = []
        with open(sample("sample.ping"), "rb") as file:
            for byte in file.read():
                if parser.parse_byte(byte) == PingParser.NEW_MESSAGE:
                    cls.messages.append(parser.rx_msg)
        cls.errors = parser.errors

    def of(self, message_id):
        return [m for m in self.messages if m.message_id == message_id]

    def test_every_frame_is_taken(self):
        self.assertEqual((len(self.messages), self.errors), (8 + 3 * 4, 0))

    def test_settings_and_answers_are_read(self):
        info = self.of(4)[0]
        self.assertEqual((info.device_revision, info.firmware_version_major, info.firmware_version_minor, info.firmware_version_patch), (1, 1, 2, 3))
        self.assertEqual(self.of(1)[0].acked_id, 116)
        self.assertEqual((self.of(2)[0].nacked_id, bytes(self.of(2)[0].nack_message)), (2197, b"out of range"))
        params = self.of(2197)[0]
        self.assertEqual((params.start_mm, params.length_mm, params.msec_per_ping, params.gain_index, params.num_results, params.enable), (1000, 50000, 20, -1, 1200, 1))
        self.assertEqual(self.of(116)[0].speed_of_sound, 1500000)
        params = self.of(3023)[0]
        self.assertEqual((params.start_mm, params.end_mm, params.sos_mps, params.gain_index, params.msec_per_ping), (500, 30000, 1500.0, -1, 100))
        self.assertEqual((params.ping_enable, params.enable_channel_data, params.enable_yz_point_data, params.enable_atof_data), (1, 0, 1, 1))
        self.assertEqual((params.target_ping_hz, params.n_range_steps, params.pulse_len_steps), (240000, 400, 1.5))

    def test_lines_of_the_omniscan_are_exact(self):
        for ping, line in enumerate(self.of(2198)):
            self.assertEqual((line.ping_number, line.num_results, line.sos_dmps, line.channel_number), (ping, 1200, 15000, 1))
            self.assertEqual((line.min_pwr_db, line.max_pwr_db), (10.0, 90.0))
            np.testing.assert_array_equal(np.frombuffer(bytes(line.pwr_results), "<u2"), count(ping, 0, 1200) + 20000)

    def test_points_and_attitude_of_the_surveyor_are_exact(self):
        for ping, points in enumerate(self.of(3012)):
            self.assertEqual((points.ping_number, points.num_points, points.utc_msec), (ping, 200, UTC_S * 1000 + UTC_MS + 100 * ping))
            got = np.frombuffer(bytes(points.atof_point_data), "<f4").reshape(200, 4)
            np.testing.assert_array_equal(got[:, 0], count(ping, 1, 200) / 32768.0)
            np.testing.assert_array_equal(got[:, 1], (count(ping, 2, 200) + 20000) / 1048576.0)
        for ping, points in enumerate(self.of(3011)):
            np.testing.assert_array_equal(np.frombuffer(bytes(points.yz_point_data), "<f4"), count(ping, 3, 200))
            self.assertEqual((points.water_degC, points.water_bar, points.num_points), (12.5, -1000.0, 100))
        for attitude in self.of(504):
            up = (attitude.up_vec_x, attitude.up_vec_y, attitude.up_vec_z)
            self.assertAlmostEqual(np.degrees(np.arcsin(up[0])), PITCH, delta=1e-4)
            self.assertAlmostEqual(np.degrees(np.arctan2(up[1], up[2])), ROLL, delta=1e-4)


if __name__ == "__main__":
    warnings.simplefilter("error")
    unittest.main()
