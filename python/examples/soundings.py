"""Soundings of a fan as points on the bottom, compared with the true depth.

A sounding is an angle and a two-way travel time. On a level platform it lies at r sin(angle) to starboard and r cos(angle) below the array, with
r = c t / 2.

    python soundings.py [--pings N]
"""

import argparse
from pathlib import Path

import numpy as np

import echotank

RIG = Path(__file__).resolve().parent / "rigs" / "flat.toml"
DEPTH_M = 15.0


def points_m(ping: echotank.Ping) -> np.ndarray:
    """Soundings in the world: (soundings, 3), north, east, down."""
    s = ping.soundings
    range_m = 0.5 * ping.sound_speed_m_per_s * s.twtt_s
    heading = np.radians(ping.pose.heading_deg)
    across, down = range_m * np.sin(s.angle_rad), range_m * np.cos(s.angle_rad)
    array_m = ping.element_position_m["fan"].mean(axis=0)
    return array_m + np.stack([-across * np.sin(heading), across * np.cos(heading), down], axis=1)


def main() -> float:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pings", type=int, default=20)
    args = parser.parse_args()
    clouds = []
    for ping in echotank.Rig(RIG).pings(1, args.pings):
        clouds.append(points_m(ping))
    cloud = np.concatenate(clouds)
    east, error = cloud[:, 1], cloud[:, 2] - DEPTH_M
    print(f"{len(cloud)} soundings of {len(clouds)} pings")
    print(" across track   soundings   mean error   standard deviation")
    for low in range(-24, 24, 8):
        inside = (east >= low) & (east < low + 8)
        if inside.any():
            print(f"{low:4d} to {low + 8:3d} m {inside.sum():9d} {error[inside].mean():10.3f} m {error[inside].std():14.3f} m")
    middle = np.abs(east) < 12
    return float(np.abs(np.median(error[middle])))


if __name__ == "__main__":
    raise SystemExit(0 if main() < 0.05 else "the soundings are biased")
