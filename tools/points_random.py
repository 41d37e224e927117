#!/usr/bin/env python3
"""Draws small random rigs of explicit points and compares what `echotank replay` promises with what an independent calculation measures.

    points_random.py --rigs 200 --seed 1 --echotank target/release/echotank --keep FOLDER [--engine auto] [--only 17] [--jobs 8] [--json FILE]
    points_random.py --rig RIG.toml [--set KEY=VALUE ...] [--limit 1e-2] --echotank target/release/echotank

For every rig: the engine, what was asked (the tolerance), promised (`methods.predicted_error` of truth.jsonl; with fixed methods, that of
`check --json`) and measured (points_model.window_error), and whether the answer was marked: the promise exceeds what was asked, or
the replay reports echoes outside the engine's design limits, a fault, or an error. An unmarked answer is wrong if it exceeds what was asked.
Of each array the first, the middle and the last element are compared, and those with the weakest windows, where errors are largest.

The rigs: a few to some thousands of points near (0.7 m) and far, platforms that are straight, roll, turn, dive or accelerate at up to 12 m/s,
pulses of 0.2 to 10 ms, with and without filter and taper, patterns or none, tolerances from 1e-1 to 1e-5. A seed gives the same rigs always.

Shares of answers within five times are stated of all, and without those below 1e-9: there the samples agree to rounding, and a prediction bounds
rounding that neither calculation resolves.

Exit code 0: no broken promise; with --limit, no error above it. 1: some, or a refusal with --limit. Needs Python >= 3.11 (or 3.9 with tomli),
NumPy, points_check.py and points_model.py beside this file, and the program; nothing else.
"""

import argparse
import concurrent.futures
import json
import math
import os
import pathlib
import subprocess
import sys
import tempfile
import time

import numpy as np

import points_check
import points_model

UTC_S = 1750000000
TRACK_HZ, TRACK_S = 50, 3
PING_HZ = 5.0
# Pings that are compared, counted from 1: the first, and one for which methods were chosen with experience.
PINGS = (1, 6)
# Elements of each array that are compared: evenly along it, and those with the weakest windows.
ELEMENTS, WEAKEST = 3, 2
ENGINES = ("auto", "reference", "direct", "gridded-1d", "gridded-lines", "gridded-2d")
# A promise is compared with measurements that are sure to this.
SURE = 1e-9
# A promise of so many times the measured error is near it.
NEAR = 5
# Largest promises that are listed.
LISTED = 40


def log_uniform(rng, low, high):
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


# ---------------------------------------------------------------------------------------------------------------------
# Drawing

def draw_track(rng):
    """Rows of a track, and its name. Position is the integral of speed along heading and pitch."""
    kind = str(rng.choice(["still", "straight", "roll", "turn", "dive", "accelerate", "everything"]))
    speed = 0.0 if kind == "still" else float(rng.choice([rng.uniform(0.5, 3), rng.uniform(3, 10), rng.uniform(10, 12)]))

    def has(name):
        return kind in (name, "everything")

    roll, roll_s = (rng.uniform(2, 15) if has("roll") else 0.0), rng.uniform(2, 6)
    turn = rng.uniform(-25, 25) if has("turn") else 0.0
    dive = rng.uniform(-20, 20) if has("dive") else 0.0
    acceleration = rng.uniform(-3, 3) if has("accelerate") else 0.0
    heading, phase = rng.uniform(0, 360), rng.uniform(0, 2 * np.pi)
    fine = np.linspace(0, TRACK_S, TRACK_S * 1000 + 1)
    headings, pitches = heading + turn * fine, dive * np.sin(2 * np.pi * fine / 5 + phase)
    speeds = np.clip(speed + acceleration * fine, 0, 12)
    along = np.stack([np.cos(np.radians(pitches)) * np.cos(np.radians(headings)),
                      np.cos(np.radians(pitches)) * np.sin(np.radians(headings)), -np.sin(np.radians(pitches))], axis=1) * speeds[:, None]
    places = np.concatenate([np.zeros((1, 3)), np.cumsum((along[1:] + along[:-1]) / 2 * (fine[1] - fine[0]), axis=0)])
    rolls = roll * np.sin(2 * np.pi * fine / roll_s + phase)
    rows = []
    for k in range(0, len(fine), 1000 // TRACK_HZ):
        north, east, down = places[k]
        rows.append("%d.%03d,%.9f,%.9f,%.9f,%.9f,%.9f,%.9f" % (
            UTC_S + k // 1000, k % 1000, north, east, 20 + down, rolls[k], pitches[k], headings[k] % 360))
    return "%s %.1f m/s" % (kind, speed), rows, places + [0, 0, 20]


def draw_points(rng, range_m, places, most):
    """Rows of at most `most` points, and a name."""
    kind = str(rng.choice(["sparse", "bottom", "cloud", "near"]))
    count = {"sparse": int(rng.integers(2, 30)), "near": int(rng.integers(1, 60))}.get(kind, int(log_uniform(rng, 100, 2500)))
    count = min(count, most)
    middle = places[len(places) // 6]
    if kind == "bottom":
        depth = rng.uniform(0.1, 0.5) * range_m
        across = math.sqrt(range_m ** 2 - depth ** 2)
        offsets = np.column_stack([rng.uniform(-across, across, (count, 2)), np.full(count, depth)])
    else:
        rays = rng.normal(size=(count, 3))
        offsets = rays / np.linalg.norm(rays, axis=1)[:, None] * (range_m * rng.uniform(0.05, 1, count) ** 0.5)[:, None]
    where = middle + offsets
    if kind == "near":
        heads = [places[int((p - 1) * 1000 / PING_HZ)] for p in PINGS]
        rays = rng.normal(size=(len(heads), 3))
        near = rays / np.linalg.norm(rays, axis=1)[:, None] * 0.7
        where = np.concatenate([where, heads + near])
    ranges = np.linalg.norm(where - middle, axis=1)
    strengths = rng.lognormal(0, rng.uniform(0, 1.5), len(where))
    if rng.random() < 0.5:
        strengths = strengths * ranges ** 2 / range_m ** 2
    phases = rng.uniform(0, 2 * np.pi, len(where))
    rows = ["%.6f,%.6f,%.6f,%.9g,%.9g" % (*place, a * np.cos(p), a * np.sin(p)) for place, a, p in zip(where, strengths, phases)]
    return "%s of %d" % (kind, len(where)), rows


def draw_pattern(rng, wavelength, spacing, side, directive):
    """Keys of one array's pattern: length and width in wavelengths, an element no longer than its spacing."""
    name = side + "pattern"
    if not directive:
        return ['%s = "omnidirectional"' % name]
    length = min(log_uniform(rng, 0.5, 20) * wavelength, spacing or math.inf)
    return ['%s = "rectangle"' % name, "%slength_m = %.6f" % (side, length), "%swidth_m = %.6f" % (side, rng.uniform(0.3, 2) * wavelength),
            "baffled = %s" % str(bool(rng.random() < 0.5)).lower()]


def bend(rng, text):
    """The text of a line array, or that of an arc of up to half a circle."""
    table = dict(line.split(" = ") for line in text.splitlines() if " = " in line)
    elements = int(table["elements"])
    if elements < 3:
        return text
    along_m = (elements - 1) * float(table["spacing_m"])
    radius_m = along_m / rng.uniform(0.2, 3.1)
    return text.replace("baffled = true", "baffled = false") + "\nradius_m = %.6f" % radius_m


def draw_rig(rng, folder, engine, arcs=False):
    """Writes rig.toml, points.csv and track.csv; returns a description."""
    c, carrier = round(rng.uniform(1450, 1530), 1), round(log_uniform(rng, 30, 450), 2)
    wavelength = c / carrier / 1e3
    duration = round(float(rng.choice([log_uniform(rng, 0.2, 2), rng.uniform(2, 5), 10.0])), 3)
    chirp = bool(rng.random() < 0.7)
    bandwidth = round(rng.uniform(4, 30), 2) if chirp else 0.0
    taper = float(rng.choice([0.0, 0.05, 0.1, 0.5, 1.0]))
    fir = engine.startswith("gridded") or bool(rng.random() < 0.75)
    doppler = 2 * 10.0 / c * carrier
    rate = round(1.25 * (max(bandwidth, 4 / duration) + 2 * doppler) * rng.uniform(1.02, 2.0), 3)
    range_m = round(log_uniform(rng, 4, 100), 2)
    tolerance = float("%.1e" % log_uniform(rng, 1e-5, 1e-1))
    lines = engine in ("gridded-lines", "gridded-2d") or bool(rng.random() < 0.7)
    directive = bool(rng.random() < 0.3)
    arrays, moved = [], [round(float(x), 3) for x in rng.uniform(-2, 2, 3)]
    for a in range(int(rng.integers(1, 3))):
        elements = int(rng.integers(2, 5 if engine == "reference" else 33)) if lines else 1
        spacing = round(rng.uniform(0.4, 0.6) * wavelength, 6)
        at = [round(x + float(d), 3) for x, d in zip(moved, rng.uniform(-0.3, 0.3, 3))]
        arrays.append("\n".join([
            "[[sonar.receive]]", 'name = "a%d"' % a, 'transmit = "tx"', "elements = %d" % elements,
            *(["spacing_m = %.6f" % spacing] if lines else []), "position_m = %s" % at, "sensitivity_db = 0.0",
            "roll_deg = %.1f" % rng.choice([0, 60, -60]), "yaw_deg = %.1f" % rng.choice([0, 90]),
            *draw_pattern(rng, wavelength, spacing if lines else None, "element_", directive)]))
    if arcs:
        arrays = [bend(rng, text) for text in arrays]
    transmit = draw_pattern(rng, wavelength, None, "", directive)
    motion, track, places = draw_track(rng)
    # The reference takes a microsecond for each dense point of each echo at each element.
    scene, points = draw_points(rng, range_m, places, 20 if engine == "reference" else 10**6)
    text = f"""# Drawn by tools/points_random.py.
[medium]
sound_speed_m_per_s = {c}
absorption = "none"
[nav]
origin = {{ latitude_deg = 54.4, longitude_deg = 10.3 }}
mode = "settle"
vertical = "depth"
reference_depth_m = 20.0
[[nav.source]]
name = "track"
kind = "csv"
path = "track.csv"
provides = ["position", "heading", "roll-pitch"]
[scene]
points = "points.csv"
[run]
latency_ms = 600.0
[[sonar]]
name = "random"
[sonar.pulse]
kind = "{'lfm' if chirp else 'cw'}"
center_frequency_khz = {carrier}
{f'bandwidth_khz = {bandwidth}' if chirp else ''}
duration_ms = {duration}
taper = {taper}
[[sonar.transmit]]
name = "tx"
position_m = {moved}
{chr(10).join(transmit)}
{chr(10).join(arrays)}
[sonar.receiver]
sample_rate_khz = {rate}
rx_filter = "{'fir' if fir else 'none'}"
noise_db = "none"
full_scale_v = 1000.0
[sonar.ping]
range_m = {range_m}
rate_hz = {PING_HZ}
source_level_db = 0.0
gain_db = 0.0
[sonar.model]
tolerance = {tolerance}
path = "auto"
doppler = "auto"
synthesis = "{engine}"
error_check = false
"""
    (folder / "rig.toml").write_text(text)
    (folder / "track.csv").write_text("time_s,north_m,east_m,down_m,roll_deg,pitch_deg,heading_deg\n" + "\n".join(track) + "\n")
    (folder / "points.csv").write_text("north_m,east_m,down_m,amplitude,amplitude_imag\n" + "\n".join(points) + "\n")
    pulse = "%s %.2f ms taper %.2f %s" % ("lfm" if chirp else "cw", duration, taper, "fir" if fir else "no filter")
    return "%s, %s, %s, %.0f kHz, %.1f m, %d array(s)%s" % (
        scene, motion, pulse, carrier, range_m, len(arrays), " with patterns" if directive else "")


# ---------------------------------------------------------------------------------------------------------------------
# Replay and comparison

def replay(echotank, rig, out, changes, pings):
    command = [str(echotank), "replay", str(rig), "--out", str(out), "--formats", "npz", "--f64", "--quiet",
               "--pings", "%d..%d" % (pings[0], pings[-1])]
    for change in changes:
        command += ["--set", change]
    return subprocess.run(command, capture_output=True, text=True, timeout=600)


def promise_of_check(echotank, rig, changes):
    """Predicted error of fixed methods, from `check --json`; none if check does not say it."""
    command = [str(echotank), "check", str(rig), "--json"]
    for change in changes:
        command += ["--set", change]
    made = subprocess.run(command, capture_output=True, text=True, timeout=600)
    try:
        return json.loads(made.stdout)["sonars"][0]["chosen"]["error"]
    except (ValueError, KeyError, IndexError, TypeError):
        return None


def faded(iq, window, floor_db=55.0):
    """How far the windows of each element fade below the mean of all elements there, at most, of windows above the noise floor."""
    running = np.concatenate([np.zeros((len(iq), 1)), np.cumsum(np.abs(iq) ** 2, axis=1)], axis=1)
    levels = running[:, window:] - running[:, :-window]
    if levels.size == 0:
        return np.zeros(len(iq))
    mean, floor = levels.mean(axis=0), levels.max(axis=1, keepdims=True) * 10 ** (-floor_db / 10)
    return (mean / np.maximum(np.maximum(levels, floor), 1e-300)).max(axis=1)


def some_elements(owner, iq, window):
    """First, middle and last element of each array, and those whose windows fade the most."""
    owner, chosen = np.asarray(owner), []
    for array in np.unique(owner):
        mine = np.flatnonzero(owner == array)
        evenly = {int(mine[k]) for k in np.linspace(0, len(mine) - 1, min(ELEMENTS, len(mine))).round().astype(int)}
        others = [int(e) for e in mine[np.argsort(-faded(iq[mine], window))] if int(e) not in evenly]
        chosen += sorted(evenly | set(others[:WEAKEST]))
    return chosen


def marks_of(stdout):
    """What the replay's own report says against its samples."""
    return [mark for mark in ("design limits", "FAULT", "OVERLOAD", "skipped (navigation)") if
            mark in stdout and not (mark.startswith("skipped") and ", 0 skipped" in stdout)]


def compare(echotank, rig_path, changes=(), pings=PINGS, out=None):
    """One row for each compared ping: engine, asked, promised, measured, marked."""
    with tempfile.TemporaryDirectory() as folder:
        done = replay(echotank, rig_path, out or folder, changes, pings)
        if done.returncode != 0:
            return [{"refused": (done.stderr or done.stdout).strip().splitlines()[-1:]}]
        marks = marks_of(done.stdout + done.stderr)
        folder = pathlib.Path(out or folder)
        truth = [json.loads(line) for line in (folder / "truth.jsonl").read_text().splitlines()]
        truth = {row["ping_number"]: row for row in truth if "ping_number" in row}
        rig = points_check.load_rig(rig_path, changes=changes)
        with np.load(folder / "pings.npz") as data:
            numbers, iq = data["ping_number"].tolist(), data["iq_by_element"]
            fs, first, utc = float(data["sample_rate_hz"]), float(data["first_sample_s"]), data["ping_utc_ns"]
            owner = points_check.array_indices(rig, data["element_array"])
        starts = {a: owner.index(a) for a in set(owner)}
        window = points_check.window_samples(rig, fs)
        rows = []
        for number in pings:
            if number not in numbers:
                continue
            p, count = numbers.index(number), iq.shape[2]
            compared = some_elements(owner, iq[p], window)
            echoes = points_check.moving_ping(rig, int(utc[p]), first + count / fs)[3]
            wanted = np.array([echoes(owner[e], e - starts[owner[e]], fs, first, count).exact for e in compared])
            error, row, offset = points_model.window_error(iq[p, compared], wanted, window)
            model, methods = truth[number]["plan"]["model"], truth[number].get("methods") or {}
            promised = methods.get("predicted_error")
            if promised is None:
                promised = promise_of_check(echotank, rig_path, changes)
            rows.append({"ping": number, "engine": model["synthesis"], "path": model["path"], "doppler": model["doppler"],
                         "segment_s": model["segment_s"], "cull_db": model["cull_db"], "promised": promised, "measured": error,
                         "element": compared[row], "sample": offset, "marks": list(marks)})
        return rows


def asked_of(rig_path, changes=()):
    """The tolerance of a configuration; the program's default is 1e-3."""
    for change in reversed(changes):
        if change.startswith("sonar.model.tolerance="):
            return float(change.split("=")[1])
    for line in pathlib.Path(rig_path).read_text().splitlines():
        if line.split("=")[0].strip() == "tolerance":
            return float(line.split("=")[1].split("#")[0])
    return 1e-3


def judge(row, asked):
    """Completes a row: asked, marked, and what is broken: the promise, the tolerance without a mark, or nothing."""
    row["asked"] = asked
    promised = row["promised"]
    row["marked"] = bool(row["marks"]) or (promised is not None and promised > asked)
    broken = []
    if promised is not None and row["measured"] > promised + SURE:
        broken.append("promise")
    if row["measured"] > asked + SURE and not row["marked"]:
        broken.append("silent")
    row["broken"] = broken
    return row


def ratio_of(row):
    return row["promised"] / row["measured"] if row.get("promised") is not None and row.get("measured", 0) > 0 else None


def share_near(rows):
    """Percentage of promises within NEAR times the measured error, and the median of the ratios."""
    ratios = np.array([ratio_of(row) for row in rows if ratio_of(row) is not None])
    if len(ratios) == 0:
        return None
    return {"answers": len(ratios), "near_percent": round(100 * float(np.mean((ratios >= 1) & (ratios <= NEAR))), 1),
            "median_promised_over_measured": float("%.3g" % np.median(ratios)),
            "median_asked_over_measured": float("%.3g" % np.median([row["asked"] / row["measured"] for row in rows if ratio_of(row) is not None]))}


def line_of(name, row):
    if "refused" in row:
        return "%-8s refused: %s" % (name, " ".join(row["refused"])[:150])
    promised = "%.1e" % row["promised"] if row["promised"] is not None else "none"
    return "%-8s ping %d  %-13s %-12s %-17s asked %.1e promised %s measured %.1e%s%s" % (
        name, row["ping"], row["engine"], row["path"], row["doppler"], row["asked"], promised, row["measured"],
        "  marked" if row["marked"] else "", "  BROKEN: %s" % ", ".join(row["broken"]) if row["broken"] else "")


def summary(rows, out=print):
    answers = [row for row in rows if "refused" not in row]
    out("%d answers, %d refusals" % (len(answers), len(rows) - len(answers)))
    for engine in sorted({row["engine"] for row in answers}):
        mine = [row for row in answers if row["engine"] == engine]
        told = [row for row in mine if row["promised"] is not None and row["measured"] > 0]
        ratios = np.sort([row["promised"] / row["measured"] for row in told]) if told else np.array([np.nan])
        out("%-13s %4d answers: promise below measured %d, above asked %d (unmarked %d), promised/measured min %.2g median %.2g max %.2g, "
            "within %d of it %.0f %%" % (
                engine, len(mine), sum("promise" in row["broken"] for row in mine), sum(row["measured"] > row["asked"] for row in mine),
                sum("silent" in row["broken"] for row in mine), ratios[0], np.median(ratios), ratios[-1],
                NEAR, 100 * np.mean((ratios >= 1) & (ratios <= NEAR))))
    resolved = [row for row in answers if row["measured"] > SURE]
    made = {
        "answers": len(answers), "refusals": len(rows) - len(answers),
        "promise_below_measured": sum("promise" in row["broken"] for row in answers),
        "above_asked": sum(row["measured"] > row["asked"] for row in answers),
        "above_asked_unmarked": sum("silent" in row["broken"] for row in answers),
        "all": share_near(answers), "above_rounding": share_near(resolved),
        "unmarked_above_rounding": share_near([row for row in resolved if not row["marked"]]),
    }
    for name in ("all", "above_rounding", "unmarked_above_rounding"):
        if made[name]:
            out("%-23s %4d answers: promise within %d times %.0f %%, median %.3g; asked/measured median %.3g" % (
                name.replace("_", " "), made[name]["answers"], NEAR, made[name]["near_percent"],
                made[name]["median_promised_over_measured"], made[name]["median_asked_over_measured"]))
    far = sorted((row for row in answers if (ratio_of(row) or 0) > NEAR), key=lambda row: -ratio_of(row))
    if far:
        out("promises above %d times the measured error:" % NEAR)
    for row in far[:LISTED]:
        out("%-8s ping %d  %-13s %6.1f times %.1e, promised %.1e | %s" % (
            row["rig"], row["ping"], row["engine"], ratio_of(row), row["measured"], row["promised"], row["note"]))
    return made


def rows_of(options, name, path, note):
    """Judged rows of one configuration."""
    asked = asked_of(path, options.set)
    try:
        made = compare(options.echotank, path, options.set, options.pings)
    except subprocess.TimeoutExpired as error:
        made = [{"refused": ["timed out after %d s" % error.timeout]}]
    for row in made:
        row.update({"rig": name, "note": note})
        if "refused" not in row:
            judge(row, asked)
    return made


def drawn(options, base, k):
    """Draws rig k and compares it. Runs in a process of its own with --jobs."""
    folder = base / ("%s-%d-%d" % (options.engine, options.seed, k))
    folder.mkdir(parents=True, exist_ok=True)
    note = draw_rig(np.random.default_rng([options.seed, k]), folder, options.engine, options.arcs)
    return rows_of(options, "%d-%d" % (options.seed, k), folder / "rig.toml", note)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--echotank", metavar="BIN", required=True)
    parser.add_argument("--rigs", type=int, default=20, metavar="N")
    parser.add_argument("--seed", type=int, default=1, metavar="S")
    parser.add_argument("--engine", choices=ENGINES, default="auto", help="synthesis of all rigs (default auto)")
    parser.add_argument("--arcs", action="store_true", help="bend every array of three elements and more to an arc")
    parser.add_argument("--only", type=int, metavar="K", help="only this rig of the seed")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="rigs at a time, each in a process of its own (default 1)")
    parser.add_argument("--json", metavar="FILE", help="write the summary and all rows as one JSON file")
    parser.add_argument("--keep", metavar="FOLDER", help="keep the rigs there, and all rows as rows.jsonl")
    parser.add_argument("--rig", metavar="RIG.toml", help="compare this configuration instead")
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[])
    parser.add_argument("--pings", type=lambda text: tuple(int(p) for p in text.split(",")), default=PINGS, help="pings to compare (default 1,6)")
    parser.add_argument("--limit", type=float, help="largest error of any answer, instead of what was promised")
    options = parser.parse_args(arguments)
    if options.jobs > 1:
        # Each process, and the program that it starts, uses one core.
        for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS"):
            os.environ.setdefault(name, "1")
        options.set.append("run.threads=1")
    rows = []
    began = time.monotonic()

    def take(more):
        for row in more:
            rows.append(row)
            print(line_of(row["rig"], row), "| " + row["note"] if row.get("broken") else "", flush=True)
            if options.keep:
                with open(pathlib.Path(options.keep) / "rows.jsonl", "a", encoding="utf-8") as stream:
                    stream.write(json.dumps(row) + "\n")

    if options.rig:
        take(rows_of(options, pathlib.Path(options.rig).stem, options.rig, ""))
    else:
        with tempfile.TemporaryDirectory() as scratch:
            base = pathlib.Path(options.keep or scratch)
            numbers = range(options.rigs) if options.only is None else [options.only]
            if options.jobs == 1:
                for k in numbers:
                    take(drawn(options, base, k))
            else:
                with concurrent.futures.ProcessPoolExecutor(options.jobs) as pool:
                    for made in concurrent.futures.as_completed([pool.submit(drawn, options, base, k) for k in numbers]):
                        take(made.result())
    made = summary(rows)
    print("%.0f s" % (time.monotonic() - began))
    if options.json:
        made.update({"seed": options.seed, "rigs": options.rigs, "engine": options.engine, "rows": rows})
        pathlib.Path(options.json).write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")
    if options.limit is not None:
        return int(not rows or any(row.get("measured", math.inf) > options.limit for row in rows))
    return int(any(row.get("broken") for row in rows))


if __name__ == "__main__":
    sys.exit(main())
