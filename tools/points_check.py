#!/usr/bin/env python3
"""Recomputes the element samples of a scene of explicit points, from its configuration and its CSV files alone.

    points_check.py RIG.toml pings.npz [--sonar NAME] [--limit 1e-9] [--norm record|window] [--elements 0,7] [--set KEY=VALUE]
    points_check.py RIG.toml pings.npz --model linear

An independent calculation: it shares no code with the emulator and reads none of its output except the pings.npz under test.
Valid without absorption, noise, gain and quantisation. For every point, the time t' of transmission is solved from

    c (t - t') = |S - p_T(t')| + |S - r_e(t)|

and the envelope about the centre frequency is  x_e(t) = sum_m A_{m,e} a(t'_m) exp(j 2 pi f_c (t'_m - t)),  where
a(t) = taper(t) exp(+-j pi (B/T) (t - T/2)^2) on 0 <= t <= T and A_{m,e} = amplitude b_T b_R / (r_T r_R), the distances and patterns
being those of the pulse's leading edge. Transmitter and elements follow the track: cubic Hermite curves for the position, cubic Bezier curves
on rotations for the attitude. The receiver filter is its integral  integral h(t - s) x_e(s) ds,  by Gauss and Legendre's rule between
samples, with every edge, flank and knot of the track as an end of integration.

`--norm record` compares the records of elements in l2. `--norm window` takes the largest error of all windows of one pulse length (at least
32 samples) at any offset, over the larger of the window's level and a noise floor 55 dB below the strongest window of the ping.

`--model linear` compares with the stretch about the leading edge u, for uniform straight motion without receiver filter:
x = A exp(-j 2 pi f_c u) a(eta (t - u)) exp(j 2 pi f_c (eta - 1)(t - u)), eta = (c + v.e_R)/(c - v.e_T), which is not exact:
the residual phase at pulse time s is 2 pi f v^2 sin^2(theta) s^2 / (r c) with f <= f_c + B/2, and the bound that follows (its rms
over the pulse) is printed beside what is measured. Delays of this model are computed in extended precision where numpy supports it (x86).

Python >= 3.9 with tools/requirements.txt.
Exit code 0: within the limits. 1: not. 2: the comparison is not possible (files, keys, motion).
"""

import argparse
import csv
import dataclasses
import decimal
import json
import math
import pathlib
import sys

import numpy as np

import points_model

REAL = np.longdouble
TAU = 2 * np.arctan2(REAL(0), REAL(-1))
# By rounding, a transmission time this close to the pulse's start or end may fall on either side of it.
EDGE_S = 1e-12
POSITION_LIMIT_M = 1e-9
VELOCITY_LIMIT_M_PER_S = 1e-9


# ---------------------------------------------------------------------------------------------------------------------
# The configuration: this function names every key that the tool supports.

@dataclasses.dataclass
class Pattern:
    """A flat piston, sinc(L u_x/lambda) sinc(W u_y/lambda); without sides and baffle it hears everywhere alike."""
    length_m: float = 0.0
    width_m: float = 0.0
    baffled: bool = False

    def towards(self, rays, wavelength_m):
        """Response to unit vectors in array axes."""
        answer = np.sinc(self.length_m * rays[:, 0] / wavelength_m) * np.sinc(self.width_m * rays[:, 1] / wavelength_m)
        return np.where(rays[:, 2] < 0, 0.0, answer) if self.baffled else answer


@dataclasses.dataclass
class ReceiveArray:
    name: str
    elements: int
    spacing_m: float
    position_m: np.ndarray
    roll_pitch_yaw_deg: tuple
    transmit: int
    level_db: float
    pattern: Pattern = dataclasses.field(default_factory=Pattern)
    # Of an arc; 0 for a straight line.
    radius_m: float = 0.0


@dataclasses.dataclass
class Transmitter:
    position_m: np.ndarray
    roll_pitch_yaw_deg: tuple = (0.0, 0.0, 0.0)
    pattern: Pattern = dataclasses.field(default_factory=Pattern)


@dataclasses.dataclass
class Rig:
    sound_speed_m_per_s: float
    center_frequency_hz: float
    pulse_kind: str
    bandwidth_hz: float
    duration_s: float
    sweep_sign: float
    tukey: float
    receive: list
    transmit: list
    points: list            # ((north, east, down), complex amplitude)
    nav: list               # (ns, (north, east, down), (roll, pitch, heading) in degrees)
    filtered: bool = False


def set_value(config, assignment):
    """Changes one value, as `echotank --set KEY=VALUE` does; in a list of tables, that of every table."""
    key, text = assignment.split("=", 1)
    try:
        value = json.loads(text)
    except ValueError:
        value = text
    *folders, last = key.split(".")
    tables = [config]
    for name in folders:
        tables = [inner for table in tables for inner in (table[name] if isinstance(table[name], list) else [table[name]])]
    for table in tables:
        table[last] = value


def pattern_of(table, kind, side):
    name = table.get(kind, "auto")
    length_m, width_m = (float(table.get(side + key, 0)) for key in ("length_m", "width_m"))
    if name == "auto" and length_m == width_m == 0 and int(table.get("elements", 1)) > 1:
        length_m = float(table["spacing_m"])
    if name == "omnidirectional" or length_m == width_m == 0:
        return Pattern()
    return Pattern(length_m, width_m, table.get("baffled", "radius_m" not in table))


def angles_of(table):
    return tuple(float(table.get(key, 0)) for key in ("roll_deg", "pitch_deg", "yaw_deg"))


def load_rig(path, sonar_name=None, changes=()):
    try:
        import tomllib
    except ImportError:  # before Python 3.11
        import tomli as tomllib
    path = pathlib.Path(path)
    with open(path, "rb") as stream:
        config = tomllib.load(stream)
    for change in changes:
        set_value(config, change)
    sonars = config["sonar"]
    sonar = next(s for s in sonars if s.get("name") == sonar_name) if sonar_name else sonars[0]
    pulse, receiver = sonar["pulse"], sonar["receiver"]
    if receiver.get("noise_db", "ambient") != "none":
        raise ValueError("noise_db must be \"none\"")
    for key, off in (("adc_bits", None), ("tvg", "none")):
        if receiver.get(key, off) != off:
            raise ValueError("%s is not supported" % key)
    if config["medium"]["absorption"] != "none":
        raise ValueError("absorption is not supported")
    if config["nav"].get("vertical") != "depth":
        raise ValueError("nav.vertical must be depth")
    transmit_names = [t.get("name") for t in sonar["transmit"]]
    source_level_db = float(sonar["ping"].get("source_level_db", 0.0))
    receive = [ReceiveArray(
        name=a.get("name", str(i)), elements=int(a["elements"]), spacing_m=float(a.get("spacing_m", 0.0)),
        position_m=np.array(a.get("position_m", [0, 0, 0]), float),
        roll_pitch_yaw_deg=angles_of(a), transmit=transmit_names.index(a["transmit"]),
        level_db=source_level_db + float(a.get("sensitivity_db", -190.0)), pattern=pattern_of(a, "element_pattern", "element_"),
        radius_m=float(a.get("radius_m", 0.0)),
    ) for i, a in enumerate(sonar["receive"])]
    return Rig(
        sound_speed_m_per_s=float(config["medium"]["sound_speed_m_per_s"]),
        center_frequency_hz=exact_scale(pulse["center_frequency_khz"], 3),
        pulse_kind=pulse.get("kind", "lfm"),
        bandwidth_hz=exact_scale(pulse.get("bandwidth_khz", 0), 3),
        duration_s=exact_scale(pulse["duration_ms"], -3),
        sweep_sign=-1.0 if pulse.get("sweep", "up") == "down" else 1.0,
        tukey=float(pulse.get("taper", 0.0)),
        receive=receive,
        transmit=[Transmitter(np.array(t.get("position_m", [0, 0, 0]), float), angles_of(t), pattern_of(t, "pattern", ""))
                  for t in sonar["transmit"]],
        points=read_points(path.parent / config["scene"]["points"]),
        nav=read_nav(path.parent / config["nav"]["source"][0]["path"]),
        filtered=receiver.get("rx_filter", "fir") == "fir",
    )


def exact_scale(value, power):
    """value x 10^power rounded once, as if the value had been written in the other unit."""
    return float(decimal.Decimal(repr(value)).scaleb(power))


def read_csv(path):
    with open(path, newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(line for line in stream if line.strip() and not line.lstrip().startswith("#")))


def read_points(path):
    return [((float(r["north_m"]), float(r["east_m"]), float(r["down_m"])),
             complex(float(r["amplitude"]), float(r.get("amplitude_imag") or 0.0))) for r in read_csv(path)]


def read_nav(path):
    # Decimal: a UTC in seconds does not fit a double to the nanosecond.
    return [(int((decimal.Decimal(r["time_s"]) * 10**9).to_integral_value()),
             (float(r["north_m"]), float(r["east_m"]), float(r["down_m"])),
             (float(r["roll_deg"]), float(r["pitch_deg"]), float(r["heading_deg"]))) for r in read_csv(path)]


# ---------------------------------------------------------------------------------------------------------------------
# Geometry

def rotation(roll_deg, pitch_deg, yaw_deg):
    """Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a), np.sin(a)) for a in np.array([roll_deg, pitch_deg, yaw_deg], REAL) * TAU / 360)
    rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]], REAL)
    ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]], REAL)
    rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]], REAL)
    return rz @ ry @ rx


def elements_in_body(array):
    along = (np.arange(array.elements).astype(REAL) - REAL(array.elements - 1) / 2) * REAL(array.spacing_m)
    offsets = np.zeros((array.elements, 3), REAL)
    offsets[:, 0] = along
    if array.radius_m:
        radius, angles = REAL(array.radius_m), along / REAL(array.radius_m)
        offsets[:, 0], offsets[:, 2] = radius * np.sin(angles), -2 * radius * np.sin(angles / 2) ** 2
    return array.position_m.astype(REAL) + offsets @ rotation(*array.roll_pitch_yaw_deg).T


def normal_deg(array, element):
    """Angle of an element's normal from the boresight, towards the array's x axis."""
    if not array.radius_m:
        return 0.0
    return float(360 / TAU * (element - (array.elements - 1) / 2) * array.spacing_m / array.radius_m)


class Unsupported(Exception):
    """A motion for which this calculation is not valid."""


def uniform_pose(nav, time_ns, window_s):
    """Position, velocity, rotation at a time; refuses a track that is not straight, steady and level through the window."""
    times = [row[0] for row in nav]
    after = next((i for i, t in enumerate(times) if t > time_ns), len(times))
    if after == 0 or (after == len(times) and time_ns > times[-1]) or len(nav) < 2:
        raise Unsupported("%d ns lies outside the track %d..%d" % (time_ns, times[0], times[-1]))
    first = min(after, len(times) - 1) - 1
    last = first + 1
    while last + 1 < len(times) and times[last] < time_ns + window_s * 1e9:
        last += 1
    origin, start, attitude = times[first], np.array(nav[first][1], REAL), nav[first][2]
    velocity = (np.array(nav[last][1], REAL) - start) / (REAL(times[last] - origin) / REAL(10**9))
    for t, position, angles in nav[first:last + 1]:
        off = np.abs(np.array(position, REAL) - start - velocity * (REAL(t - origin) / REAL(10**9))).max()
        if off > 1e-9:
            raise Unsupported("the track bends: %.3g m off a straight steady line at %d ns" % (off, t))
        if angles != attitude:
            raise Unsupported("the attitude changes within the ping at %d ns: %s, %s" % (t, attitude, angles))
    return start + velocity * (REAL(time_ns - origin) / REAL(10**9)), velocity, rotation(*attitude)


def length(vector):
    return np.sqrt((vector * vector).sum(axis=-1))


def leading_edge(point, transmit, receive, velocity, c):
    """Delay of the pulse's leading edge: |d - v u| = c u - r_T."""
    r_t = length(point - transmit)
    d = point - receive
    v2, dv = (velocity * velocity).sum(), (d * velocity).sum(axis=-1)
    b = c * r_t - dv
    # (b + sqrt(b^2 - (c^2 - v^2)(r_T^2 - d^2))) / (c^2 - v^2): both terms positive, nothing cancels.
    return (b + np.sqrt(b * b - (c * c - v2) * (r_t * r_t - (d * d).sum(axis=-1)))) / (c * c - v2)


def departure(t, point, transmit, receive, velocity, c):
    """t' for every t: the root of |D - v t'| = K - c t' with K = c t - |S - r_e(t)|, in the form that does not cancel near t' = 0."""
    k = c * t - length(point - receive - velocity * t[:, None])
    d = point - transmit
    r = length(d)
    v2 = (velocity * velocity).sum()
    b = k * c - (d * velocity).sum()
    numerator = (k - r) * (k + r)
    return numerator / (b + np.sqrt(b * b - (c * c - v2) * numerator))


# ---------------------------------------------------------------------------------------------------------------------
# The signal

def unit_phasor(cycles):
    """exp(j 2 pi cycles); whole cycles are removed in extended precision first."""
    angle = ((cycles - np.round(cycles)) * TAU).astype(np.float64)
    return np.cos(angle) + 1j * np.sin(angle)


def pulse_envelope(t, rig):
    """a(t), zero outside 0 <= t <= T."""
    duration = REAL(rig.duration_s)
    inside = (t >= 0) & (t <= duration)
    if rig.pulse_kind == "cw":
        a = np.ones(len(t), complex)
    else:
        a = unit_phasor(rig.sweep_sign * REAL(rig.bandwidth_hz) / duration / 2 * (t - duration / 2) ** 2)
    if rig.tukey > 0:
        ramp = np.clip(np.minimum(t, duration - t) / (rig.tukey * duration / 2), 0, 1)
        a = a * (0.5 - 0.5 * np.cos((ramp * TAU / 2).astype(np.float64)))
    return np.where(inside, a, 0)


@dataclasses.dataclass
class Echoes:
    exact: np.ndarray
    on_edge: np.ndarray      # samples whose departure lies within EDGE_S of the pulse's ends
    linear: np.ndarray = None
    support_differs: int = 0     # samples inside the pulse in one model and outside in the other
    bound: float = 0.0           # of the linear model's error, relative to the exact samples
    peak_phase_rad: float = 0.0  # largest residual phase at the pulse's end over the points


def element_samples(rig, level_db, transmit, receive, velocity, sample_rate_hz, first_sample_s, count):
    """One element of one ping, in both models."""
    c, fc, fs, duration = REAL(rig.sound_speed_m_per_s), REAL(rig.center_frequency_hz), REAL(sample_rate_hz), REAL(rig.duration_s)
    exact, linear = np.zeros(count, complex), np.zeros(count, complex)
    on_edge = np.zeros(count, bool)
    differs, intervals, peak = 0, [], 0.0
    speed2 = (velocity * velocity).sum()
    for place, strength in rig.points:
        point = np.array(place, REAL)
        u = leading_edge(point, transmit, receive, velocity, c)
        to_t, to_r = point - transmit, point - receive - velocity * u
        r_t, r_r = length(to_t), length(to_r)
        amplitude = strength * 10 ** (level_db / 20) / float(r_t * r_r)
        closing_t, closing_r = (to_t * velocity).sum() / r_t, (to_r * velocity).sum() / r_r
        eta = (c + closing_r) / (c - closing_t)
        begin = max(0, math.floor((u - first_sample_s) * fs) - 1)
        end = min(count, math.ceil((u + duration / eta * REAL(1.001) - first_sample_s) * fs) + 2)
        if begin >= end:
            continue
        t = REAL(first_sample_s) + np.arange(begin, end).astype(REAL) / fs
        left = departure(t, point, transmit, receive, velocity, c)
        exact[begin:end] += amplitude * pulse_envelope(left, rig) * unit_phasor(fc * (left - t))
        stretched = eta * (t - u)
        linear[begin:end] += amplitude * unit_phasor(-fc * u) * pulse_envelope(stretched, rig) * unit_phasor(fc * (eta - 1) * (t - u))
        on_edge[begin:end] |= (np.abs(left) <= EDGE_S) | (np.abs(left - duration) <= EDGE_S)
        inside = [(x >= 0) & (x <= duration) for x in (left, stretched)]
        differs += int((inside[0] != inside[1]).sum())
        # Residual delay s^2 x this, each leg with its own angle; v^2 sin^2(theta)/(r c) where the legs are equal.
        curvature = float(((speed2 - closing_t ** 2) / r_t + (speed2 - closing_r ** 2) / r_r) / 2 / c)
        peak = max(peak, float(TAU * fc * duration ** 2) * curvature)
        inside_count = int(inside[0].sum())
        if inside_count:
            # rms over the existing samples; the instantaneous frequency is at most f_c + B/2.
            fastest = 2 * math.pi * (rig.center_frequency_hz + rig.bandwidth_hz / 2)
            rms = fastest * curvature * float(np.sqrt((left[inside[0]] ** 4).mean()))
            intervals.append((begin, end, abs(amplitude) * rms * math.sqrt(inside_count)))
    total = np.linalg.norm(exact)
    return Echoes(exact, on_edge, linear, differs, overlap_sum(intervals) / total if total > 0 else 0.0, peak)


def overlap_sum(intervals):
    """l2 bound of a sum of errors: errors of overlapping echoes add linearly, those of separate groups in squares."""
    groups, reach = [], -1
    for begin, end, error in sorted(intervals):
        if begin < reach:
            groups[-1] += error
            reach = max(reach, end)
        else:
            groups.append(error)
            reach = end
    return math.sqrt(sum(g * g for g in groups))


def relative_l2(got, want):
    norm = np.linalg.norm(want)
    error = np.linalg.norm(got - want)
    return float(error / norm) if norm > 0 else (0.0 if error == 0 else math.inf)


# ---------------------------------------------------------------------------------------------------------------------
# The comparison

def array_indices(rig, element_array):
    names = [a.name for a in rig.receive]
    return [int(v) if np.issubdtype(np.asarray(v).dtype, np.number) else names.index(v.decode() if isinstance(v, bytes) else str(v))
            for v in element_array]


def uniform_ping(rig, ping_ns, window_s):
    """Transmitters, elements of each array and velocity at the start of a ping, and a function of one element's echoes, in closed form."""
    position, velocity, world = uniform_pose(rig.nav, ping_ns, window_s)
    transmits = [position + world @ t.position_m.astype(REAL) for t in rig.transmit]
    receives = [position + elements_in_body(a) @ world.T for a in rig.receive]

    def echoes(array, element, fs, first, count):
        owner = rig.receive[array]
        return element_samples(rig, owner.level_db, transmits[owner.transmit], receives[array][element], velocity, fs, first, count)
    return transmits, receives, velocity, echoes


def moving_ping(rig, ping_ns, window_s):
    """As uniform_ping, for any motion; only exact samples."""
    motion = points_model.Motion(rig.nav, ping_ns)
    if motion.times[-1] < window_s:
        raise Unsupported("the track ends within the ping at %d ns" % ping_ns)
    bodies = [elements_in_body(a).astype(float) for a in rig.receive]

    def at_start(body):
        return motion.origin_m + motion.point(np.zeros(1), body)[0]

    def echoes(array, element, fs, first, count):
        owner = rig.receive[array]
        place = bodies[array][element], normal_deg(owner, element)
        return Echoes(*points_model.element_record(rig, motion, owner, place, fs, first, count))
    return ([at_start(t.position_m) for t in rig.transmit], [[at_start(b) for b in body] for body in bodies], motion.velocity(), echoes)


def worst_axis(got, want):
    return float(np.abs(np.asarray(got, REAL) - want).max())


def window_samples(rig, fs):
    """A window is as long as the pulse, and at least 32 samples."""
    return max(math.ceil(rig.duration_s * fs), 32)


def compare(rig, pings, options, out=print):
    iq = np.asarray(pings["iq_by_element"])
    n_pings, n_elements, count = iq.shape
    fs, first = float(pings["sample_rate_hz"]), float(pings["first_sample_s"])
    linear = options.model == "linear"
    failures = []

    def hold(what, got, limit):
        ok = got <= limit
        out("%-4s  %-52s %.3e  limit %.1e" % ("ok" if ok else "FAIL", what, got, limit))
        if not ok:
            failures.append(what)

    if iq.dtype != np.complex128:
        out("note: samples are %s; a limit below 1e-7 needs complex128" % iq.dtype)
    for key, want in (("center_frequency_hz", rig.center_frequency_hz), ("sound_speed_m_per_s", rig.sound_speed_m_per_s)):
        hold("%s against the configuration" % key, abs(float(pings[key]) / want - 1), 1e-15)
    owner = array_indices(rig, pings["element_array"])
    within, seen = [], {}
    for a in owner:
        within.append(seen.get(a, 0))
        seen[a] = within[-1] + 1
    for a, number in seen.items():
        if rig.receive[a].elements != number:
            failures.append("elements")
            out("FAIL  array %s: %d elements in the file, %d in the configuration" % (rig.receive[a].name, number, rig.receive[a].elements))
            return failures
    compared = options.elements or list(range(n_elements))

    worst = {"transmit": 0.0, "element": 0.0, "velocity": 0.0}
    rows, windows = [], []
    for p in range(n_pings):
        ping = uniform_ping if linear else moving_ping
        transmits, receives, velocity, echoes = ping(rig, int(pings["ping_utc_ns"][p]), first + count / fs)
        worst["velocity"] = max(worst["velocity"], worst_axis(pings["velocity_m_per_s"][p], velocity))
        worst["transmit"] = max(worst["transmit"], worst_axis(pings["transmit_position_m"][p], transmits[0]))
        wanted = np.zeros((len(compared), count), complex)
        for i, e in enumerate(compared):
            worst["element"] = max(worst["element"], worst_axis(pings["element_position_m"][p][e], receives[owner[e]][within[e]]))
            made = echoes(owner[e], within[e], fs, first, count)
            wanted[i] = made.linear if linear else made.exact
            off_edge = ~made.on_edge
            row = {"ping": p, "element": e, "error": relative_l2(iq[p, e], wanted[i]), "edges": int(made.on_edge.sum()),
                   "error_off_edges": relative_l2(iq[p, e][off_edge], wanted[i][off_edge]), "energy": float(np.linalg.norm(made.exact))}
            if linear:
                row.update({"to_exact": relative_l2(iq[p, e], made.exact), "linear_to_exact": relative_l2(made.linear, made.exact),
                            "bound": made.bound, "peak_phase": made.peak_phase_rad, "support_differs": made.support_differs})
            rows.append(row)
        windows.append(points_model.window_error(iq[p, compared], wanted, window_samples(rig, fs)))
    out("%d pings x %d elements x %d samples, %d points, fs %.9g Hz, first sample at %.9g s" % (
        n_pings, len(compared), count, len(rig.points), fs, first))
    hold("transmit position, worst axis (m)", worst["transmit"], POSITION_LIMIT_M)
    hold("element position, worst axis (m)", worst["element"], POSITION_LIMIT_M)
    hold("velocity, worst axis (m/s)", worst["velocity"], VELOCITY_LIMIT_M_PER_S)
    if not any(r["energy"] > 0 for r in rows):
        failures.append("empty")
        out("FAIL  no echo falls into the window: nothing was compared")
    bad = max(rows, key=lambda r: r["error"])
    ping = max(range(n_pings), key=lambda p: windows[p][0])
    error, element, sample = windows[ping]
    of_records = "samples against the %s sum, relative l2 (ping %d, element %d)" % (options.model, bad["ping"], bad["element"])
    of_windows = "samples against the %s sum, worst window (ping %d, element %d, from sample %d)" % (
        options.model, ping, compared[element], sample)
    if options.norm == "record":
        hold(of_records, bad["error"], options.limit)
        out("      %-52s %.3e" % (of_windows, error))
    else:
        hold(of_windows, error, options.limit)
        out("      %-52s %.3e" % (of_records, bad["error"]))
    edges = sum(r["edges"] for r in rows)
    out("      samples within %.0e s of a pulse's first or last moment: %d%s" % (
        EDGE_S, edges, "" if not edges else "; without them the worst is %.3e" % max(r["error_off_edges"] for r in rows)))
    if linear:
        out("      to the exact sum at worst %.3e" % max(r["to_exact"] for r in rows))
        over = max(rows, key=lambda r: r["linear_to_exact"] / r["bound"] if r["bound"] > 0 else 0.0)
        out("      linear form against exact, computed here: measured %.3e, bound %.3e (ping %d, element %d; residual phase at the pulse's "
            "end %.3e rad); %d samples are inside the pulse in one form alone" % (
                over["linear_to_exact"], over["bound"], over["ping"], over["element"], max(r["peak_phase"] for r in rows),
                sum(r["support_differs"] for r in rows)))
    if options.json:
        pathlib.Path(options.json).write_text(json.dumps({"worst": worst, "rows": rows, "windows": windows, "failures": failures}, indent=1))
    return failures


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("rig", metavar="RIG.toml")
    parser.add_argument("pings", metavar="pings.npz")
    parser.add_argument("--sonar", metavar="NAME", help="[[sonar]] of the file (default: the first)")
    parser.add_argument("--limit", type=float, default=1e-9, help="largest error of any element in any ping (default 1e-9)")
    parser.add_argument("--norm", choices=("record", "window"), default="record")
    parser.add_argument("--model", choices=("exact", "linear"), default="exact")
    parser.add_argument("--elements", type=lambda text: [int(e) for e in text.split(",")], help="only these, counted from 0")
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], help="change a value of the configuration, as echotank does")
    parser.add_argument("--json", metavar="FILE", help="write all results as JSON")
    options = parser.parse_args(arguments)
    try:
        rig = load_rig(options.rig, options.sonar, options.set)
        with np.load(options.pings) as pings:
            failures = compare(rig, dict(pings), options)
    except (OSError, KeyError, IndexError, StopIteration, ValueError, Unsupported) as error:
        print("cannot compare: %s: %s" % (type(error).__name__, error), file=sys.stderr)
        return 2
    print("FAILED: %s" % "; ".join(failures) if failures else "all within the limits")
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(main())
