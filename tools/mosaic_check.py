#!/usr/bin/env python3
"""Holds a mosaic of `echotank` against the truth of the replay it was made from, with nothing of the emulator but their files.

    mosaic_check.py MOSAIC.tif TRUTH.jsonl [--least-db 12] [--targets 3]

The GeoTIFF is read by tifffile. Each target of the truth file that some ping passed abeam is projected here: its offset from that ping on the
ellipsoid, then transverse Mercator by the series of Snyder 1987 (eqs. 8-9 to 8-15). The brightest pixel within four of the place must be at most
one pixel away in either direction and stand LEAST-DB above the median around it; at least TARGETS targets must have been passed. If masks lie
beside the mosaic, that pixel must bear the target's number.
Exit code 0: all hold. 1: not. 2: the question cannot be put.
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
# A target counts where its ping's beam passed it by no more than this, and no nearer to the nadir than so many metres.
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
    """The place so many metres away, by the radii of curvature there."""
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
    """Of each target: the ping that had it most nearly abeam, where any had within ABEAM_M."""
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
            print(f"{name}: {above:.1f} dB above its surroundings: too weak to be held against anything")
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
        print(f"{held} targets were passed and stood out, {args.targets} are wanted")
        return 2
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
