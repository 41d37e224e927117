"""Rays through a sound-speed profile by integration of the ray equations, for the test of src/synthesis/echo/rays.rs.

    pip install scipy
    python tools/rays_reference.py > tests/data/rays/reference.csv

A ray of elevation e (from the horizontal, positive down) obeys dr/ds = cos e, dz/ds = sin e, de/ds = -cos e c'(z) / c(z), dt/ds = 1 / c(z) (Jensen et al.
2011, Computational Ocean Acoustics, section 3.2.1). It is integrated piece by piece between the points of the profile, where c' steps, with DOP853 at a
relative tolerance of 1e-13. The spreading follows from the ranges of rays beside it: |p|^2 = (c_2 / c_1) cos e_1 / (r |dr/de_1| sin e_2).
"""

import math

from scipy.integrate import solve_ivp

PROFILE = [
    (0.0, 1502.0), (4.0, 1503.5), (9.0, 1501.0), (14.0, 1489.0), (22.0, 1481.0),
    (35.0, 1478.5), (60.0, 1479.5), (110.0, 1483.0), (200.0, 1490.5),
]  # fmt: skip
TOLERANCE = 1e-13


def layer(depth_m, elevation):
    """Speed and gradient as functions of depth in the layer that a ray enters, with the depths of its ends."""
    for (z0, c0), (z1, c1) in zip(PROFILE, PROFILE[1:]):
        is_inside = z0 < depth_m < z1 or (depth_m == z0 and elevation > 0) or (depth_m == z1 and elevation < 0)
        if is_inside:
            g = (c1 - c0) / (z1 - z0)
            return (lambda z: c0 + g * (z - z0)), g, z0, z1
    raise ValueError(f"a ray leaves the profile at {depth_m} m")


def trace(from_m, elevation, to_m, turns):
    """Range, time, length and elevation where a ray meets `to_m` after so many turns."""
    state, turned = [0.0, from_m, elevation, 0.0, 0.0], 0
    while True:
        c, g, top, bottom = layer(state[1], state[2])
        stops = {top, bottom}
        if top <= to_m <= bottom and to_m != state[1]:
            stops.add(to_m)

        def slope(_, y):
            return [math.cos(y[2]), math.sin(y[2]), -math.cos(y[2]) * g / c(y[1]), 1 / c(y[1]), 1.0]

        def crossing(depth_m):
            def event(_, y):
                return y[1] - depth_m

            event.terminal = True
            return event

        def level(_, y):
            return y[2]

        level.terminal = True
        # A ray that starts at an end of the layer must leave it first.
        start = solve_ivp(slope, (0, 1e-3), state, method="DOP853", rtol=TOLERANCE, atol=TOLERANCE).y[:, -1]
        events = [crossing(depth_m) for depth_m in sorted(stops)] + [level]
        found = solve_ivp(slope, (0, 1e5), start, method="DOP853", rtol=TOLERANCE, atol=TOLERANCE, events=events, max_step=5.0)
        which = next(k for k, t in enumerate(found.t_events) if len(t))
        state = list(found.y_events[which][0])
        if which == len(stops):
            turned += 1
            # Past the turn by symmetry of the arc: a millimetre further.
            state = list(solve_ivp(slope, (0, 1e-3), state, method="DOP853", rtol=TOLERANCE, atol=TOLERANCE).y[:, -1])
            continue
        state[1] = sorted(stops)[which]
        if state[1] == to_m and turned == turns:
            return state[0], state[3], state[4], state[2]
        if state[1] in (0.0, PROFILE[-1][0]):
            raise ValueError("a ray meets an end of the profile")


def spreading(from_m, elevation, to_m, turns):
    """Pressure relative to 1 m."""
    step = 1e-4
    ranges = [trace(from_m, elevation + k * step, to_m, turns)[0] for k in (-2, -1, 1, 2)]
    slope = (ranges[0] - 8 * ranges[1] + 8 * ranges[2] - ranges[3]) / (12 * step)
    range_m, _, _, arrival = trace(from_m, elevation, to_m, turns)
    speed = lambda depth_m: layer(depth_m, 1.0)[0](depth_m)  # noqa: E731
    tube = range_m * abs(slope * math.sin(arrival))
    return math.sqrt(speed(to_m) / speed(from_m) * math.cos(elevation) / tube)


CASES = [(3.0, deg, 48.0, 0) for deg in (88.0, 75.0, 60.0, 45.0, 30.0, 20.0, 14.0, 10.5)]
CASES += [(3.0, deg, 12.5, 0) for deg in (70.0, 25.0, 9.0)]
CASES += [(150.0, -deg, 20.0, 0) for deg in (80.0, 40.0, 15.0)]
CASES += [(7.0, -deg, 30.0, 1) for deg in (1.5, 2.2)]
CASES += [(120.0, deg, 118.0, 1) for deg in (2.0, 3.0)]

if __name__ == "__main__":
    print("# written by tools/rays_reference.py")
    for depth_m, speed in PROFILE:
        print(f"profile,{depth_m},{speed}")
    for from_m, deg, to_m, turns in CASES:
        elevation = math.radians(deg)
        range_m, time_s, length_m, arrival = trace(from_m, elevation, to_m, turns)
        pressure = spreading(from_m, elevation, to_m, turns)
        values = (range_m, elevation, arrival, time_s, length_m, pressure)
        figures = ",".join(repr(float(value)) for value in values)
        print(f"ray,{from_m},{to_m},{figures}")
