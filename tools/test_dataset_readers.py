"""Third-party readers (tools/requirements.txt) of data sets: xarray and zarr on a Zarr store; mcap with mcap-ros2-support, and rosbags, on MCAP
files. Their values are those of the pings.npz of the same replay, bit for bit where the types agree.

The program is target/release/echotank, or ECHOTANK.
"""

import os
import pathlib
import subprocess
import sys
import tempfile
import unittest
import warnings

import numpy as np

from test_daemon_readers import program

ROOT = pathlib.Path(__file__).resolve().parent.parent
RIG = ROOT / "python" / "examples" / "rigs" / "flat.toml"
PINGS = 3

needs_311 = unittest.skipIf(sys.version_info < (3, 11), "the readers need Python 3.11")

folder = None
npz = {}


def replay(out, formats, pings, rig=RIG):
    command = [program(), "replay", rig, "--out", out, "--pings", "1..%d" % pings, "--formats", formats, "--set", "sonar.ping.range_m=20"]
    subprocess.run([*command, "--quiet"], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)


def setUpModule():
    global folder
    if sys.version_info < (3, 11):
        return
    keep = tempfile.TemporaryDirectory()
    unittest.addModuleCleanup(keep.cleanup)
    folder = pathlib.Path(keep.name)
    replay(folder, "npz,zarr,mcap,masks", PINGS)
    with np.load(folder / "pings.npz", allow_pickle=False) as arrays:
        npz.update(arrays)


def equal_bits(got, want):
    """Whether two arrays have one shape, type and content; NaN equals NaN."""
    got, want = np.ascontiguousarray(got), np.ascontiguousarray(want)
    return got.shape == want.shape and got.dtype == want.dtype and got.tobytes() == want.tobytes()


@needs_311
class Zarr(unittest.TestCase):
    """xarray, which reads through the package zarr."""

    def setUp(self):
        with warnings.catch_warnings():
            # Of the packages that these import.
            warnings.simplefilter("ignore")
            import xarray
            import zarr
        self.xarray, self.zarr = xarray, zarr

    def test_xarray_opens_the_pings_as_one_data_set_with_the_bits_of_npz(self):
        with self.xarray.open_zarr(folder / "pings.zarr", chunks=None) as data:
            for name, of_npz in (
                ("elements", "iq_by_element"),
                ("beams", "beams"),
                ("lines", "lines"),
                ("ping", "ping_number"),
                ("element_array", "element_array"),
                ("line_side", "line_side"),
                ("position_m", "position_m"),
                ("velocity_m_per_s", "velocity_m_per_s"),
                ("transmit_position_m", "transmit_position_m"),
                ("element_position_m", "element_position_m"),
                ("line_position_m", "line_position_m"),
                ("sounding_twtt_s", "sounding_twtt_s"),
                ("sounding_error_s", "sounding_error_s"),
                ("sounding_method", "sounding_method"),
            ):
                self.assertTrue(equal_bits(data[name].values, npz[of_npz]), name)
            self.assertEqual(data["elements"].dims, ("ping", "element", "sample"))
            self.assertEqual(data["elements"].dtype, np.complex64)
            for k, name in enumerate(("roll_deg", "pitch_deg", "heading_deg")):
                self.assertTrue(equal_bits(data[name].values, npz["attitude_deg"][:, k]), name)
            for k, name in enumerate(("latitude_deg", "longitude_deg")):
                self.assertTrue(equal_bits(data[name].values, npz["geodetic_deg"][:, k]), name)
            angles = np.broadcast_to(npz["beam_angle_rad"], data["beam_angle_rad"].shape)
            self.assertTrue(equal_bits(data["beam_angle_rad"].values, angles))
            self.assertEqual(data["time"].dtype, "datetime64[ns]")
            np.testing.assert_array_equal(data["time"].values.astype(np.int64), npz["ping_utc_ns"])
            self.assertLessEqual({"time", "latitude_deg", "sample_time_s", "line_side"}, set(data.coords))
            units = {name: data[name].attrs["units"] for name in ("elements", "lines", "position_m", "sounding_twtt_s")}
            self.assertEqual(units, {"elements": "V", "lines": "V", "position_m": "m", "sounding_twtt_s": "s"})
            for name in ("sample_rate_hz", "first_sample_s", "center_frequency_hz", "sound_speed_m_per_s"):
                self.assertEqual(data.attrs[name], float(npz[name]))
            self.assertEqual(data.attrs["plan"], str(npz["plan"]))
            # The labels of a data set are of use: one ping by its number.
            second = data.sel(ping=2)
            self.assertTrue(equal_bits(second["beams"].values, npz["beams"][1]))

    def test_labels_are_those_of_the_masks(self):
        with self.xarray.open_zarr(folder / "pings.zarr", chunks=None) as data:
            for archive, of in (("masks.npz", "line"), ("fan_masks.npz", "beam")):
                with np.load(folder / archive) as masks:
                    for name in ("target", "shadow", "depth_m"):
                        got = data["%s_%s" % (of, name)].values
                        self.assertTrue(equal_bits(got, masks[name]), "%s of %s" % (name, archive))

    def test_a_chunk_is_one_ping(self):
        group = self.zarr.open_group(folder / "pings.zarr", mode="r")
        self.assertEqual(group.metadata.zarr_format, 3)
        elements = group["elements"]
        self.assertEqual(elements.chunks, (1, *elements.shape[1:]))
        chunk = (folder / "pings.zarr" / "elements" / "c" / "1" / "0" / "0").read_bytes()
        self.assertEqual(chunk, npz["iq_by_element"][1].tobytes())


class Mcap:
    """The messages of a ping. `messages` gives topic, log time in nanoseconds and decoded message of each."""

    def of_topics(self):
        found = {}
        for topic, time_ns, message in self.messages(folder / "demo.mcap"):
            found.setdefault(topic, []).append((time_ns, message))
        return found

    def image(self, message):
        """The values of an image (columns, samples)."""
        self.assertEqual((message.image.is_bigendian, message.image.dtype), (False, 8))
        values = np.frombuffer(bytes(message.image.data), "<f4").reshape(-1, message.image.beam_count)
        return values

    def complex_image(self, message):
        values = self.image(message)
        return np.ascontiguousarray(values).view(np.complex64).T

    def test_messages_hold_the_bits_of_npz(self):
        topics = self.of_topics()
        names = ["fan/beams", "fan/elements", "fan/image", "fan/soundings", "fix", "port/elements", "port/line", "pose", "starboard/elements", "starboard/line"]
        self.assertEqual(sorted(topics), sorted(["/tf", "/tf_static"] + ["/echotank/demo/" + name for name in names]))
        for topic, messages in topics.items():
            self.assertEqual(len(messages), 1 if topic == "/tf_static" else PINGS, topic)
        for p in range(PINGS):
            utc_ns = int(npz["ping_utc_ns"][p])
            one = {}
            for topic, messages in topics.items():
                time_ns, message = messages[p if topic != "/tf_static" else 0]
                header = message.transforms[0].header if topic.startswith("/tf") else message.header
                stamp_ns = header.stamp.sec * 10**9 + header.stamp.nanosec
                if topic != "/tf_static":
                    self.assertEqual((time_ns, stamp_ns), (utc_ns, utc_ns), topic)
                one[topic.removeprefix("/echotank/demo/")] = message
            for k, array in enumerate(("port", "starboard", "fan")):
                image = one[array + "/elements"]
                want = npz["iq_by_element"][p, npz["element_array"] == k]
                self.assertTrue(equal_bits(self.complex_image(image), want), array)
                self.assertEqual(image.header.frame_id, "demo/" + array)
                self.assertEqual(image.samples_per_beam, want.shape[1])
                self.assertEqual(image.sample_rate, np.float32(npz["sample_rate_hz"]))
            self.assertTrue(equal_bits(self.complex_image(one["fan/beams"]), npz["beams"][p]))
            for k, side in enumerate(("port", "starboard")):
                self.assertTrue(equal_bits(self.image(one[side + "/line"])[:, 0], npz["lines"][p, k]), side)
            self.projection(p, one["fan/image"])
            self.soundings(p, one["fan/soundings"])
            self.platform(p, one)

    def projection(self, p, image):
        magnitude = np.hypot(npz["beams"][p].real, npz["beams"][p].imag)
        np.testing.assert_allclose(self.image(image).T, magnitude, rtol=3e-7)
        samples = npz["beams"].shape[2]
        time_s = npz["first_sample_s"] + np.arange(samples) / npz["sample_rate_hz"]
        np.testing.assert_allclose(image.ranges, 0.5 * 1500.0 * time_s, rtol=1e-6)
        angle_rad = np.broadcast_to(npz["beam_angle_rad"], (PINGS, npz["beams"].shape[1]))[p]
        directions = [(d.x, d.y, d.z) for d in image.beam_directions]
        np.testing.assert_allclose(directions, np.stack([0 * angle_rad, np.sin(angle_rad), np.cos(angle_rad)], 1), atol=1e-12)
        self.assertEqual((image.ping_info.frequency, image.ping_info.sound_speed), (300e3, 1500.0))
        self.assertEqual(len(image.ping_info.rx_beamwidths), len(angle_rad))

    def soundings(self, p, detections):
        twtt_s = npz["sounding_twtt_s"][p].astype(np.float32)
        self.assertTrue(equal_bits(np.array(detections.two_way_travel_times, np.float32), twtt_s))
        flags = np.array([flag.flag for flag in detections.flags])
        np.testing.assert_array_equal(flags == 0, npz["sounding_method"][p] > 0)
        self.assertGreater((flags == 0).sum(), 20)
        angle_rad = np.broadcast_to(npz["beam_angle_rad"], (PINGS, len(twtt_s)))[p].astype(np.float32)
        self.assertTrue(equal_bits(np.array(detections.rx_angles, np.float32), angle_rad))

    def platform(self, p, one):
        fix = one["fix"]
        np.testing.assert_array_equal([fix.latitude, fix.longitude], npz["geodetic_deg"][p])
        north, east, down = npz["position_m"][p]
        pose = one["pose"].pose
        self.assertEqual((pose.position.x, pose.position.y, pose.position.z), (east, north, -down))
        transform = one["/tf"].transforms[0]
        self.assertEqual((transform.header.frame_id, transform.child_frame_id), ("map", "base_link"))
        base, at = rotation(transform.transform.rotation), vector(transform.transform.translation)
        np.testing.assert_array_equal(at, [east, north, -down])
        # The axes of base_link in east, north, up: forward, port, up.
        roll, pitch, heading = np.radians(npz["attitude_deg"][p])
        ahead = [np.sin(heading) * np.cos(pitch), np.cos(heading) * np.cos(pitch), np.sin(pitch)]
        np.testing.assert_allclose(base[:, 0], ahead, atol=1e-9)
        self.assertLess(abs(base[2, 1] - np.sin(roll) * np.cos(pitch)), 1e-9)
        self.elements(base, at, one["/tf_static"], npz, p)

    def elements(self, base, at, static, arrays, p):
        """The elements, through the frames of their arrays, lie where npz has them. y points to starboard, whichever way the array's +x end does."""
        frames = {t.child_frame_id: t.transform for t in static.transforms}
        for k, array in enumerate(("port", "starboard", "fan", "other")[: len(frames)]):
            frame = frames["demo/" + array]
            position_m = arrays["element_position_m"][p, arrays["element_array"] == k]
            elements = len(position_m)
            along_m = (-1 if array == "other" else 1) * 0.0025 * (np.arange(elements) - 0.5 * (elements - 1))
            local = np.stack([0 * along_m, along_m, 0 * along_m], 1)
            got = at + (vector(frame.translation) + local @ rotation(frame.rotation).T) @ base.T
            np.testing.assert_allclose(got[:, [1, 0, 2]] * [1, 1, -1], position_m, atol=1e-9)

    def test_frames_point_to_starboard_where_an_array_is_mounted_the_other_way(self):
        other = '[[sonar.receive]]\nname = "other"\ntransmit = "tx-down"\nelements = 4\nspacing_m = 0.0025\nyaw_deg = -90.0\n\n'
        text = RIG.read_text(encoding="utf-8").replace("[sonar.receiver]", other + "[sonar.receiver]")
        text = text.replace('"track.csv"', '"%s"' % RIG.with_name("track.csv"))
        with tempfile.TemporaryDirectory() as place:
            place = pathlib.Path(place)
            (place / "rig.toml").write_text(text, encoding="utf-8")
            replay(place, "npz,mcap", 1, place / "rig.toml")
            one = {topic: message for topic, _, message in self.messages(place / "demo.mcap")}
            with np.load(place / "pings.npz", allow_pickle=False) as arrays:
                transform = one["/tf"].transforms[0].transform
                self.elements(rotation(transform.rotation), vector(transform.translation), one["/tf_static"], arrays, 0)

    def test_a_file_that_was_cut_off_holds_every_whole_ping_after_recover(self):
        data = (folder / "demo.mcap").read_bytes()
        with tempfile.TemporaryDirectory() as place:
            path = pathlib.Path(place) / "cut.mcap"
            for share, pings in ((0.4, 1), (0.7, 2), (1.0, 3)):
                path.write_bytes(data[: int(share * len(data)) - 20])
                subprocess.run([program(), "recover", path], check=True, capture_output=True)
                lines = [m for topic, _, m in self.messages(path) if topic == "/echotank/demo/port/line"]
                self.assertEqual(len(lines), pings, "of %d %%" % (100 * share))
                for p, line in enumerate(lines):
                    self.assertTrue(equal_bits(self.image(line)[:, 0], npz["lines"][p, 0]))


def vector(v):
    return np.array([v.x, v.y, v.z])


def rotation(q):
    """The matrix of a quaternion."""
    x, y, z, w = q.x, q.y, q.z, q.w
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])


@needs_311
class McapRos2(Mcap, unittest.TestCase):
    """mcap and mcap-ros2-support: the readers of the makers of MCAP, which decode by the definitions in the file."""

    def messages(self, path):
        from mcap.reader import make_reader
        from mcap_ros2.decoder import DecoderFactory
        with open(path, "rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            for _, channel, message, decoded in reader.iter_decoded_messages():
                yield channel.topic, message.log_time, decoded


@needs_311
class Rosbags(Mcap, unittest.TestCase):
    """rosbags: an independent reader of ROS bags without ROS."""

    def messages(self, path):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
        with AnyReader([path], default_typestore=get_typestore(Stores.EMPTY)) as reader:
            for connection, time_ns, data in reader.messages():
                yield connection.topic, time_ns, reader.deserialize(data, connection.msgtype)


if __name__ == "__main__":
    unittest.main()
