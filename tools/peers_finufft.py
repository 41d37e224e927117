"""FINUFFT and the transform of gridded-1d on the same unsorted points, one thread each, timed in turn: best of N, and the ratio.

Timed for FINUFFT: setpts (which sorts) and execute; for this emulator: execute. Plans and conversions are made before.
"""

import argparse
import time

from peers_bench import BINS, PERIOD_S, Ours, Points, keep, load
import finufft
import numpy as np

# Settings compared at about equal error: ours, and FINUFFT's type, eps and oversampling (f64 below 4e-4, where its f32 error stalls).
PAIRS = [
    ("5e-4", ["f32 6 1.25 best", "f32 4 2.0 best"], [("complex64", 1e-3, 2.0)]),
    ("5e-7", ["f32 7 2.0 best", "f32 9 1.5 best"], [("complex128", 1e-6, 2.0), ("complex128", 1e-6, 1.25), ("complex64", 1e-6, 2.0)]),
    ("1e-12", ["f64 13 2.0 best", "f64 16 1.5 best"], [("complex128", 1e-12, 2.0)]),
]


class Theirs:
    def __init__(self, points, dtype, eps, oversampling):
        real = "float32" if dtype == "complex64" else "float64"
        phase = 2 * np.pi * points.delay_s / PERIOD_S
        self.x = np.where(phase >= np.pi, phase - 2 * np.pi, phase).astype(real)
        self.c = points.amplitude.astype(dtype)
        self.plan = finufft.Plan(1, (BINS,), eps=eps, isign=-1, dtype=dtype, upsampfac=oversampling, nthreads=1)
        self.points = points

    def run(self):
        start = time.perf_counter()
        self.plan.setpts(self.x)
        got = self.plan.execute(self.c)
        return (time.perf_counter() - start) * 1e3, got


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("build")
    arguments.add_argument("bench")
    arguments.add_argument("directory")
    arguments.add_argument("--rounds", type=int, default=20)
    given = arguments.parse_args()
    points = Points(given.directory)
    ours = Ours(given.bench, "transform-serve", given.directory)
    print(f"FINUFFT {finufft.__version__}, {given.build} build; {len(points.delay_s)} unsorted points, {BINS} bins, one thread, {load()}")
    for goal, requests, settings in PAIRS:
        theirs = [(f"finufft {d} eps {e:.0e} upsampling {u}", Theirs(points, d, e, u)) for d, e, u in settings]
        ms = {}
        error = {}
        for _ in range(given.rounds):
            for request in requests:
                took, error[request] = ours.run(request)
                ms[request] = min(took, ms.get(request, np.inf))
            for name, peer in theirs:
                took, got = peer.run()
                if name not in error:
                    error[name] = points.error(got)
                ms[name] = min(took, ms.get(name, np.inf))
        print(f"  at {goal}:")
        for name in ms:
            print(f"    {name:44} error {error[name]:.1e}  {ms[name]:8.2f} ms")
        # The fastest setting of each whose error is within a third of the other's.
        our_best = min(requests, key=ms.get)
        their_best = min((name for name, _ in theirs if error[name] < 1.34 * float(goal)), key=ms.get)
        keep(f"FINUFFT {finufft.__version__} {given.build} at {goal}", len(points.delay_s), 1, ms[their_best], error[their_best])
        print(f"    ratio {ms[their_best] / ms[our_best]:.2f} ({our_best} against {their_best}; {load()})")
    ours.close()


main()
