"""Access to the bench's points and transforms, shared by the peer scripts."""

import json
import os
import subprocess

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
    """`bench transform-serve` in a separate process; `run` returns (milliseconds, error) of one transform."""

    def __init__(self, bench, directory):
        self.process = subprocess.Popen(
            [bench, "transform-serve", directory], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def run(self, request):
        self.process.stdin.write(request + "\n")
        self.process.stdin.flush()
        milliseconds, error = self.process.stdout.readline().split()
        return float(milliseconds), float(error)

    def close(self):
        self.process.stdin.close()
        self.process.wait()


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
