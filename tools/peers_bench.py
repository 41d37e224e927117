"""Access to the bench's points and transforms, shared by the peer scripts."""

import json
import os
import subprocess
import time

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np

BINS = 6144
PERIOD_S = 0.2048


class Points:
    """Delays in s, amplitudes with their carrier phase, and the direct sum over the bins, all f64."""

    def __init__(self, directory):
        self.delay_s = np.fromfile(f"{directory}/delay_s.f64")
        self.amplitude = np.fromfile(f"{directory}/amplitude.c128", dtype=complex)
        self.direct = np.fromfile(f"{directory}/direct.c128", dtype=complex)

    def error(self, got):
        return float(np.linalg.norm(got - self.direct) / np.linalg.norm(self.direct))


class Ours:
    """`bench transform-serve DIRECTORY` or `bench beams-serve` in a separate process; `run` returns the numbers of one answer."""

    def __init__(self, bench, *command):
        self.process = subprocess.Popen([bench, *command], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def run(self, request):
        self.process.stdin.write(request + "\n")
        self.process.stdin.flush()
        return tuple(map(float, self.process.stdout.readline().split()))

    def close(self):
        self.process.stdin.close()
        self.process.wait()


def best(runs, work, clock=time.perf_counter):
    """Minimum time of several runs in seconds, and the last result."""
    took = []
    for _ in range(runs):
        start = clock()
        result = work()
        took.append(clock() - start)
    return min(took), result


def load():
    return f"load {os.getloadavg()[0]:.2f}"


POINTS = "out/peers/points.json"


def keep(name, scatterers, elements, milliseconds, error, threads=1):
    """Stores one program's result for `echotank chart`; replaces an older point of that name."""
    points = []
    if os.path.exists(POINTS):
        with open(POINTS) as file:
            points = [point for point in json.load(file) if point["name"] != name]
    points.append({
        "name": name,
        "scatterers": int(scatterers),
        "elements": int(elements),
        "milliseconds": float(milliseconds),
        "error": float(error),
        "threads": threads,
        "load": os.getloadavg()[0],
    })
    os.makedirs(os.path.dirname(POINTS), exist_ok=True)
    with open(POINTS, "w") as file:
        json.dump(points, file, indent=1)
