"""What the protocols crate writes, read by programs that nobody here wrote (tools/requirements.txt).

The sample files come from `protocols/examples/wire_samples`; what they should hold is stated here a second time. To read a folder that was
written before, name it in WIRE_SAMPLES.
"""

import os
import subprocess
import sys
import tempfile
import unittest
import warnings

import numpy as np

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


if __name__ == "__main__":
    warnings.simplefilter("error")
    unittest.main()
