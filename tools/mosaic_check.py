#!/usr/bin/env python3
"""Compares a mosaic of `echotank` with the truth file of the replay that made it, without the emulator's code.

    mosaic_check.py MOSAIC.tif TRUTH.jsonl [--least-db 12] [--targets 3]

tifffile reads the GeoTIFF. Each target that some ping passed abeam is projected here: its offset from that ping on the ellipsoid, then
transverse Mercator by the series of Snyder 1987 (eqs. 8-9 to 8-15). The brightest pixel within four of the position must be at most one pixel
away in either direction and LEAST-DB above the median around it. At least TARGETS targets must have been passed. If masks lie beside the
mosaic, that pixel must have the target's number.
Exit code 0: all checks pass. 1: some fail. 2: the comparison is not possible.
"""

import argparse
import json
import math
import pathlib
import sys

import numpy as np
import tifffile

A = 6378137.0
F = 1 / 298.257223563
E2 = F * (2 - F)
K0 = 0.9996
SEARCH = 4
# A target counts if its ping's beam passed it within this distance, and at least this far from nadir, metres.
ABEAM_M = 1.0
LEAST_ACROSS_M = 20.0


def utm(latitude, longitude):
    """Zone, easting and northing of degrees; Snyder 1987, eqs. 8-9 to 8-15."""
    zone = int((longitude + 180) // 6) + 1
    phi = math.radians(latitude)
    ep2 = E2 / (1 - E2)
    n = A / math.sqrt(1 - E2 * math.sin(phi) ** 2)
    t = math.tan(phi) ** 2
    c = ep2 * math.cos(phi) ** 2
    a = math.radians(longitude - (6 * zone - 183)) * math.cos(phi)
    m = A * (
        (1 - E2 / 4 - 3 * E2**2 / 64 - 5 * E2**3 / 256) * phi
        - (3 * E2 / 8 + 3 * E2**2 / 32 + 45 * E2**3 / 1024) * math.sin(2 * phi)
        + (15 * E2**2 / 256 + 45 * E2**3 / 1024) * math.sin(4 * phi)
        - (35 * E2**3 / 3072) * math.sin(6 * phi)
    )
    x = K0 * n * (a + (1 - t + c) * a**3 / 6 + (5 - 18 * t + t * t + 72 * c - 58 * ep2) * a**5 / 120)
    y = K0 * (
        m
        + n
        * math.tan(phi)
        * (a * a / 2 + (5 - t + 9 * c + 4 * c * c) * a**4 / 24 + (61 - 58 * t + t * t + 600 * c - 330 * ep2) * a**6 / 720)
    )
    return zone, x + 500_000, y + (0 if latitude >= 0 else 10_000_000)


def offset_degrees(latitude, longitude, north, east):
    """Position displaced by metres north and east, by the local radii of curvature."""
    phi = math.radians(latitude)
    w = math.sqrt(1 - E2 * math.sin(phi) ** 2)
    meridian, prime = A * (1 - E2) / w**3, A / w
    return latitude + math.degrees(north / meridian), longitude + math.degrees(east / (prime * math.cos(phi)))


def georeference(page):
    keys = page.tags["GeoKeyDirectoryTag"].value
    epsg = {keys[i]: keys[i + 3] for i in range(4, len(keys), 4)}.get(3072)
    scale = page.tags["ModelPixelScaleTag"].value
    tie = page.tags["ModelTiepointTag"].value
    return epsg, scale[0], tie[3], tie[4]


def passed(pings):
    """For each target the ping that had it closest to abeam, if within ABEAM_M."""
    for number, target in enumerate(pings[0]["targets"]):
        ping = min(pings[3:-3], key=lambda p: abs(p["targets"][number]["along_m"]))
        seen = ping["targets"][number]
        if abs(seen["along_m"]) > ABEAM_M or abs(seen["across_m"]) < LEAST_ACROSS_M:
            continue
        if seen["range_m"] > ping["plan"]["settings"]["range_m"] - 5:
            continue
        yield number + 1, target["name"], ping, seen


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("mosaic", type=pathlib.Path)
    parser.add_argument("truth", type=pathlib.Path)
    parser.add_argument("--least-db", type=float, default=12.0)
    parser.add_argument("--targets", type=int, default=3)
    args = parser.parse_args()
    with tifffile.TiffFile(args.mosaic) as file:
        page = file.pages[0]
        db = page.asarray()
        epsg, pixel, west, north = georeference(page)
    masks = args.mosaic.with_name(args.mosaic.stem + "_target.png")
    labels = None
    if masks.exists():
        import imagecodecs

        labels = imagecodecs.png_decode(masks.read_bytes())
        assert labels.shape == db.shape, (labels.shape, db.shape)
    pings = [json.loads(line) for line in args.truth.read_text().splitlines()]
    good, held = True, 0
    for number, name, ping, seen in passed(pings):
        pose = ping["pose"]
        way = np.subtract(seen["position_m"], pose["position_m"])
        place = offset_degrees(pose["latitude_deg"], pose["longitude_deg"], way[0], way[1])
        zone, east_m, north_m = utm(*place)
        wanted_epsg = (32600 if place[0] >= 0 else 32700) + zone
        x, y = (east_m - west) / pixel, (north - north_m) / pixel
        column, row = int(x), int(y)
        if not (8 <= row < db.shape[0] - 8 and 8 <= column < db.shape[1] - 8):
            continue
        near = db[row - SEARCH : row + SEARCH + 1, column - SEARCH : column + SEARCH + 1]
        if np.isnan(near).mean() > 0.5:
            continue
        at = np.unravel_index(np.nanargmax(near), near.shape)
        off = (at[1] - SEARCH, at[0] - SEARCH)
        above = np.nanmax(near) - np.nanmedian(db[row - 8 : row + 9, column - 8 : column + 9])
        if above < args.least_db:
            print(f"{name}: {above:.1f} dB above its surroundings: too weak to compare")
            continue
        held += 1
        fits = max(abs(off[0]), abs(off[1])) <= 1 and epsg == wanted_epsg
        labelled = ""
        if labels is not None:
            found = int(labels[row + off[1], column + off[0]])
            fits = fits and found == number
            labelled = f", mask {found} (want {number})"
        good = good and fits
        print(
            f"{name}: {east_m:.2f} E {north_m:.2f} N, EPSG:{epsg} (want {wanted_epsg}), "
            f"brightest {off[0]:+d} {off[1]:+d} pixels of {pixel} m away, {above:.1f} dB above{labelled}: {'holds' if fits else 'DOES NOT HOLD'}"
        )
    if held < args.targets:
        print(f"{held} targets were passed and detected, expected at least {args.targets}")
        return 2
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
