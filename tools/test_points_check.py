"""Tests of the outside calculation: its roots, its phases, its bound, and that it notices what it should."""

import contextlib
import io
import math
import os
import pathlib
import sys
import tempfile
import unittest

import numpy as np

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import points_check as check  # noqa: E402
import points_model as model  # noqa: E402
import points_random  # noqa: E402

REAL = check.REAL
C, FC, FS = 1500.0, 400e3, 40e3
VELOCITY = np.array([4.896, 1.428, 0.0], REAL)      # 5.1 m/s along (0.96, 0.28)


def rig_of(points, duration_s=5e-3, kind="lfm", bandwidth_hz=20e3, sign=1.0, elements=3):
    array = check.ReceiveArray("port", elements, 0.002, np.array([0.1, -0.2, 0.3]), (60.0, 0.0, 2.0), 0, 0.0)
    return check.Rig(C, FC, kind, bandwidth_hz, duration_s, sign, 0.0, [array], [check.Transmitter(np.array([0.5, 0.0, 0.2]))], points, [])


def brute_force(rig, transmit, receive, velocity, t):
    """One sample of one point by Newton iteration on the defining equation, in plain scalar arithmetic."""
    place, strength = rig.points[0]

    def sub(a, b):
        return [x - y for x, y in zip(a, b)]

    def norm(a):
        return math.sqrt(sum(x * x for x in a))

    transmit, receive, v = [float(x) for x in transmit], [float(x) for x in receive], [float(x) for x in velocity]

    def at(start, when):
        return [x + s * when for x, s in zip(start, v)]

    def solve(residual, guess):
        for _ in range(60):
            step = residual(guess) / ((residual(guess + 1e-6) - residual(guess - 1e-6)) / 2e-6)
            guess -= step
            if abs(step) < 1e-17:
                break
        return guess

    left = solve(lambda s: C * (t - s) - norm(sub(place, at(transmit, s))) - norm(sub(place, at(receive, t))), 0.0)
    u = solve(lambda x: C * x - norm(sub(place, transmit)) - norm(sub(place, at(receive, x))), t)
    if not 0 <= left <= rig.duration_s:
        return 0.0
    phase = rig.sweep_sign * math.pi * rig.bandwidth_hz / rig.duration_s * (left - rig.duration_s / 2) ** 2 + 2 * math.pi * FC * (left - t)
    return strength / (norm(sub(place, transmit)) * norm(sub(place, at(receive, u)))) * complex(math.cos(phase), math.sin(phase))


class Roots(unittest.TestCase):
    def setUp(self):
        self.point = np.array([40.0, 60.0, 20.0], REAL)
        self.transmit = np.array([0.1, 0.2, 1.0], REAL)
        self.receive = np.array([-0.9, 0.4, 1.5], REAL)

    def test_departure_satisfies_the_defining_equation_to_1e16_s(self):
        t = np.linspace(0.095, 0.12, 57).astype(REAL)
        left = check.departure(t, self.point, self.transmit, self.receive, VELOCITY, REAL(C))
        path = check.length(self.point - self.transmit - VELOCITY * left[:, None]) + check.length(
            self.point - self.receive - VELOCITY * t[:, None])
        self.assertLess(float(np.abs(t - left - path / C).max()), 1e-16 if np.finfo(REAL).eps < 1e-18 else 1e-15)

    def test_the_leading_edge_left_at_zero(self):
        u = check.leading_edge(self.point, self.transmit, self.receive, VELOCITY, REAL(C))
        left = check.departure(np.array([u], REAL), self.point, self.transmit, self.receive, VELOCITY, REAL(C))
        self.assertLess(abs(float(left[0])), 1e-16)

    def test_a_platform_at_rest_has_the_sum_of_the_legs(self):
        rest = np.zeros(3, REAL)
        u = check.leading_edge(self.point, self.transmit, self.receive, rest, REAL(C))
        legs = check.length(self.point - self.transmit) + check.length(self.point - self.receive)
        self.assertLess(abs(float(u - legs / C)), 1e-17)

    def test_collocated_excess_over_stop_and_hop_has_its_closed_form(self):
        beta = check.length(VELOCITY) / C
        d = self.point - self.transmit
        cosine = (d * VELOCITY).sum() / check.length(d) / check.length(VELOCITY)
        u = check.leading_edge(self.point, self.transmit, self.transmit, VELOCITY, REAL(C))
        excess = u * C - 2 * check.length(d)
        self.assertLess(abs(float(excess - 2 * check.length(d) * (beta**2 - beta * cosine) / (1 - beta**2))), 1e-12)


class Rotations(unittest.TestCase):
    def test_bow_up_and_starboard_down_and_clockwise_are_positive(self):
        x, y = np.array([1, 0, 0], REAL), np.array([0, 1, 0], REAL)
        np.testing.assert_allclose((check.rotation(0, 90, 0) @ x).astype(float), [0, 0, -1], atol=1e-15)
        np.testing.assert_allclose((check.rotation(90, 0, 0) @ y).astype(float), [0, 0, 1], atol=1e-15)
        np.testing.assert_allclose((check.rotation(0, 0, 90) @ x).astype(float), [0, 1, 0], atol=1e-15)


class Signal(unittest.TestCase):
    def test_samples_equal_a_scalar_newton_solution_to_1e9(self):
        for sign, bandwidth in ((1.0, 20e3), (-1.0, 20e3), (1.0, 0.0)):
            rig = rig_of([((40.0, 60.0, 20.0), 2.0 - 1.0j)], bandwidth_hz=bandwidth, sign=sign)
            transmit, receive = np.array([0.1, 0.2, 1.0], REAL), np.array([-0.9, 0.4, 1.5], REAL)
            made = check.element_samples(rig, 0.0, transmit, receive, VELOCITY, FS, 0.09, 800)
            inside = np.flatnonzero(made.exact)
            self.assertAlmostEqual(len(inside), rig.duration_s * FS, delta=3)
            self.assertEqual(len(made.on_edge.nonzero()[0]), 0)
            for k in list(inside[::17]) + [inside[0] - 1, inside[-1] + 1]:
                want = brute_force(rig, transmit, receive, VELOCITY, 0.09 + k / FS)
                self.assertLess(abs(made.exact[k] - want), 1e-9 * np.abs(made.exact).max(), k)

    def test_at_rest_the_linear_form_is_exact(self):
        rig = rig_of([((40.0, 60.0, 20.0), 1.0 + 0j), ((41.0, 60.0, 20.0), 0.3j)])
        made = check.element_samples(rig, 0.0, np.zeros(3, REAL), np.ones(3, REAL), np.zeros(3, REAL), FS, 0.0, 6000)
        self.assertLess(check.relative_l2(made.linear, made.exact), 1e-13)
        self.assertEqual(made.bound, 0.0)

    def test_the_linear_form_errs_as_its_residual_phase_says(self):
        for range_m in (15.0, 40.0, 75.0):
            for degrees in (30, 60, 90, 135):
                angle = math.radians(degrees)
                along, across = np.array([0.96, 0.28, 0.0]), np.array([-0.28, 0.96, 0.0])
                place = tuple(range_m * (math.cos(angle) * along + math.sin(angle) * across))
                rig = rig_of([(place, 1.0 + 0j)])
                made = check.element_samples(rig, 0.0, np.zeros(3, REAL), np.array([0, 0, 0.01], REAL), VELOCITY, FS, 0.0, 6000)
                speed2 = float((VELOCITY**2).sum())
                phase = 2 * math.pi * FC * speed2 * math.sin(angle) ** 2 * rig.duration_s**2 / (range_m * C)
                with self.subTest(range_m=range_m, degrees=degrees):
                    self.assertEqual(made.support_differs, 0)
                    self.assertAlmostEqual(made.peak_phase_rad / phase, 1.0, delta=0.01)
                    measured = check.relative_l2(made.linear, made.exact)
                    self.assertLessEqual(measured, made.bound)
                    self.assertGreater(measured, made.bound * 0.95)
                    # The bound counts f_c + B/2 (2.5 % more) and the samples there are (the rms of s^2 is T^2/sqrt(5) in the limit).
                    self.assertAlmostEqual(made.bound / (phase / math.sqrt(5)), 1.025, delta=0.02)

    def test_overlapping_echoes_add_and_separate_ones_add_in_squares(self):
        self.assertEqual(check.overlap_sum([(0, 10, 3.0), (5, 12, 4.0)]), 7.0)
        self.assertEqual(check.overlap_sum([(0, 10, 3.0), (20, 30, 4.0)]), 5.0)

    def test_a_sample_on_the_pulse_edge_is_counted(self):
        u = check.leading_edge(np.array([75.0, 0, 0], REAL), np.zeros(3, REAL), np.zeros(3, REAL), np.zeros(3, REAL), REAL(C))
        self.assertEqual(float(u), 0.1)
        rig = rig_of([((75.0, 0.0, 0.0), 1.0 + 0j)])
        made = check.element_samples(rig, 0.0, np.zeros(3, REAL), np.zeros(3, REAL), np.zeros(3, REAL), FS, 0.0, 6000)
        self.assertEqual(int(made.on_edge.sum()), 2)       # 0.1 s and 0.105 s are both samples at 40 kHz


RIG = """
[medium]
sound_speed_m_per_s = 1500.0
absorption = "none"
[nav]
vertical = "depth"
source = [{ kind = "csv", path = "track.csv" }]
[scene]
points = "points.csv"
[[sonar]]
name = "head"
[sonar.pulse]
kind = "lfm"
center_frequency_khz = 400.0
bandwidth_khz = 20.0
duration_ms = 1.0
sweep = "down"
[sonar.receiver]
rx_filter = "none"
noise_db = "none"
[sonar.ping]
source_level_db = 0.0
[[sonar.transmit]]
name = "tx"
position_m = [0.5, 0.0, 0.2]
[[sonar.receive]]
name = "port"
transmit = "tx"
sensitivity_db = 0.0
elements = 2
spacing_m = 0.002
element_pattern = "omnidirectional"
position_m = [0.1, -0.2, 0.3]
roll_deg = 60.0
[[sonar.receive]]
name = "starboard"
sensitivity_db = 0.0
elements = 3
spacing_m = 0.003
element_pattern = "omnidirectional"
position_m = [0.1, 0.2, 0.3]
roll_deg = -60.0
transmit = "tx"
"""
UTC_S = 1750000000


class Comparison(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = folder.name
        self.write("rig.toml", RIG)
        self.write("points.csv", "# made up\nnorth_m,east_m,down_m,amplitude,amplitude_imag\n30,20,10,1.5,0\n25,-22,12,1,-0.5\n")
        self.write_track("0.0")
        rig = check.load_rig(self.path("rig.toml"))
        pings, elements, count = 2, 5, 2400
        self.data = {"iq_by_element": np.zeros((pings, elements, count), complex), "element_array": np.array([0, 0, 1, 1, 1]),
                     "sample_rate_hz": FS, "first_sample_s": 0.0, "center_frequency_hz": 400e3, "sound_speed_m_per_s": 1500.0,
                     "ping_utc_ns": np.array([UTC_S * 10**9 + 100_000_000, UTC_S * 10**9 + 480_000_001]),
                     "transmit_position_m": np.zeros((pings, 3)), "element_position_m": np.zeros((pings, elements, 3)),
                     "velocity_m_per_s": np.zeros((pings, 3))}
        bodies = [b for a in rig.receive for b in check.elements_in_body(a)]
        for p in range(pings):
            position, velocity, world = check.uniform_pose(rig.nav, int(self.data["ping_utc_ns"][p]), 0.06)
            transmit = position + world @ rig.transmit[0].position_m.astype(REAL)
            self.data["transmit_position_m"][p], self.data["velocity_m_per_s"][p] = transmit, velocity
            for e, body in enumerate(bodies):
                receive = position + world @ body
                self.data["element_position_m"][p, e] = receive
                self.data["iq_by_element"][p, e] = check.element_samples(rig, 0.0, transmit, receive, velocity, FS, 0.0, count).exact

    def path(self, name):
        return os.path.join(self.folder, name)

    def write(self, name, text):
        with open(self.path(name), "w", encoding="utf-8") as stream:
            stream.write(text)

    def write_track(self, bend):
        self.write("track.csv", "time_s,north_m,east_m,down_m,roll_deg,pitch_deg,heading_deg\n%d.0,0,0,1,2,-1,15\n%d.5,2.4,%s,1,2,-1,15\n"
                   "%d.0,4.8,0.0,1,2,-1,15\n" % (UTC_S, UTC_S, bend, UTC_S + 1))

    def run_check(self, *arguments):
        np.savez(self.path("pings.npz"), **self.data)
        out = io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
            code = check.main([self.path("rig.toml"), self.path("pings.npz"), *arguments])
        return code, out.getvalue()

    def test_equal_samples_pass_and_the_linear_model_does_not(self):
        self.assertEqual(self.run_check()[0], 0, self.run_check()[1])
        self.assertEqual(self.run_check("--model", "linear")[0], 1)
        self.assertEqual(self.run_check("--model", "linear", "--limit", "1e-2")[0], 0)

    def test_one_wrong_sample_of_one_element_fails(self):
        k = np.flatnonzero(self.data["iq_by_element"][1, 3])[7]
        self.data["iq_by_element"][1, 3, k] *= 1 + 1e-7
        code, text = self.run_check()
        self.assertEqual(code, 1)
        self.assertIn("ping 1, element 3", text)

    def test_an_echo_where_there_should_be_none_fails(self):
        self.data["iq_by_element"][0, 0, 5] = 1e-9
        self.assertEqual(self.run_check()[0], 1)

    def test_a_micrometre_or_a_micrometre_per_second_fails(self):
        for key in ("transmit_position_m", "element_position_m", "velocity_m_per_s"):
            with self.subTest(key=key):
                kept = self.data[key].copy()
                self.data[key].flat[2] += 1e-6
                self.assertEqual(self.run_check()[0], 1)
                self.data[key] = kept

    def test_no_echo_at_all_is_not_a_pass(self):
        self.data["iq_by_element"] = self.data["iq_by_element"][:, :, :100]
        self.assertEqual(self.run_check()[0], 1)

    def test_a_track_that_bends_is_refused_by_the_linear_model(self):
        self.write_track("0.001")
        code, text = self.run_check("--model", "linear")
        self.assertEqual(code, 2)
        self.assertIn("bends", text)

    def test_samples_of_a_straight_track_fail_on_one_that_bends(self):
        self.write_track("0.001")
        self.assertEqual(self.run_check()[0], 1)

    def test_a_weak_window_fails_by_the_norm_of_windows_alone(self):
        # A 1e-6 of the strongest sample, where only a filter's tail would be.
        self.data["iq_by_element"][1, 3, 100] += 1e-6 * np.abs(self.data["iq_by_element"]).max()
        self.assertEqual(self.run_check("--limit", "1e-5")[0], 0)
        code, text = self.run_check("--limit", "1e-5", "--norm", "window")
        self.assertEqual(code, 1)
        self.assertIn("ping 1, element 3", text)

    def test_elements_can_be_chosen_and_values_set(self):
        self.data["iq_by_element"][:, 4] = 0
        self.assertEqual(self.run_check("--elements", "0,3")[0], 0)
        self.assertEqual(self.run_check("--elements", "0,4")[0], 1)
        self.assertEqual(self.run_check("--elements", "0,3", "--set", "sonar.pulse.taper=0.1")[0], 1)
        self.assertEqual(self.run_check("--set", "sonar.receiver.noise_db=30")[0], 2)


def sway(t):
    """A motion that rolls, turns and accelerates: position, and angles in degrees."""
    return (8 * t + 1.5 * t * t, 0.5 * np.sin(3 * t), 0.3 * np.cos(2 * t)), (10 * np.sin(2 * t), 5 * np.cos(3 * t), (350 + 25 * t) % 360)


class Moving(unittest.TestCase):
    """The calculation for any motion, against plain ones: a scalar solution, closed forms, and sums that are merely dense."""

    def setUp(self):
        self.nav = [(k * 20_000_000, *sway(k / 50)) for k in range(60)]
        self.motion = model.Motion(self.nav, 503_000_000)
        self.array = check.ReceiveArray("port", 2, 0.002, np.array([0.1, -0.2, 0.3]), (60.0, 0.0, 2.0), 0, 0.0)
        self.body = check.elements_in_body(self.array)[1].astype(float)

    def rig(self, points, **changes):
        rig = rig_of([(tuple(self.motion.origin_m + np.array(place)), strength) for place, strength in points], duration_s=2e-3)
        rig.receive = [self.array]
        for key, value in changes.items():
            setattr(rig, key, value)
        return rig

    def record(self, rig, first=0.0, count=2400, fs=FS):
        return model.element_record(rig, self.motion, self.array, (self.body, 0.0), fs, first, count)[0]

    def test_the_curve_meets_its_knots_and_a_smooth_motion_between_them(self):
        for k, (ns, place, angles) in enumerate(self.nav[20:40]):
            t = np.array([(ns - 503_000_000) / 1e9])
            position, matrix = self.motion.pose(t)
            np.testing.assert_allclose(position[0] + self.motion.origin_m, place, atol=1e-13)
            np.testing.assert_allclose(matrix[0], model.rotation(*angles), atol=1e-14)
        t = np.linspace(-0.2, 0.2, 37)
        for position, matrix, at in zip(*self.motion.pose(t), t + 0.503):
            place, angles = sway(at)
            np.testing.assert_allclose(position + self.motion.origin_m, place, atol=2e-5)
            np.testing.assert_allclose(matrix, model.rotation(*angles), atol=2e-5)

    def test_position_and_attitude_have_no_corner_at_a_knot(self):
        h, knot = 1e-6, self.motion.times[30]
        for part in self.motion.pose(np.array([knot - h, knot, knot + h])):
            np.testing.assert_allclose((part[1] - part[0]) / h, (part[2] - part[1]) / h, atol=1e-3)

    def test_the_rotation_of_either_tool_is_the_same(self):
        np.testing.assert_allclose(model.rotation(10, -20, 130), check.rotation(10, -20, 130).astype(float), atol=1e-15)

    def test_samples_satisfy_the_defining_equation(self):
        rig = self.rig([((0.5, 3.0, 12.0), 2.0 - 1.0j)], tukey=0.3)
        got = self.record(rig)
        c, place = C, np.array(rig.points[0][0]) - self.motion.origin_m

        def leg(t, body):
            position, matrix = self.motion.pose(np.array([t]))
            return float(np.linalg.norm(place - position[0] - matrix[0] @ body))

        leading = leg(0.0, rig.transmit[0].position_m) / c
        for _ in range(30):
            leading = (leg(0.0, rig.transmit[0].position_m) + leg(leading, self.body)) / c
        amplitude = rig.points[0][1] / leg(0.0, rig.transmit[0].position_m) / leg(leading, self.body)
        inside = np.flatnonzero(got)
        self.assertAlmostEqual(len(inside), rig.duration_s * FS, delta=3)
        for k in inside[::5]:
            t, sent = k / FS, 0.0
            for _ in range(30):
                sent = t - (leg(sent, rig.transmit[0].position_m) + leg(t, self.body)) / c
            level = math.sin(math.pi / 2 * min(sent, rig.duration_s - sent, 3e-4) / 3e-4) ** 2
            phase = math.pi * rig.bandwidth_hz / rig.duration_s * (sent - rig.duration_s / 2) ** 2 + 2 * math.pi * FC * (sent - t)
            self.assertLess(abs(got[k] - amplitude * level * complex(math.cos(phase), math.sin(phase))), 1e-9 * abs(amplitude), k)

    def test_uniform_motion_has_the_closed_form(self):
        velocity = np.array([4.896, 1.428, 0.3])
        nav = [(k * 100_000_000, tuple(velocity * k / 10), (3.0, -2.0, 35.0)) for k in range(20)]
        self.motion = model.Motion(nav, 1_000_000_000)
        rig = rig_of([((46.0, 21.0, 13.0), 1.0 - 0.5j), ((10.0, 1.0, 3.0), 0.1j)])
        rig.receive = [self.array]
        position, _, world = check.uniform_pose(nav, 1_000_000_000, 0.06)
        wanted = check.element_samples(rig, 0.0, position + world @ rig.transmit[0].position_m, position + world @ self.body,
                                       velocity.astype(REAL), FS, 0.0, 2400)
        self.assertLess(check.relative_l2(self.record(rig), wanted.exact), 1e-10)

    def test_the_filter_integrates_what_a_dense_sum_integrates(self):
        for taper, kind in ((0.0, "lfm"), (0.4, "lfm"), (1.0, "cw")):
            rig = self.rig([((0.5, 3.0, 12.0), 2.0 - 1.0j), ((0.3, 0.2, -0.4), 0.01)], filtered=True, tukey=taper, pulse_kind=kind)
            got = self.record(rig, count=1000)
            h, dense = model.Filter(rig, FS), 400
            reach = int(math.ceil(h.half_s * FS)) * dense
            rig.filtered = False
            # Samples between the dense steps: an error of first order is left at sharp edges.
            sums = self.record(rig, first=-reach / dense / FS + 0.5 / dense / FS, count=1000 * dense + 2 * reach, fs=FS * dense)
            taps = h.at((np.arange(2 * reach) - reach + 0.5) / dense / FS) / dense / FS
            wanted = np.array([sums[k * dense:k * dense + 2 * reach] @ taps[::-1] for k in range(1000)])
            with self.subTest(taper=taper):
                self.assertLess(check.relative_l2(got, wanted), 1e-7 if taper else 1e-3)

    def test_more_nodes_change_no_window_of_a_short_pulse(self):
        rig = self.rig([((0.5, 3.0, 12.0), 2.0 - 1.0j), ((0.3, 0.2, -0.4), 0.01)], filtered=True, tukey=0.5, duration_s=2.5e-4)
        few, rule = self.record(rig, count=1000), model.gauss
        self.addCleanup(setattr, model, "gauss", rule)
        model.gauss = lambda begin, end, count=None: rule(begin, end, (count or 5 + math.ceil(7 * (end - begin))) + 8)
        self.assertLess(model.window_error(few[None, :], self.record(rig, count=1000)[None, :], 32)[0], 1e-9)

    def test_the_filter_passes_its_band_and_stops_beyond_half_the_rate(self):
        rig = self.rig([])
        h = model.Filter(rig, FS)
        t = np.linspace(-h.half_s, h.half_s, 200_001)

        def gain(hz):
            return (h.at(t) * np.cos(2 * np.pi * hz * t)).sum() * (t[1] - t[0])

        self.assertAlmostEqual(gain(0.0), 1.0, delta=1e-9)
        self.assertLess(abs(gain(15e3) - 1), 2e-4)
        self.assertLess(abs(gain(21e3)), 1e-4)

    def test_patterns_have_zeros_and_a_baffled_back(self):
        piston = check.Pattern(2.0, 0.0, True)
        rays = np.array([[0, 0, 1], [0.5, 0, 0.75 ** 0.5], [0, 0, -1]])
        np.testing.assert_allclose(piston.towards(rays, 1.0), [1, 0, 0], atol=1e-15)

    def test_elements_of_an_arc_look_along_their_own_normals(self):
        array = check.ReceiveArray("arc", 3, 0.2, np.zeros(3), (0.0, 0.0, 0.0), 0, 0.0, check.Pattern(0.02, 0.0, False), radius_m=0.4)
        turn = math.degrees(0.5)
        places = check.elements_in_body(array).astype(float)
        np.testing.assert_allclose(np.linalg.norm(places + (0.0, 0.0, 0.4), axis=1), 0.4, atol=1e-15)
        self.motion = model.Motion([(k * 20_000_000, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)) for k in range(60)], 503_000_000)
        ahead = places + 7.0 * np.array([(math.sin(a), 0.0, math.cos(a)) for a in (-0.5, 0.0, 0.5)])
        for element in range(3):
            self.assertAlmostEqual(check.normal_deg(array, element), turn * (element - 1), places=12)
            rig = self.rig([(tuple(ahead[element]), 1.0)])

            def level(angle_deg):
                return model.Echoes(rig, self.motion, array, (places[element], angle_deg), 0.1).amplitude[0]
            normal = check.normal_deg(array, element)
            self.assertAlmostEqual(abs(level(normal + turn) / level(normal)), abs(np.sinc(0.02 * math.sin(0.5) * FC / C)), places=12)

    def test_planted_faults_are_found(self):
        right = self.rig([((0.5, 3.0, 12.0), 2.0 - 1.0j), ((0.3, 0.2, -0.4), 0.01)], filtered=True, tukey=0.1)
        wanted = self.record(right)[None, :]
        faults = {"taper": dict(tukey=0.11), "filter": dict(filtered=False), "sweep": dict(sweep_sign=-1.0),
                  "duration": dict(duration_s=2.0001e-3), "sound speed": dict(sound_speed_m_per_s=C * (1 + 1e-6))}
        for name, change in faults.items():
            with self.subTest(name):
                wrong = self.rig([((0.5, 3.0, 12.0), 2.0 - 1.0j), ((0.3, 0.2, -0.4), 0.01)], **{"filtered": True, "tukey": 0.1, **change})
                self.assertGreater(model.window_error(self.record(wrong)[None, :], wanted, 80)[0], 1e-4)
        for name, row in (("roll", lambda place, angles: (place, (angles[0] * 1.01, *angles[1:]))),
                          ("turn", lambda place, angles: (place, (*angles[:2], angles[2] * 1.001))),
                          ("acceleration", lambda place, angles: ((place[0] * 1.0001, *place[1:]), angles))):
            with self.subTest(name):
                self.motion = model.Motion([(ns, *row(place, angles)) for ns, place, angles in self.nav], 503_000_000)
                self.assertGreater(model.window_error(self.record(right)[None, :], wanted, 80)[0], 1e-4)


class Windows(unittest.TestCase):
    def test_the_worst_window_lies_at_any_offset(self):
        want = np.zeros((2, 300), complex)
        want[1, 100:150] = 1.0
        got = want.copy()
        got[1, 160] = 0.01
        # Windows of 40 samples: the one from sample 149 holds a single sample of the echo, the one from 150 none.
        error, row, offset = model.window_error(got, want, 40)
        self.assertEqual((row, offset), (1, 150))
        self.assertAlmostEqual(error, 0.01 / math.sqrt(40 * 10 ** -5.5), places=12)

    def test_silence_is_right_only_if_it_is_silent(self):
        silent = np.zeros((1, 50), complex)
        self.assertEqual(model.window_error(silent, silent, 32)[0], 0.0)
        self.assertEqual(model.window_error(silent + 1e-30, silent, 32)[0], math.inf)


class Promises(unittest.TestCase):
    def row(self, **values):
        return points_random.judge({"promised": 5e-4, "measured": 1e-4, "marks": [], **values}, 1e-3)

    def test_a_kept_promise_is_not_broken(self):
        self.assertEqual(self.row()["broken"], [])

    def test_an_error_above_the_promise_or_silently_above_the_tolerance_is_broken(self):
        self.assertEqual(self.row(measured=6e-4)["broken"], ["promise"])
        self.assertEqual(self.row(measured=2e-3)["broken"], ["promise", "silent"])

    def test_a_marked_answer_is_not_silent(self):
        self.assertEqual(self.row(measured=2e-3, promised=3e-3)["broken"], [])
        self.assertEqual(self.row(measured=2e-3, marks=["design limits"])["broken"], ["promise"])

    def test_a_seed_draws_the_same_rig_again(self):
        texts = []
        for _ in range(2):
            with tempfile.TemporaryDirectory() as folder:
                points_random.draw_rig(np.random.default_rng([7, 3]), pathlib.Path(folder), "auto")
                texts.append([pathlib.Path(folder, name).read_text() for name in ("rig.toml", "track.csv", "points.csv")])
        self.assertEqual(*texts)
        self.assertEqual(points_random.asked_of(os.devnull, ["sonar.model.tolerance=1e-4"]), 1e-4)


if __name__ == "__main__":
    unittest.main()
