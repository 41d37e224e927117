"""Element samples of points seen from a moving platform: the calculation of points_check.py, from the equations of docs/concepts/model.md alone.

In: a rig (points_check.Rig) and the time of a ping. Out: complex envelopes of single elements, exact for the motion that frames.md defines: a
cubic Hermite curve for the position and a cumulative cubic Bezier curve on rotations for the attitude. Times of transmission are found by
iteration at the Chebyshev points of every smooth piece of an echo; a smooth piece ends at an edge or a flank of the pulse and at the knots
of the track. The receiver filter is an integral over these pieces, by Gauss and Legendre's rule between two samples.
"""

import numpy as np

TAU = 2 * np.pi
# Points at which an echo's piece is solved: for pulses of 10 ms and points at 0.7 m, errors stay below 1e-10.
CHEBYSHEV = 20
# The iterations for a time of transmission or reception gain a factor c/v each.
ITERATIONS = 40
SETTLED_S = 1e-16
# Shorter pieces hold no energy.
SHORTEST_S = 1e-13


def gauss(begin, end, count=None):
    """Nodes and weights between two samples, or in a part of that; as many as oscillations at the sample rate need for 1e-10."""
    nodes, weights = np.polynomial.legendre.leggauss(count or 5 + int(np.ceil(7 * (end - begin))))
    return begin + (end - begin) * (1 + nodes) / 2, (end - begin) / 2 * weights


# ---------------------------------------------------------------------------------------------------------------------
# Motion

def cross_matrix(v):
    zero = np.zeros_like(v[..., 0])
    rows = [[zero, -v[..., 2], v[..., 1]], [v[..., 2], zero, -v[..., 0]], [-v[..., 1], v[..., 0], zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def turn_by(vector):
    """Rotation matrices of rotation vectors (Rodrigues)."""
    angle = np.sqrt((vector * vector).sum(axis=-1))[..., None, None]
    cross = cross_matrix(vector)
    return np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(angle / TAU) ** 2 * (cross @ cross)


def rotation(roll_deg, pitch_deg, yaw_deg):
    """Rz(yaw) Ry(pitch) Rx(roll)."""
    about = np.diag(np.array([roll_deg, pitch_deg, yaw_deg], float)) * (TAU / 360)
    return turn_by(about[2]) @ turn_by(about[1]) @ turn_by(about[0])


def turn_of(matrix):
    """Rotation vector of a rotation by less than half a turn."""
    twice = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])
    sine = np.linalg.norm(twice) / 2
    angle = np.arctan2(sine, (np.trace(matrix) - 1) / 2)
    return twice / 2 * (angle / sine if sine > 0 else 1.0)


def knot_rates(times, slopes):
    """Derivatives at knots by the parabola through three of them; `slopes` are the mean rates between neighbours."""
    steps = np.diff(times)[:, None]
    rates = np.empty((len(times), 3))
    rates[1:-1] = (slopes[:-1] * steps[1:] + slopes[1:] * steps[:-1]) / (steps[1:] + steps[:-1])
    rates[0], rates[-1] = slopes[0], slopes[-1]
    if len(times) > 2:
        rates[0] -= (slopes[1] - slopes[0]) * (steps[0] / (steps[0] + steps[1]))
    return rates


class Motion:
    """The platform around one ping; times are seconds after the start of the pulse, positions relative to `origin_m`."""

    def __init__(self, nav, ping_ns):
        """`nav`: rows of (ns, position, (roll, pitch, heading) in degrees)."""
        self.times = np.array([(ns - ping_ns) / 1e9 for ns, _, _ in nav])
        positions = np.array([position for _, position, _ in nav], float)
        nearest = int(np.abs(self.times).argmin())
        self.origin_m = positions[nearest].copy()
        self.positions = positions - self.origin_m
        steps = np.diff(self.times)
        self.rates = knot_rates(self.times, np.diff(self.positions, axis=0) / steps[:, None])
        matrices = np.array([rotation(*angles) for _, _, angles in nav], float)
        turns = [turn_of(a.T @ b) for a, b in zip(matrices, matrices[1:])]
        body_rates = knot_rates(self.times, np.array(turns) / steps[:, None])
        self.matrices = matrices[:-1]
        # Rotation vectors between the control points of each interval's Bezier curve.
        self.first = body_rates[:-1] * (steps / 3)[:, None]
        self.last = body_rates[1:] * (steps / 3)[:, None]
        inner = zip(matrices[:-1] @ turn_by(self.first), matrices[1:] @ turn_by(-self.last))
        self.middle = np.array([turn_of(a.T @ b) for a, b in inner])
        if len(nav) < 2 or not self.times[0] <= 0.0 < self.times[-1]:
            raise ValueError("the ping at %d ns lies outside the track" % ping_ns)

    def knots_in(self, begin_s, end_s):
        return self.times[(self.times > begin_s) & (self.times < end_s)]

    def pose(self, t):
        """Positions and rotation matrices at times of any shape."""
        i = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.first) - 1)
        step = (self.times[i + 1] - self.times[i])[..., None]
        s = (t - self.times[i])[..., None] / step
        position = (self.positions[i] + (self.positions[i + 1] - self.positions[i]) * (s * s * (3 - 2 * s))
                    + self.rates[i] * step * (s * (1 - s) ** 2) - self.rates[i + 1] * step * (s * s * (1 - s)))
        matrix = self.matrices[i]
        for vectors, weight in ((self.first, 1 - (1 - s) ** 3), (self.middle, s * s * (3 - 2 * s)), (self.last, s ** 3)):
            matrix = matrix @ turn_by(vectors[i] * weight)
        return position, matrix

    def point(self, t, body_m):
        """Positions of a point of the body."""
        position, matrix = self.pose(t)
        return position + matrix @ body_m

    def velocity(self):
        """Velocity of the body's reference point at the start of the pulse."""
        i = int(np.clip(np.searchsorted(self.times, 0.0, side="right") - 1, 0, len(self.first) - 1))
        step = self.times[i + 1] - self.times[i]
        s = -self.times[i] / step
        return ((self.positions[i + 1] - self.positions[i]) * (6 * s * (1 - s) / step)
                + self.rates[i] * (1 - 4 * s + 3 * s * s) + self.rates[i + 1] * (3 * s * s - 2 * s))


# ---------------------------------------------------------------------------------------------------------------------
# Times of transmission and reception

def length(vector):
    return np.sqrt((vector * vector).sum(axis=-1))


def settle(step, start):
    """Fixed point of a contraction."""
    x = start
    for _ in range(ITERATIONS):
        new = step(x)
        moved = np.abs(new - x).max(initial=0.0)
        x = new
        if moved <= SETTLED_S:
            break
    return x


class Legs:
    """The two legs between the platform and points; `points` in coordinates of the motion, `c` in m/s."""

    def __init__(self, motion, transmit_body_m, receive_body_m, c):
        self.motion, self.transmit_body_m, self.receive_body_m, self.c = motion, transmit_body_m, receive_body_m, c

    def out_s(self, points, t):
        return length(points - self.motion.point(t, self.transmit_body_m)) / self.c

    def back_s(self, points, t):
        return length(points - self.motion.point(t, self.receive_body_m)) / self.c

    def arrival(self, points, sent_s):
        """Reception at one element of what left at `sent_s`."""
        there = sent_s + self.out_s(points, sent_s)
        return settle(lambda t: there + self.back_s(points, t), there)

    def departure(self, points, t):
        """Transmission of what is received at `t`."""
        there = t - self.back_s(points, t)
        return settle(lambda sent: there - self.out_s(points, sent), there)


# ---------------------------------------------------------------------------------------------------------------------
# Pulse and filter

def flank_s(rig):
    return rig.tukey * rig.duration_s / 2


def pulse_at(sent_s, rig):
    """a(t') for times within the pulse."""
    from_middle = sent_s - rig.duration_s / 2
    cycles = 0.0 if rig.pulse_kind == "cw" else rig.sweep_sign * rig.bandwidth_hz / rig.duration_s / 2 * from_middle ** 2
    level = 1.0
    if rig.tukey > 0:
        ends = np.clip(np.minimum(sent_s, rig.duration_s - sent_s), 0.0, flank_s(rig))
        level = np.sin(TAU / 4 * ends / flank_s(rig)) ** 2
    return level, cycles


class Filter:
    """The receiver filter: a sinc under a Kaiser window, less the step at the window's ends, with unit gain at the centre frequency.

    Its pass band ends at max(B, 4/T)/2 plus the Doppler shift at 10 m/s, its stop band begins at half the sample rate; length and shape
    by Kaiser's formulas for 84.5 dB.
    """
    STOP_DB = 84.5
    FASTEST_M_PER_S = 10.0

    def __init__(self, rig, sample_rate_hz):
        doppler_hz = 2 * self.FASTEST_M_PER_S / rig.sound_speed_m_per_s * rig.center_frequency_hz
        pass_hz = max(rig.bandwidth_hz, 4 / rig.duration_s) / 2 + doppler_hz
        stop_hz = sample_rate_hz / 2
        self.cut_hz = (pass_hz + stop_hz) / 2
        self.half_s = (self.STOP_DB - 7.95) / (2.285 * TAU * (stop_hz - pass_hz)) / 2
        self.beta = 0.1102 * (self.STOP_DB - 8.7)
        self.scale = 1.0
        # The response has corners at its ends: between two samples, integrals are parted there.
        corner = self.half_s * sample_rate_hz % 1.0
        self.corners = np.unique([corner, 1 - corner])
        ends = np.unique(np.concatenate([[0.0], self.corners, [1.0]]))
        rules = [gauss(*part) for part in zip(ends, ends[1:])]
        self.nodes, self.weights = (np.concatenate(values) for values in zip(*rules))
        nodes, weights = gauss(0.0, self.half_s, 100 + int(8 * self.half_s * sample_rate_hz))
        self.scale = 0.5 / (weights @ self.at(nodes))

    def at(self, t):
        """h(t), per second."""
        inside = np.clip(1 - (t / self.half_s) ** 2, 0.0, 1.0)
        window = (np.i0(self.beta * np.sqrt(inside)) - 1) / (np.i0(self.beta) - 1)
        return self.scale * window * np.sinc(2 * self.cut_hz * t)


# ---------------------------------------------------------------------------------------------------------------------
# Echoes

class Echoes:
    """All echoes at one element, as smooth pieces: piece k holds reception times begin[k]..end[k] of point[k]."""

    def __init__(self, rig, motion, array, place, window_s):
        """`place`: an element's place on the body, and the angle of its normal from the array's boresight."""
        body_m, normal_deg = place
        c = rig.sound_speed_m_per_s
        transmitter = rig.transmit[array.transmit]
        self.rig = rig
        points = np.array([place for place, _ in rig.points]) - motion.origin_m
        legs = Legs(motion, transmitter.position_m, np.asarray(body_m, float), c)
        sent = np.array([0.0, rig.duration_s])
        ends = legs.arrival(points[:, None, :], np.broadcast_to(sent, (len(points), 2)))
        heard = ends[:, 0] < window_s
        points, ends = points[heard], ends[heard]
        self.leading_s, self.trailing_s = ends[:, 0], ends[:, 1]
        strengths = np.array([strength for _, strength in rig.points])[heard]
        self.amplitude = strengths * self.levels(motion, array, transmitter, (np.asarray(body_m, float), normal_deg), points)

        flank = flank_s(rig)
        inner = [t for t in (flank, rig.duration_s - flank) if 0 < t < rig.duration_s]
        sent = np.unique(np.concatenate([inner, motion.knots_in(0.0, rig.duration_s)]))
        inner = legs.arrival(points[:, None, :], np.broadcast_to(sent, (len(points), len(sent))))
        reach = motion.knots_in(ends.min(initial=np.inf), ends.max(initial=-np.inf))
        knots = np.clip(np.broadcast_to(reach, (len(points), len(reach))), ends[:, :1], ends[:, 1:])
        breaks = np.sort(np.concatenate([ends, inner, knots], axis=1), axis=1)
        self.point, column = np.nonzero(np.diff(breaks, axis=1) > SHORTEST_S)
        self.begin_s, self.end_s = breaks[self.point, column], breaks[self.point, column + 1]
        self.last = self.end_s >= self.trailing_s[self.point] - SHORTEST_S

        # Departure minus time since the leading edge, as a Chebyshev series of each piece.
        k = np.arange(CHEBYSHEV)
        x = np.cos(np.pi * (k + 0.5) / CHEBYSHEV)
        half, middle = (self.end_s - self.begin_s)[:, None] / 2, (self.end_s + self.begin_s)[:, None] / 2
        t = middle + half * x
        values = legs.departure(points[self.point][:, None, :], t) - (t - self.leading_s[self.point][:, None])
        basis = np.cos(np.pi * k[:, None] * (k + 0.5) / CHEBYSHEV) * np.where(k == 0, 1, 2)[:, None] / CHEBYSHEV
        self.series = values @ basis.T

    def levels(self, motion, array, transmitter, place, points):
        """A / strength: spreading and patterns of both legs, at the leading edge."""
        body_m, normal_deg = place
        wavelength = self.rig.sound_speed_m_per_s / self.rig.center_frequency_hz
        level = np.full(len(points), 10 ** (array.level_db / 20))
        sent_s = np.zeros(len(points))
        for mounted, at_m, turn_deg, t in ((transmitter, transmitter.position_m, 0.0, sent_s), (array, body_m, normal_deg, self.leading_s)):
            position, matrix = motion.pose(t)
            rays = points - (position + matrix @ at_m)
            ranges = length(rays)
            axes = matrix @ rotation(*mounted.roll_pitch_yaw_deg) @ rotation(0.0, turn_deg, 0.0)
            local = np.einsum("nij,ni->nj", axes, rays / ranges[:, None])
            level = level * mounted.pattern.towards(local, wavelength) / np.maximum(ranges, wavelength)
        return level

    def at(self, k, t):
        """The echoes of pieces `k` at reception times within them, a row each."""
        begin, end, p = self.begin_s[k, None], self.end_s[k, None], self.point[k]
        leading = self.leading_s[p, None]
        extra = np.polynomial.chebyshev.chebval((2 * t - begin - end) / (end - begin), self.series[k].T[:, :, None], tensor=False)
        level, cycles = pulse_at(t - leading + extra, self.rig)
        carrier = self.rig.center_frequency_hz
        cycles = cycles + carrier * extra - np.mod(carrier * leading, 1.0)
        return self.amplitude[p, None] * level * np.exp(1j * TAU * (cycles - np.round(cycles)))


def sampled(echoes, fs, first_s, count):
    """The sum of all echoes at the samples."""
    out = np.zeros(count, complex)
    for k in range(len(echoes.point)):
        begin = max(0, int(np.ceil((echoes.begin_s[k] - first_s) * fs)))
        stop = (echoes.end_s[k] - first_s) * fs
        # The end of an echo belongs to it, the end of an inner piece to the next one.
        end = min(count, int(np.floor(stop)) + 1 if echoes.last[k] else int(np.ceil(stop)))
        if begin < end:
            out[begin:end] += echoes.at([k], first_s + np.arange(begin, end)[None, :] / fs)[0]
    return out


def split_at_corners(parts, corners):
    """Parts (piece, begin, end) of steps between two samples, parted where the filter's response has corners."""
    for k, a, b in parts:
        inner = [x for x in np.floor(a) + corners if a < x < b]
        ends = [a, *inner, b]
        yield from ((k, begin, end) for begin, end in zip(ends, ends[1:]))


def filtered(echoes, h, fs, first_s, count):
    """The sum of all echoes behind the filter `h`, at the samples."""
    reach = int(np.ceil(h.half_s * fs)) + 1
    # Nodes between samples j - reach and j - reach + 1; whole steps of all echoes add on these.
    grid = np.zeros((count + 2 * reach, len(h.nodes)), complex)
    out = np.zeros(count + 5 * reach + 2, complex)
    parts = []
    for k in range(len(echoes.point)):
        a, b = (echoes.begin_s[k] - first_s) * fs, (echoes.end_s[k] - first_s) * fs
        first, last = int(np.ceil(a)), int(np.floor(b))
        if last < first:
            parts.append((k, a, b))
            continue
        parts += [(k, a, first), (k, last, b)]
        first, last = max(first, -reach), min(last, count + reach)
        if first < last:
            t = first_s + (np.arange(first, last)[:, None] + h.nodes) / fs
            grid[first + reach:last + reach] += echoes.at([k], t.reshape(1, -1)).reshape(t.shape)
    steps = np.arange(-reach, reach + 1)
    for g, (node, weight) in enumerate(zip(h.nodes, h.weights)):
        taps = weight / fs * h.at((steps - node) / fs)
        out[reach:reach + len(grid) + 2 * reach] += np.convolve(grid[:, g], taps)
    # Fractions of a step at the ends of pieces. `out` begins 3 reaches before the first sample.
    parts = np.array([part for part in split_at_corners(parts, h.corners) if part[2] - part[1] > SHORTEST_S * fs
                      and -reach <= part[1] <= count + reach])
    for some in np.array_split(parts, len(parts) // 256 + 1) if len(parts) else []:
        k, a, b = some[:, 0].astype(int), some[:, 1, None], some[:, 2, None]
        shares, weights = gauss(0.0, 1.0)
        x = a + (b - a) * shares
        values = echoes.at(k, first_s + x / fs) * weights * ((b - a) / fs)
        n = np.floor(a).astype(int) + np.arange(-reach, reach + 2)
        np.add.at(out, n + 3 * reach, (h.at((n[:, :, None] - x[:, None, :]) / fs) @ values[:, :, None])[:, :, 0])
    return out[3 * reach:3 * reach + count]


def element_record(rig, motion, array, place, fs, first_s, count):
    """Samples of one element (`place` as of Echoes), and the mask of samples on an edge of a pulse (none behind a filter)."""
    h = Filter(rig, fs) if rig.filtered else None
    tail_s = h.half_s + 2 / fs if h else 0.0
    echoes = Echoes(rig, motion, array, place, first_s + count / fs + tail_s)
    if h:
        return filtered(echoes, h, fs, first_s, count), np.zeros(count, bool)
    return sampled(echoes, fs, first_s, count), on_edges(echoes, fs, first_s, count)


def on_edges(echoes, fs, first_s, count):
    """Samples within a picosecond of a pulse's first or last moment; by rounding, they may fall on either side of it."""
    edges = (np.concatenate([echoes.leading_s, echoes.trailing_s]) - first_s) * fs
    nearest = np.round(edges)
    close = (np.abs(edges - nearest) / fs <= 1e-12) & (nearest >= 0) & (nearest < count)
    mask = np.zeros(count, bool)
    mask[nearest[close].astype(int)] = True
    return mask


# ---------------------------------------------------------------------------------------------------------------------
# Windows

def window_energies(samples, window):
    """Energies of all windows at any offset, of each row."""
    total = np.cumsum(samples.real ** 2 + samples.imag ** 2, axis=-1)
    total = np.concatenate([np.zeros(total.shape[:-1] + (1,)), total], axis=-1)
    window = min(window, samples.shape[-1])
    return np.maximum(total[..., window:] - total[..., :-window], 0.0)


def window_error(got, want, window, floor_db=55.0):
    """Largest error of all windows of all rows, over the larger of the window's level and a floor below the strongest window.

    Returns the error, its row and the first sample of its window.
    """
    levels = window_energies(want, window)
    floor = levels.max() * 10 ** (-floor_db / 10)
    off = window_energies(got - want, window)
    if floor == 0:
        return (0.0 if off.max() == 0 else np.inf), 0, 0
    ratios = off / np.maximum(levels, floor)
    row, offset = np.unravel_index(int(ratios.argmax()), ratios.shape)
    return float(np.sqrt(ratios[row, offset])), int(row), int(offset)
