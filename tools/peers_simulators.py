"""PyMUST, FastSIMUS (Garcia 2022: sums over every scatterer, element and frequency) and this emulator on one small scene of point scatterers.

Each computes its own model. SIMUS: two-dimensional spreading, element directivity, its own transducer response, no motion. Compared are
therefore the speed of sums of scatterers over elements and frequencies, and the accuracy of each against its own formula: SIMUS spectra
against the formula with every exponential evaluated in f64; the emulator, with the delays of the same scatterers at one element, against its
direct sum. One thread each. Scene: 64 elements half a wavelength apart, 400 kHz, one of them transmitting; scatterers 0.2 to 1 m away.
"""

import argparse
import importlib.metadata
import os
import warnings

from peers_bench import BINS, PERIOD_S, Ours, best, keep, load
import numpy as np

SOUND_SPEED_M_PER_S = 1500.0
CARRIER_HZ = 400e3
ELEMENTS = 64
PITCH_M = SOUND_SPEED_M_PER_S / CARRIER_HZ / 2
WIDTH_M = 0.9 * PITCH_M
TRANSMITTER = ELEMENTS // 2
# Frequencies this far below the strongest are omitted.
THRESHOLD_DB = -60


class Scene:
    def __init__(self, scatterers):
        draw = np.random.default_rng(1)
        range_m = draw.uniform(0.2, 1.0, scatterers)
        angle = draw.uniform(-0.5, 0.5, scatterers)
        self.x_m, self.z_m = range_m * np.sin(angle), range_m * np.cos(angle)
        self.strength = draw.uniform(0.5, 1.5, scatterers)
        self.delay_s = np.full(ELEMENTS, np.nan)
        self.delay_s[TRANSMITTER] = 0.0
        place_m = (np.arange(ELEMENTS) - (ELEMENTS - 1) / 2) * PITCH_M
        across_m = self.x_m[:, None] - place_m
        self.distance_m = np.hypot(across_m, self.z_m[:, None])
        wavenumber = 2 * np.pi * CARRIER_HZ / SOUND_SPEED_M_PER_S
        directivity = np.sinc(wavenumber * WIDTH_M / 2 * across_m / self.distance_m / np.pi)
        self.leg = directivity / np.sqrt(self.distance_m)

    def spectrum(self, frequency_hz, gain):
        """SIMUS's formula with every exponential evaluated: frequencies x elements."""
        out = np.empty((len(frequency_hz), ELEMENTS), complex)
        for row, (f, g) in enumerate(zip(frequency_hz, gain)):
            legs = self.leg * np.exp(2j * np.pi * f / SOUND_SPEED_M_PER_S * self.distance_m)
            out[row] = g * ((self.strength * legs[:, TRANSMITTER]) @ legs)
        return out


def say(name, scene, frequencies, seconds, error, of_what):
    terms = len(scene.strength) * ELEMENTS * frequencies
    print(f"    {name:26} error {error:.1e} {of_what}; {seconds * 1e3:9.1f} ms, {frequencies} frequencies, {terms / seconds * 1e-9:8.3f} G terms/s")


def fast_simus(scene):
    import fast_simus as fs

    sonar = fs.TransducerParams(freq_center=CARRIER_HZ, pitch=PITCH_M, n_elements=ELEMENTS, width=WIDTH_M, baffle="rigid")
    water = fs.MediumParams(speed_of_sound=SOUND_SPEED_M_PER_S)
    points = np.stack([scene.x_m, scene.z_m], -1)
    given = (points, scene.strength, scene.delay_s)
    plan = fs.simus_precompute(*given, sonar, water, db_thresh=THRESHOLD_DB)
    seconds, result = best(3, lambda: fs.simus_compute(*given, plan, sonar, water))
    got = result.spectrum[plan.freq_idx_start : plan.freq_idx_start + len(plan.selected_freqs)]
    frequency_hz = np.asarray(plan.selected_freqs)
    gain = np.asarray(plan.pulse_spectrum * plan.probe_spectrum**2) * plan.correction_factor
    some = np.linspace(0, len(frequency_hz) - 1, 48).astype(int)
    want = scene.spectrum(frequency_hz[some], gain[some])
    error = np.linalg.norm(got[some] - want) / np.linalg.norm(want)
    name = f"FastSIMUS {importlib.metadata.version('fastsimus')}, NumPy"
    say(name, scene, len(frequency_hz), seconds, error, "against its formula")
    keep(name, len(scene.strength), ELEMENTS, seconds * 1e3, error)
    return frequency_hz, some, want, plan.freq_idx_start


def pymust(scene, frequency_hz, some, want, first):
    import pymust as must

    param = must.utils.Param()
    param.fc, param.pitch, param.width, param.c = CARRIER_HZ, PITCH_M, WIDTH_M, SOUND_SPEED_M_PER_S
    param.Nelements, param.bandwidth, param.baffle, param.radius, param.height = ELEMENTS, 75, "rigid", np.inf, np.inf
    column = lambda values: values.reshape(-1, 1)

    def run():
        options = must.utils.Options()
        options.dBThresh = THRESHOLD_DB
        fields = (column(scene.x_m), column(scene.z_m), column(scene.strength), scene.delay_s.reshape(1, -1).copy())
        return must.simus(*fields, param, options)

    seconds, (_, spectrum) = best(2, run)
    got = spectrum[first : first + len(frequency_hz)][some]
    # Its constant factors and frequency rounding differ: the best-fitting complex factor is removed.
    factor = np.vdot(got, want) / np.vdot(got, got)
    error = np.linalg.norm(factor * got - want) / np.linalg.norm(want)
    name = f"PyMUST {importlib.metadata.version('pymust')}"
    say(name, scene, len(frequency_hz), seconds, error, "against the same, a factor apart")
    keep(name, len(scene.strength), ELEMENTS, seconds * 1e3, error)


def ours(scene, bench, directory):
    """One element of the scene at a time, in the carrier's band of 30 kHz; times the elements."""
    os.makedirs(directory, exist_ok=True)
    element = 3
    delay_s = (scene.distance_m[:, TRANSMITTER] + scene.distance_m[:, element]) / SOUND_SPEED_M_PER_S
    strength = scene.strength * scene.leg[:, TRANSMITTER] * scene.leg[:, element]
    amplitude = strength * np.exp(-2j * np.pi * CARRIER_HZ * delay_s)
    bins = np.arange(BINS) - BINS // 2
    direct = np.exp(-2j * np.pi * np.outer(bins, delay_s / PERIOD_S)) @ amplitude
    for name, values in (("delay_s.f64", delay_s), ("amplitude.c128", amplitude), ("direct.c128", direct)):
        np.ascontiguousarray(values).tofile(f"{directory}/{name}")
    server = Ours(bench, "transform-serve", directory)
    for request in ("f32 6 1.25 best", "f64 13 2.0 best"):
        runs = [server.run(request) for _ in range(20)]
        seconds = min(run[0] for run in runs) * 1e-3 * ELEMENTS
        say(f"ours, {request[:5].strip()}", scene, BINS, seconds, runs[0][1], "against its direct sum")
    server.close()


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("bench")
    arguments.add_argument("directory")
    arguments.add_argument("--scatterers", type=int, default=500)
    given = arguments.parse_args()
    warnings.simplefilter("ignore")
    scene = Scene(given.scatterers)
    print(f"simulators: {given.scatterers} scatterers, {ELEMENTS} elements, one thread, {load()}")
    found = None
    try:
        found = fast_simus(scene)
    except Exception as problem:
        print(f"    FastSIMUS does not run here: {type(problem).__name__}: {problem}")
    try:
        if found:
            pymust(scene, *found)
    except Exception as problem:
        print(f"    PyMUST does not run here: {type(problem).__name__}: {problem}")
    ours(scene, given.bench, given.directory)


main()
