"""Doppler shift of an echo from element samples: the pulse-pair estimator, compared with the motion of the platform.

The phase of the echo of a tone turns by 2 pi f_d / f_s from sample to sample. The mean product of each sample with the conjugate of the one
before therefore has the angle of the Doppler shift f_d.

    python doppler.py [--pings N]
"""

import argparse
from pathlib import Path

import numpy as np

import echotank

RIG = Path(__file__).resolve().parent / "rigs" / "point.toml"


def pulse_pair_hz(x: np.ndarray, rate_hz: float) -> float:
    """Mean frequency of a row of samples about the centre frequency, hertz."""
    return float(np.angle(np.vdot(x[:-1], x[1:])) * rate_hz / (2 * np.pi))


def expected_hz(ping: echotank.Ping, point_m: np.ndarray) -> float:
    """Doppler shift of a resting point for a transmitter and a receiver at the same place, hertz.

    The speed towards the point compresses the wave on the way out and on the way back: f_d = f_c ((c + v) / (c - v) - 1).
    """
    way_m = point_m - np.array(ping.pose.position_m)
    towards_m_per_s = np.dot(ping.pose.velocity_m_per_s, way_m) / np.linalg.norm(way_m)
    c = ping.sound_speed_m_per_s
    return ping.center_frequency_hz * ((c + towards_m_per_s) / (c - towards_m_per_s) - 1)


def main() -> float:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pings", type=int, default=10)
    args = parser.parse_args()
    point_m = np.loadtxt(RIG.with_name("point.csv"), delimiter=",", skiprows=2)[:3]
    worst = 0.0
    print(" ping   measured   expected")
    for ping in echotank.Rig(RIG).pings(1, args.pings):
        x = ping.elements["rx"][0]
        echo = x[np.abs(x) > 0.5 * np.abs(x).max()]
        measured, expected = pulse_pair_hz(echo, ping.sample_rate_hz), expected_hz(ping, point_m)
        worst = max(worst, abs(measured - expected))
        print(f"{ping.number:5d} {measured:8.2f} Hz {expected:7.2f} Hz")
    print(f"largest difference: {worst:.2f} Hz, {worst * 1500 / (2 * 200e3):.4f} m/s")
    return worst


if __name__ == "__main__":
    raise SystemExit(0 if main() < 1.0 else "the shifts differ")
