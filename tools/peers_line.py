"""A line array of 256: FINUFFT element by element from given delays and amplitudes, against whole pings of this emulator, which include
geometry, sonar equation, Doppler, receiver filter and return to time. Same scatterers, one run; the emulator is timed before and after FINUFFT.

FINUFFT is timed on some elements (setpts, which sorts, and execute), and the total is extrapolated from their mean: every element has the same
number of points, at different delays.
"""

import argparse
import json
import subprocess
import tempfile
import time

from peers_bench import BINS, PERIOD_S, Points, load
import finufft
import numpy as np

ELEMENTS = 256


def ours(bench, scatterers):
    """(threads -> [best ms, worst windowed error, what it says]) of the faster one of our array engines."""
    found = {}
    for method in ("gridded-2d", "gridded-lines"):
        with tempfile.NamedTemporaryFile(suffix=".json") as file:
            only = f"grid {ELEMENTS} {scatterers} "
            command = [bench, "echo", "--only", only, "--method", method, "--threads", "1,2", "--json", file.name]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            for row in json.load(file)["rows"]:
                answer = (row["ms_best"], row["error_worst_window"], f"{method}: {row['says']}")
                found[row["threads"]] = min(found.get(row["threads"], answer), answer)
    return found


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("build")
    arguments.add_argument("bench")
    arguments.add_argument("directories", nargs="+")
    arguments.add_argument("--rounds", type=int, default=8)
    given = arguments.parse_args()
    elements = [Points(directory) for directory in given.directories]
    scatterers = len(elements[0].delay_s)
    before = ours(given.bench, scatterers)
    print(
        f"FINUFFT {finufft.__version__}, {given.build} build: {ELEMENTS} calls, from {len(elements)} elements timed, "
        f"{scatterers} unsorted points each, {BINS} bins, f32, eps 1e-3, {load()}"
    )
    theirs = {}
    for threads in (1, 2):
        plan = finufft.Plan(1, (BINS,), eps=1e-3, isign=-1, dtype="complex64", nthreads=threads)
        best, errors = [], []
        for points in elements:
            phase = 2 * np.pi * points.delay_s / PERIOD_S
            x = np.where(phase >= np.pi, phase - 2 * np.pi, phase).astype("float32")
            c = points.amplitude.astype("complex64")
            took = []
            for _ in range(given.rounds):
                start = time.perf_counter()
                plan.setpts(x)
                got = plan.execute(c)
                took.append((time.perf_counter() - start) * 1e3)
            best.append(min(took))
            errors.append(points.error(got))
        theirs[threads] = ELEMENTS * float(np.mean(best))
        print(f"    {threads} threads: error {max(errors):.1e}, {np.mean(best):8.2f} ms an element, {theirs[threads]:9.0f} ms for all")
    after = ours(given.bench, scatterers)
    for threads in before:
        ms, error, says = min(before[threads], after[threads])
        print(
            f"    ours, {threads} threads: error {error:.1e} in the worst window looked at, {ms:8.1f} ms a ping, "
            f"ratio {theirs[threads] / ms:.1f}; {says}; {load()}"
        )


main()
