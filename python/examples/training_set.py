"""A labelled training set for the segmentation of side-scan pictures.

Each picture is one side of a series of pings: rows are pings, columns are slant range. Its label names the contents of every sample: 0 seabed,
1 shadow, 2 target. Seeds, ranges and targets vary from run to run; each run has its own scene and gives several pictures.

    python training_set.py --runs 8 --out out/training
    python training_set.py --scene quickstart --scene paper --runs 1000 --jobs 16 --out out/training

Each run is a file of its own, OUT/run-000001.npz: `level_db` float16 and `label` uint8, (pictures, rows, columns) each. A run whose file is there is
not computed again. A run depends on its number alone; several computers may therefore share the runs by --first-run.
"""

import argparse
import multiprocessing
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Callable, Dict, List, Tuple

import numpy as np

import echotank

EXAMPLES = Path(__file__).resolve().parent
SEABED, SHADOW, TARGET = 0, 1, 2

Random = np.random.Generator
Overrides = Dict[str, Any]


@dataclass(frozen=True)
class Scene:
    """A rig, and what varies in it."""

    rig: Path
    #: Number of pings that its navigation holds.
    pings: int
    #: Overrides of all runs, and random ones of each.
    fixed: Overrides
    varied: Callable[[Random], Overrides]
    #: Limits of the targets' distances across the track and of their sizes, metres; scatterers on each square metre of them.
    across_m: Tuple[float, float]
    size_m: Tuple[float, float]
    density_per_m2: float
    sides: Tuple[int, ...] = (-1, 1)


#: Pings that are quickly computed, of which only the poses are used.
POSES: Overrides = {
    "scene.seabed.density_per_m2": 0.001,
    "scene.occlusion": "none",
    "sonar.model.path": "polyline",
    "sonar.model.doppler": "stretch",
    "sonar.model.synthesis": "gridded-1d",
}


def flat(random: Random) -> Overrides:
    return {
        "scene.seabed.depth_m": round(random.uniform(8, 20), 2),
        "scene.seabed.bottom": str(random.choice(["mud", "silt", "sand", "gravel"])),
        "sonar.ping.range_m": round(random.uniform(30, 50), 1),
    }


def quickstart(random: Random) -> Overrides:
    return {
        "scene.seabed.lambert_db": round(random.uniform(-33, -22), 1),
        "sonar.ping.range_m": round(random.uniform(65, 105), 1),
    }


def paper(random: Random) -> Overrides:
    return {
        "scene.seabed.shape": str(random.choice(["paper-relief", "paper-curves", "paper-lake"])),
        "sonar.ping.range_m": round(random.uniform(50, 70), 1),
    }


#: For pictures, this tolerance suffices. The paper's track is straight and level.
PAPER: Overrides = {
    "sonar.ping.rate_hz": 3.0,
    "sonar.model.path": "polyline",
    "sonar.model.doppler": "stretch",
    "sonar.model.synthesis": "gridded-1d",
    "sonar.model.tolerance": 0.1,
    "sonar.model.error_check": False,
}

SCENES = {
    "flat": Scene(EXAMPLES / "rigs" / "flat.toml", 300, {}, flat, (6, 28), (0.5, 4), 100),
    "quickstart": Scene(EXAMPLES / "rigs" / "quickstart_sides.toml", 2300, {}, quickstart, (20, 85), (2, 10), 20),
    "paper": Scene(EXAMPLES.parent.parent / "hil-configs" / "paper.toml", 118, PAPER, paper, (12, 45), (1, 5), 100, sides=(1,)),
}


def track(scene: Scene, first: int, count: int) -> Tuple[np.ndarray, np.ndarray]:
    """North and east of the first and last of some pings, metres."""
    rig = echotank.Rig(scene.rig, {**scene.fixed, **POSES})
    ends = [next(iter(rig.pings(number, 1, elements=False, threads=1))).pose for number in (first, first + count - 1)]
    return np.array(ends[0].position_m[:2]), np.array(ends[1].position_m[:2])


def targets(random: Random, scene: Scene, count: int, begin_m: np.ndarray, end_m: np.ndarray) -> str:
    """A file of random boxes, spheres and cylinders beside the track of `count` pings."""
    along_m = end_m - begin_m
    starboard = np.array([-along_m[1], along_m[0]]) / np.linalg.norm(along_m)
    text = ""
    for k in range(random.integers(count // 16, max(count // 8, 1)) + 2):
        across_m = random.choice(scene.sides) * random.uniform(*scene.across_m)
        north_m, east_m = begin_m + random.uniform() * along_m + across_m * starboard
        shape = random.choice(["box", "sphere", "cylinder"])
        small, large = scene.size_m
        length_m, width_m, height_m = random.uniform(small, large), random.uniform(small, large / 2), random.uniform(small / 2, large / 2)
        size = {
            "box": f"size_m = [{length_m:.2f}, {width_m:.2f}, {height_m:.2f}]",
            "sphere": f"radius_m = {height_m / 2:.2f}",
            "cylinder": f"radius_m = {height_m / 3:.2f}\nlength_m = {length_m:.2f}\nelevation_deg = 0.0",
        }[shape]
        text += f'[[target]]\nname = "{shape}-{k}"\nshape = "{shape}"\nnorth_m = {north_m:.2f}\neast_m = {east_m:.2f}\n'
        text += f"{size}\nlambert_db = {random.uniform(-18, -8):.1f}\ndensity_per_m2 = {scene.density_per_m2}\n"
        text += "" if shape == "sphere" else f"heading_deg = {random.uniform(0, 360):.0f}\n"
        text += "\n"
    return text


def labels(mask: echotank.Mask) -> np.ndarray:
    """Labels of a line: uint8 (samples,)."""
    return np.where(mask.target > 0, TARGET, np.where(mask.shadow > 0, SHADOW, SEABED)).astype(np.uint8)


def resized(row: np.ndarray, columns: int) -> np.ndarray:
    """The strongest value in each column: amplitudes keep their peaks, and labels their rarest class."""
    edges = np.linspace(0, len(row), columns + 1).astype(int)
    return np.maximum.reduceat(row, edges[:-1])


def run(number: int, scene: Scene, shape: Tuple[int, int, int], file: Path) -> Tuple[int, float]:
    """Computes a run: for each side, as many pictures, rows and columns as `shape` says. Returns the pictures and the processor time in seconds."""
    began = time.process_time()
    random = np.random.default_rng(number)
    count = shape[0] * shape[1]
    first = int(random.integers(1, scene.pings - count + 2))
    level: Dict[str, List[np.ndarray]] = {}
    label: Dict[str, List[np.ndarray]] = {}
    with tempfile.TemporaryDirectory() as folder:
        named = Path(folder) / "targets.toml"
        varied = {**scene.fixed, **scene.varied(random), "scene.seed": number, "sonar.receiver.seed": number, "scene.targets": str(named)}
        named.write_text(targets(random, scene, count, *track(scene, first, count)))
        # Only lines are needed: without elements, the program may compute beams directly.
        for ping in echotank.Rig(scene.rig, varied).pings(first, count, elements=False, masks=True, threads=1):
            for side, line in ping.lines.items():
                level.setdefault(side, []).append(resized(line, shape[2]))
                label.setdefault(side, []).append(resized(labels(ping.masks[side]), shape[2]))
    levels = 20 * np.log10(np.maximum(np.concatenate([np.reshape(level[side], shape) for side in level]), 1e-9))
    beside = file.with_suffix(".partial")
    with open(beside, "wb") as whole:
        np.savez_compressed(whole, level_db=levels.astype(np.float16), label=np.concatenate([np.reshape(label[side], shape) for side in level]))
    beside.rename(file)
    return len(levels), time.process_time() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", choices=SCENES, action="append", help="may be repeated: the runs take them in turn; flat without it")
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--first-run", type=int, default=1)
    parser.add_argument("--pictures", type=int, default=1, help="of each side and run")
    parser.add_argument("--rows", type=int, default=64, help="pings of each picture")
    parser.add_argument("--columns", type=int, default=256)
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time")
    parser.add_argument("--out", type=Path, default=Path("out/training"))
    args = parser.parse_args()
    began = time.perf_counter()
    scenes = [SCENES[name] for name in args.scene or ["flat"]]
    shape = args.pictures, args.rows, args.columns
    for scene in scenes:
        if scene.pings < args.pictures * args.rows:
            parser.error(f"--pictures {args.pictures} of {args.rows} pings: {scene.rig.name} has {scene.pings} pings")
    args.out.mkdir(parents=True, exist_ok=True)
    count, core_s = 0, 0.0
    # Threads of a rig do not survive a fork.
    with ProcessPoolExecutor(args.jobs, mp_context=multiprocessing.get_context("spawn")) as workers:
        futures = []
        for number in range(args.first_run, args.first_run + args.runs):
            file = args.out / f"run-{number:06}.npz"
            if not file.exists():
                futures.append(workers.submit(run, number, scenes[number % len(scenes)], shape, file))
        for done, future in enumerate(as_completed(futures), 1):
            pictures, seconds = future.result()
            count, core_s = count + pictures, core_s + seconds
            print(f"\r{done} of {len(futures)} runs", end="", flush=True)
    took_s = time.perf_counter() - began
    print(f"\r{count} pictures of {args.rows} x {args.columns} in {took_s:.1f} s, {core_s:.1f} s of processors: {count / max(core_s, 1e-9):.2f} a second and core")
    print(f"{args.runs - len(futures)} runs were there already; {args.out} has {len(list(args.out.glob('run-*.npz')))}")


if __name__ == "__main__":
    main()
