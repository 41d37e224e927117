#!/usr/bin/env python3
"""Compares ten depths of every real seabed in the repository with an independent read of its file.

    bathy_check.py ECHOTANK [--places 10] [--seed 1]

Readers: h5py for BAG (positioned by the metadata in the .xml beside it), tifffile and imagecodecs for GeoTIFF, numpy for text. Positions are
drawn from the filled cells or the soundings of each file, converted here with the file's own georeference, and passed to
`ECHOTANK scene info --json --at Y,X`. Also compared: size, share of holes, sign, rows and columns, minimum and maximum depth. Depths must be
equal to the file's precision: exactly for f32 files and soundings, to half the last decimal for text grids.
Exit code 0: all equal. 1: differences. 2: the comparison is not possible.
"""

import argparse
import dataclasses
import json
import pathlib
import re
import subprocess
import sys

import h5py
import numpy as np
import tifffile

HERE = pathlib.Path(__file__).resolve().parent.parent
DATA = HERE / "tests" / "data" / "bathy"


@dataclasses.dataclass
class Grid:
    """Elevations, southern row first; NaN is a hole. x and y are those of the cells' centres."""

    path: pathlib.Path
    elevation_m: np.ndarray
    x: np.ndarray
    y: np.ndarray
    tolerance_m: float


def read_bag(path):
    with h5py.File(path) as file:
        elevation = file["BAG_root/elevation"][:]
        text = file["BAG_root/metadata"][:].tobytes().decode("utf-8", "replace")
    # The survey's own copy of its metadata, which gives the georeference.
    beside = path.with_suffix(".xml").read_text()
    if beside.split() != text.replace("\0", "").split():
        raise SystemExit(f"{path.with_suffix('.xml').name} differs from the metadata in {path.name}")
    text = beside
    corners = re.search(r"<gml:coordinates[^>]*>([^<]+)<", text).group(1)
    west, south = (float(v) for v in re.split(r"[ ,]+", corners.strip())[:2])
    steps = [float(v) for v in re.findall(r"<smXML:value>([^<]+)<", text)]
    rows, cols = elevation.shape
    elevation = np.where(elevation == np.float32(1e6), np.float32(np.nan), elevation)
    return Grid(path, elevation, west + steps[1] * np.arange(cols), south + steps[0] * np.arange(rows), 0.0)


def read_tiff(path):
    with tifffile.TiffFile(path) as file:
        page = file.pages[0]
        band = page.asarray()
        scale = page.tags["ModelPixelScaleTag"].value
        tie = page.tags["ModelTiepointTag"].value
        keys = page.geotiff_tags
        nodata = page.tags["GDAL_NODATA"].value if "GDAL_NODATA" in page.tags else None
    if str(keys.get("GTRasterTypeGeoKey", 1)).split(".")[-1] not in ("1", "RasterPixelIsArea"):
        raise SystemExit(f"{path}: pixels are points, which this check does not support")
    rows, cols = band.shape
    x = tie[3] + scale[0] * (np.arange(cols) + 0.5)
    y = tie[4] - scale[1] * (np.arange(rows) + 0.5)
    band = band.astype(np.float32)
    if nodata is not None:
        band = np.where(band == np.float32(float(nodata)), np.float32(np.nan), band)
    return Grid(path, band[::-1], x, y[::-1], 0.0)


def read_ascii(path):
    with open(path) as file:
        header = dict((k.lower(), float(v)) for k, v in (next(file).split() for _ in range(6)))
        values = np.loadtxt(file)
    rows, cols = values.shape
    step = header["cellsize"]
    half = 0.0 if "xllcenter" in header else step / 2
    x0 = header.get("xllcenter", header.get("xllcorner")) + half
    y0 = header.get("yllcenter", header.get("yllcorner")) + half
    values[values == header["nodata_value"]] = np.nan
    return Grid(path, values[::-1], x0 + step * np.arange(cols), y0 + step * np.arange(rows), 0.5e-3)


def ask(echotank, path, places):
    at = [f"--at={y!r},{x!r}" for y, x in places]
    done = subprocess.run([echotank, "scene", "info", str(path), "--json", *at], capture_output=True, text=True)
    if done.returncode != 0:
        raise SystemExit(f"{path.name}: exit {done.returncode}: {done.stderr.strip()}")
    return json.loads(done.stdout)


class Tally:
    """Counts of comparisons and differences."""

    def __init__(self):
        self.wrong = 0

    def hold(self, what, got, want, tolerance=0.0):
        equal = got == want if isinstance(want, str) or want is None else got is not None and abs(got - want) <= tolerance
        if not equal:
            self.wrong += 1
            print(f"  WRONG {what}: got {got}, want {want} (tolerance {tolerance})")


def check_grid(echotank, grid, places, rng, tally):
    filled = np.argwhere(~np.isnan(grid.elevation_m))
    holes = np.argwhere(np.isnan(grid.elevation_m))
    chosen = filled[rng.choice(len(filled), places, replace=False)]
    said = ask(echotank, grid.path, [(float(grid.y[r]), float(grid.x[c])) for r, c in chosen])
    rows, cols = grid.elevation_m.shape
    tally.hold("rows", said["layout"]["rows"], rows)
    tally.hold("columns", said["layout"]["columns"], cols)
    tally.hold("heights", said["heights"], "elevation")
    tally.hold("hole share", said["hole_share"], len(holes) / (rows * cols), 1e-12)
    depths = [p["depth_m"] for p in said["depth_percentiles"]]
    tally.hold("least depth", depths[0], float(-np.nanmax(grid.elevation_m)), grid.tolerance_m)
    tally.hold("greatest depth", depths[-1], float(-np.nanmin(grid.elevation_m)), grid.tolerance_m)
    worst = 0.0
    for (row, col), place in zip(chosen, said["at"]):
        want = -float(grid.elevation_m[row, col])
        tally.hold(f"row of {row},{col}", place["row_from_south"], int(row))
        tally.hold(f"column of {row},{col}", place["column"], int(col))
        tally.hold(f"depth at {row},{col}", place["depth_m"], want, grid.tolerance_m)
        worst = max(worst, abs(place["depth_m"] - want))
    if len(holes):
        row, col = holes[len(holes) // 2]
        place = ask(echotank, grid.path, [(float(grid.y[row]), float(grid.x[col]))])["at"][0]
        tally.hold(f"hole at {row},{col}", place["depth_m"], None)
    print(f"{grid.path.name}: {places} depths, worst {worst:.1e} m (allowed {grid.tolerance_m:.1e})")


def check_soundings(echotank, path, places, rng, tally):
    table = np.loadtxt(path)
    position, first, count = np.unique(table[:, :2], axis=0, return_index=True, return_counts=True)
    alone = first[count == 1]
    chosen = table[rng.choice(alone, places, replace=False)]
    said = ask(echotank, path, [(float(y), float(x)) for x, y, _ in chosen])
    tally.hold("soundings", said["layout"]["soundings"], len(position))
    tally.hold("merged", said["layout"]["merged"], len(table) - len(position))
    tally.hold("heights", said["heights"], "elevation")
    tally.hold("system", said["system"].split(" (")[0], "geographic degrees")
    worst = 0.0
    for (x, y, z), place in zip(chosen, said["at"]):
        tally.hold(f"depth at {x},{y}", place["depth_m"], float(-z))
        worst = max(worst, abs(place["depth_m"] + z))
    print(f"{path.name}: {places} soundings, worst {worst:.1e} m (allowed 0)")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("echotank")
    parser.add_argument("--places", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    tally = Tally()
    grids = [
        read_bag(DATA / "JD211_public_Release_1-4_UTM.bag"),
        read_tiff(DATA / "laparguera_hitw_bathy.tif"),
        read_ascii(HERE / "hil-configs" / "data" / "jd211_crop_400x400_2m.asc"),
    ]
    for grid in grids:
        check_grid(args.echotank, grid, args.places, rng, tally)
    check_soundings(args.echotank, DATA / "gmt_tut_ship.xyz", args.places, rng, tally)
    print("equal" if tally.wrong == 0 else f"{tally.wrong} values WRONG")
    return 0 if tally.wrong == 0 else 1


if __name__ == "__main__":
    sys.exit(main())
