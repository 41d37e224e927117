"""Delay-and-sum of the same matched-filtered elements at the same points: PyMUST's `dasmtx`, NumPy, JAX and this emulator, timed in turn.

128 elements, 8000 samples, focused points along beams over 120 degrees (written by `bench beams-dump`). The emulator forms all 256 beams of a
ping, including matched filter and delays; a peer forms some of them without the matched filter. A rate is elements times points over time.
Errors: rms difference from direct delay-and-sum in f64 with a 64-tap sinc, over its rms, at those beams.
Times are processor times of all threads. All run on one thread except JAX, which chooses its own number.

- PyMUST: the matrix is made once and excluded from the rate (its time is printed); timed is matrix times samples.
- NumPy: delays, linear interpolation and carrier of every ping, element by element, complex128 and complex64.
- JAX: the same, compiled for this processor, in f32 with the carrier in turns; delays of the fixed geometry are precomputed in f64 (not timed).
"""

import argparse
import importlib.metadata
import json
import os
import subprocess
import time
import warnings

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
import peers_bench
from peers_bench import Ours, load
import numpy as np


class Data:
    def __init__(self, bench, directory):
        said = subprocess.run([bench, "beams-dump", directory], capture_output=True, text=True, check=True).stdout
        for key, value in json.loads(said).items():
            setattr(self, key, value)
        read = lambda name, kind: np.fromfile(f"{directory}/{name}", dtype=kind)
        self.rows = read("rows.c128", complex).reshape(self.elements, self.samples)
        self.element_x_m = read("element_x_m.f64", float)
        self.points_m = read("point_xz_m.f64", float).reshape(-1, 2)
        self.want = read("want.c128", complex)
        # The first samples lie on the array itself, the last beyond the record.
        sample = np.arange(len(self.want)) % self.samples
        self.counts = (sample >= self.first_probe) & (sample < self.samples - 100)

    def delay_s(self, element):
        x, z = self.points_m[:, 0], self.points_m[:, 1]
        out = np.hypot(x - self.element_x_m[self.transmitting], z)
        return (out + np.hypot(x - self.element_x_m[element], z)) / self.sound_speed_m_per_s

    def error(self, got):
        """`got` contains the phase of the whole delay, as in all programs but ours."""
        time_s = np.tile(np.arange(self.samples) / self.rate_hz, self.peer_beams)
        got = got * np.exp(-2j * np.pi * self.carrier_hz * time_s)
        off = np.linalg.norm((got - self.want)[self.counts])
        return off / np.linalg.norm(self.want[self.counts])

    def terms(self):
        return len(self.want) * self.elements


def best(runs, work):
    """In processor time: wall time is unreliable on a shared machine."""
    return peers_bench.best(runs, work, time.process_time)


def say(name, data, terms, seconds, error, note=""):
    print(f"    {name:28} error {error:.1e}; {seconds * 1e3:9.1f} ms, {terms / seconds * 1e-9:7.3f} G points/s{note}", flush=True)
    return terms / seconds


def pymust(data, method, runs):
    import pymust as must

    param = must.utils.Param()
    param.fc, param.fs, param.c = data.carrier_hz, data.rate_hz, data.sound_speed_m_per_s
    param.pitch = data.element_x_m[1] - data.element_x_m[0]
    param.Nelements, param.bandwidth, param.radius, param.fnumber, param.t0 = data.elements, 75, np.inf, 0, np.zeros((1, 1))
    param.width = param.pitch
    delays = np.full((1, data.elements), np.nan)
    delays[0, data.transmitting] = 0.0
    seconds, got, made = 0.0, [], 0.0
    samples = data.rows.T.flatten(order="F")
    # One beam's matrix at a time: all together exceed memory.
    for points in np.split(data.points_m, data.peer_beams):
        start = time.perf_counter()
        size = 1j * np.array([data.samples, data.elements])
        x, z = (np.ascontiguousarray(points[:, i]).reshape(-1, 1) for i in (0, 1))
        matrix = must.dasmtx(size, x, z, delays, param, method).tocsr()
        made += time.perf_counter() - start
        took, beam = best(runs, lambda: matrix @ samples)
        seconds += took
        got.append(beam / data.elements)
    error = data.error(np.concatenate(got))
    return say(f"PyMUST dasmtx, {method}", data, data.terms(), seconds, error, f" (its matrices: {made:.1f} s)")


def numpy_sum(data, kind, runs):
    rows = data.rows.astype(kind)

    def form():
        total = np.zeros(len(data.want), kind)
        for element in range(data.elements):
            delay_s = data.delay_s(element)
            place = delay_s * data.rate_hz
            whole = np.clip(place.astype(np.int32), 0, data.samples - 2)
            share = (place - whole).astype(rows.real.dtype)
            row = rows[element]
            value = row[whole] * (1 - share) + row[whole + 1] * share
            cycles = data.carrier_hz * delay_s
            total += value * np.exp(2j * np.pi * (cycles - np.round(cycles))).astype(kind)
        return total / data.elements

    seconds, got = best(runs, form)
    name = f"NumPy {np.__version__}, {np.dtype(kind).name}"
    return say(name, data, data.terms(), seconds, data.error(got))


def jax_sum(data, runs):
    import jax
    import jax.numpy as jnp

    delays = np.stack([data.delay_s(e) for e in range(data.elements)])
    place = delays * data.rate_hz
    whole = np.clip(place.astype(np.int32), 0, data.samples - 2)
    cycles = data.carrier_hz * delays
    given = [
        jnp.asarray(data.rows.astype(np.complex64)),
        jnp.asarray(whole),
        jnp.asarray((place - whole).astype(np.float32)),
        jnp.asarray(np.exp(2j * np.pi * (cycles - np.round(cycles))).astype(np.complex64)),
    ]

    @jax.jit
    def form(rows, whole, share, turn):
        def one(total, of):
            row, whole, share, turn = of
            value = row[whole] * (1 - share) + row[whole + 1] * share
            return total + value * turn, None

        total, _ = jax.lax.scan(one, jnp.zeros(whole.shape[1], jnp.complex64), (rows, whole, share, turn))
        return total / rows.shape[0]

    form(*given).block_until_ready()
    seconds, got = best(runs, lambda: form(*given).block_until_ready())
    name = f"JAX {importlib.metadata.version('jax')}, complex64"
    return say(name, data, data.terms(), seconds, data.error(np.asarray(got, complex)))


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("bench")
    arguments.add_argument("directory")
    arguments.add_argument("--quick", action="store_true")
    given = arguments.parse_args()
    warnings.simplefilter("ignore")
    data = Data(given.bench, given.directory)
    points = data.beams * data.samples
    print(f"beams: {data.elements} elements, {data.samples} samples, {data.beams} beams (peers {data.peer_beams}), {load()}")
    runs = 2 if given.quick else 4
    rates = []
    for name, work in (
        ("PyMUST", lambda: pymust(data, "linear", runs)),
        ("PyMUST", lambda: pymust(data, "lanczos5", runs)),
        ("NumPy", lambda: numpy_sum(data, complex, 1 if given.quick else 2)),
        ("NumPy", lambda: numpy_sum(data, np.complex64, 1 if given.quick else 2)),
        ("JAX", lambda: jax_sum(data, runs)),
    ):
        try:
            rates.append(work())
        except Exception as problem:
            print(f"    {name} does not run here: {type(problem).__name__}: {problem}")
    ours = Ours(given.bench, "beams-serve")
    for former in ("dynamic-focus", "fft"):
        took = [ours.run(former) for _ in range(runs + 2)]
        seconds, error = min(t[1] for t in took) * 1e-3, took[0][2]
        rate = say(f"ours, {former}", data, points * data.elements, seconds, error, " (matched filter and steering included)")
        if rates:
            print(f"        {rate / max(rates):.1f} times the fastest of them")
    ours.process.stdin.close()
    ours.process.wait()


main()
