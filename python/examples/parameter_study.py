"""A parameter study: how the scatter of soundings depends on source level and pulse length.

Every combination of two parameters is a rig of its own, made by overrides; the rest of the configuration stays the same. For the same ping, all
rigs have the same seabed and the same noise.

    python parameter_study.py [--pings N]
"""

import argparse
from pathlib import Path
from typing import Dict, Tuple

import numpy as np

import echotank

RIG = Path(__file__).resolve().parent / "rigs" / "flat.toml"
DEPTH_M = 15.0
LEVELS_DB = (150, 170, 200)
PULSES_MS = (0.25, 1.0)


def scatter(level_db: float, pulse_ms: float, pings: int) -> Tuple[float, float]:
    """Share of beams with a sounding, and the standard deviation of their depths in metres, within 45 degrees of the vertical."""
    overrides = {"sonar.ping.source_level_db": level_db, "sonar.pulse.duration_ms": pulse_ms}
    errors, beams = [], 0
    for ping in echotank.Rig(RIG, overrides).pings(1, pings):
        s = ping.soundings
        inside = np.abs(s.angle_rad) < np.radians(45)
        depth_m = 0.5 * ping.sound_speed_m_per_s * s.twtt_s * np.cos(s.angle_rad)
        errors.append(depth_m[inside] - DEPTH_M)
        beams += int((np.abs(ping.beam_angle_rad) < np.radians(45)).sum())
    all_errors = np.concatenate(errors)
    return len(all_errors) / beams, float(all_errors.std()) if len(all_errors) else float("nan")


def main() -> Dict[Tuple[float, float], Tuple[float, float]]:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pings", type=int, default=10)
    args = parser.parse_args()
    table = {}
    print("source level   pulse    beams with a sounding   standard deviation")
    for level_db in LEVELS_DB:
        for pulse_ms in PULSES_MS:
            found, deviation_m = scatter(level_db, pulse_ms, args.pings)
            table[level_db, pulse_ms] = found, deviation_m
            print(f"{level_db:9d} dB {pulse_ms:7.2f} ms {100 * found:15.1f} % {deviation_m:20.3f} m")
    return table


if __name__ == "__main__":
    main()
