"""Tests of the outside calculation: its roots, its phases, its bound, and that it notices what it should."""

import contextlib
import io
import math
import os
import sys
import tempfile
import unittest

import numpy as np

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import points_check as check  # noqa: E402

REAL = check.REAL
C, FC, FS = 1500.0, 400e3, 40e3
VELOCITY = np.array([4.896, 1.428, 0.0], REAL)      # 5.1 m/s along (0.96, 0.28)


def rig_of(points, duration_s=5e-3, kind="lfm", bandwidth_hz=20e3, sign=1.0, elements=3):
    array = check.ReceiveArray("port", elements, 0.002, np.array([0.1, -0.2, 0.3]), (60.0, 0.0, 2.0), 0, 0.0)
    return check.Rig(C, FC, kind, bandwidth_hz, duration_s, sign, 0.0, [array], [np.array([0.5, 0.0, 0.2])], points, [])


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
[nav]
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
position_m = [0.1, -0.2, 0.3]
roll_deg = 60.0
[[sonar.receive]]
name = "starboard"
sensitivity_db = 0.0
elements = 3
spacing_m = 0.003
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
            position, velocity, world = check.pose_at(rig.nav, int(self.data["ping_utc_ns"][p]), 0.06)
            transmit = position + world @ rig.transmit_positions_m[0].astype(REAL)
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

    def test_a_track_that_bends_is_refused(self):
        self.write_track("0.001")
        code, text = self.run_check()
        self.assertEqual(code, 2)
        self.assertIn("bends", text)


if __name__ == "__main__":
    unittest.main()
