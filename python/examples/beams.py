"""Matched filter and beams of a multibeam sonar in NumPy, compared with those of Echotank.

A pulse compressor correlates each element with the transmitted pulse. A far-field beamformer then delays the elements so that a plane wave from
the angle of the beam adds up, and sums them. Both are products in the frequency domain:

    Y_b(f) = conj(A(f)) sum_e w_e X_e(f) exp(-j 2 pi (f + f_c) x_e sin(theta_b) / c)

    python beams.py [--rig RIG] [--ping N]
"""

import argparse
from pathlib import Path

import numpy as np

import echotank

RIG = Path(__file__).resolve().parents[2] / "hil-configs" / "multibeam.toml"


def replica(pulse: dict, rate_hz: float) -> np.ndarray:
    """Complex envelope of the pulse: (samples,). A linear sweep about the centre frequency, with a Tukey taper."""
    duration_s, sweep = pulse["duration_s"], {"lfm-up": 1.0, "lfm-down": -1.0, "cw": 0.0}[pulse["kind"]]
    t = np.arange(int(duration_s * rate_hz + 1e-9) + 1) / rate_hz
    flank_s = max(0.5 * pulse["taper"] * duration_s, 1e-12)
    from_end = np.clip(np.minimum(t, duration_s - t) / flank_s, 0, 1)
    rate = sweep * pulse["bandwidth_hz"] / duration_s
    return np.sin(0.5 * np.pi * from_end) ** 2 * np.exp(1j * np.pi * rate * (t - 0.5 * duration_s) ** 2)


def beams_of(ping: echotank.Ping) -> np.ndarray:
    """Beams of the fan: (beams, samples)."""
    fan = ping.plan["fan"]
    array = ping.plan["receive"][fan["array"]]
    if "radius_m" in array:
        raise SystemExit(f"{array['name']} is an arc: this example forms beams of a straight line")
    x = ping.elements[array["name"]].astype(np.complex128)
    a = replica(ping.plan["plan"]["pulse"], ping.sample_rate_hz)
    count, samples = x.shape
    # Twice the row: neither the pulse nor the delays wrap around.
    length = 2 * samples

    # Matched filter: an echo of unit amplitude peaks at 1.
    f = np.fft.fftfreq(length, 1 / ping.sample_rate_hz)
    compressed = np.fft.fft(x, length) * np.conj(np.fft.fft(a, length)) / np.sum(np.abs(a) ** 2)

    # Beams: a Hann weighting of the line, then a delay for each element and angle.
    place = (np.arange(count) + 0.5) / count - 0.5
    weights = 0.5 + 0.5 * np.cos(2 * np.pi * place)
    x_m = (np.arange(count) - 0.5 * (count - 1)) * array["spacing_m"]
    delay_s = np.outer(np.sin(ping.beam_angle_rad), x_m) / ping.sound_speed_m_per_s
    total = f + ping.center_frequency_hz
    beams = np.empty((len(delay_s), samples), np.complex128)
    for beam, of_beam in zip(beams, delay_s):
        phases = np.exp(-2j * np.pi * np.outer(of_beam, total))
        beam[:] = np.fft.ifft((weights[:, None] * phases * compressed).sum(axis=0))[:samples]
    return beams / weights.sum()


def main() -> float:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rig", type=Path, default=RIG)
    parser.add_argument("--ping", type=int, default=1)
    parser.add_argument("--range-m", type=float, default=60.0)
    args = parser.parse_args()
    rig = echotank.Rig(args.rig, {"sonar.ping.range_m": args.range_m})
    ping = next(rig.pings(args.ping, 1))
    own = beams_of(ping)
    difference = np.abs(own - ping.beams).max() / np.abs(ping.beams).max()
    beam, sample = np.unravel_index(np.abs(own).argmax(), own.shape)
    print(f"{ping}: {own.shape[0]} beams of {own.shape[1]} samples")
    print(f"strongest: {np.degrees(ping.beam_angle_rad[beam]):.1f} degrees, {1e3 * ping.time_s[sample]:.2f} ms")
    print(f"largest difference from Echotank's beams: {difference:.1e} of the peak")
    return float(difference)


if __name__ == "__main__":
    raise SystemExit(0 if main() < 1e-6 else "the beams differ")
