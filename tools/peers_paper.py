"""The paper's Eq. 18 (Meng et al., Sensors 2023, 23, 3083) in NumPy, written from the equation, on a scene of its size: one element,
all scatterers, frequency by frequency; then this emulator's transform on the same points.
"""

import sys
import time

from peers_bench import BINS, PERIOD_S, Ours, Points, keep, load
import numpy as np

CARRIER_HZ = 400e3


def eq18(delay_s, amplitude):
    """X(f) = sum_m A_m exp(-j 2pi f tau_m), f = f_c + k / period; a new array of phasors at every frequency."""
    out = np.empty(BINS, complex)
    for q in range(BINS):
        f_hz = CARRIER_HZ + (q - BINS // 2) / PERIOD_S
        out[q] = np.sum(amplitude * np.exp(-2j * np.pi * f_hz * delay_s))
    return out


def main():
    points = Points(sys.argv[2])
    # Eq. 18 has the carrier inside its exponential.
    turns = CARRIER_HZ * points.delay_s
    bare = points.amplitude * np.exp(2j * np.pi * (turns - np.round(turns)))
    start = time.perf_counter()
    got = eq18(points.delay_s, bare)
    paper_ms = (time.perf_counter() - start) * 1e3
    print(f"the paper's Eq. 18, {len(points.delay_s)} scatterers, {BINS} frequencies, one element, one thread, {load()}")
    print(f"    NumPy {np.__version__:37} error {points.error(got):.1e}  {paper_ms:8.2f} ms")
    keep("Eq. 18 in NumPy", len(points.delay_s), 1, paper_ms, points.error(got))
    ours = Ours(sys.argv[1], "transform-serve", sys.argv[2])
    for request in ["f32 6 1.25 best", "f32 7 2.0 best", "f64 13 2.0 best"]:
        runs = [ours.run(request) for _ in range(20)]
        ms = min(run[0] for run in runs)
        print(f"    {request:43} error {runs[0][1]:.1e}  {ms:8.2f} ms  ratio {paper_ms / ms:.0f}")
    ours.close()


main()
